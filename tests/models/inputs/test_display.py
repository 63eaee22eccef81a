"""Objects show themselves in a line or two, whatever is in them, and without a device computing anything."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from html.parser import HTMLParser
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import i2rl
from i2rl.inference import Run, run_sessions
from i2rl.inference.learners.lme import lme_i2rl
from i2rl.models import Demonstration, FeatureNoise, Sensor, TabularMDP, Visibility, soft_plan
from i2rl.models.inputs.display import LONGEST, brief, shown_briefly
from i2rl.models.observation.recordings import recording

S, A, K = 40, 3, 5


@pytest.fixture(scope="module")
def mdp():
    rng = np.random.default_rng(0)
    names = [f"a state with a long name, number {s}" for s in range(S)]
    return TabularMDP.from_dense(
        rng.dirichlet(np.ones(S), (S, A)), rng.normal(size=(S, A, K)), discount=0.9, states=names
    )


@pytest.fixture(scope="module")
def demonstration():
    states = [[0, 1, -1, 2], [3, -1, 0, 0], [4, 4, 0, 0]]
    lost = np.zeros((3, 4), bool)
    lost[2, 0] = True
    return Demonstration.from_arrays(states, np.zeros((3, 4), int) + (np.array(states) >= 0) - 1,
                                     lost=lost, lengths=[4, 2, 2], missing=-1)  # fmt: skip


@pytest.fixture(scope="module")
def run(mdp):
    steps = Demonstration.from_pairs([[0, 1, 2]], [[0, 0, 1]])
    return run_sessions(lme_i2rl(mdp, Sensor(), iterations=1), [steps], key=jax.random.key(0))


def test_a_process_tells_its_sizes(mdp):
    assert repr(mdp) == "TabularMDP(40 states, 3 actions, 5 features, discount 0.9)"


def test_a_demonstration_tells_its_trajectories_and_what_was_seen(demonstration):
    assert repr(demonstration) == "Demonstration(3 trajectories, 2 to 4 steps, 5 seen, 2 hidden, 1 lost)"
    assert repr(demonstration[1]) == "Demonstration(1 trajectory, 2 steps, 1 seen, 1 hidden, 0 lost)"
    assert repr(demonstration[:0]) == "Demonstration(0 trajectories, 0 steps, 0 seen, 0 hidden, 0 lost)"


def test_a_recording_tells_its_trajectories_and_spaces():
    steps = [np.zeros((3, 2)), np.zeros((5, 2))]
    shown = repr(recording(steps, [x[:, :1] for x in steps]))
    assert shown.startswith("Recording(2 trajectories, 3 to 5 steps, observations float64[2], ")


def test_a_learner_a_run_and_what_it_brings_fit_into_two_lines(mdp, run):
    learner = lme_i2rl(mdp, Sensor())
    assert repr(learner).startswith(f"Learner('{learner.name}', {mdp!r}, ")
    assert repr(run).startswith("Run(1 session, the stream ended, last log likelihood ")
    assert "state LMEState" not in repr(run)
    assert repr(run).endswith("LMEState)")
    assert repr(run.state).startswith("LMEState(")
    for shown in (learner, run, run.state, run.infos[0], run.state.statistic):
        assert len(repr(shown)) <= LONGEST
        assert "Array(" not in repr(shown)


def test_sensors_and_plans_tell_types_and_shapes(mdp):
    plan = jax.jit(soft_plan)(mdp, jnp.zeros((S, A)))
    assert repr(plan).startswith("SoftPlan(values=float64[40], ")
    assert repr(Visibility(np.ones(S))) == "Visibility(in_view=float64[40])"
    assert repr(Visibility([1, 0, 0.5])) == "Visibility(in_view=[1, 0, 0.5])"
    noise = FeatureNoise(np.ones((2, S, A), bool), [0.9, 2 / 3])
    assert "reliabilities=[0.9, 0.667]" in repr(noise)
    assert repr(Sensor(np.ones(S), noise)) == "Sensor(visibility=float64[40], noise=ObservationModel)"


def test_whatever_jax_puts_into_the_fields_is_shown(mdp, demonstration, run):
    told = []

    @jax.jit
    def traced(*values):
        told.extend(repr(v) for v in values)
        told.extend(v._repr_html_() for v in values)
        return 0

    noise = FeatureNoise(np.ones((2, S, A), bool), [0.9, 0.8])
    values = (mdp, demonstration, run.state, noise, Visibility(np.ones(S)))
    traced(*values)
    assert told[0] == "TabularMDP(40 states, 3 actions, 5 features, discount float64[])"
    assert told[1].startswith("Demonstration(kind=int8[3, 4], state=int32[3, 4], ")
    for value in values:
        shapes = jax.eval_shape(lambda x: x, value)
        for put in (shapes, *(jax.tree.map(lambda _, x=x: x, value) for x in (None, object(), "text", 0))):
            assert 0 < len(repr(put)) <= LONGEST
            put._repr_html_()
    rows = jax.vmap(lambda row: (told.append(repr(row)), row)[1])
    rows(Visibility(np.ones((2, S)).mean(0)) and Visibility._make((jnp.ones((2, S)),)))
    assert told[-1] == "Visibility(in_view=float64[40])"


def test_showing_compiles_nothing_and_reads_no_donated_array(mdp, run):
    gone = jnp.ones(3)
    gone.delete()
    assert brief(gone) == "float64[3]"
    with jax.log_compiles(), jax.transfer_guard_host_to_device("disallow"):
        assert len(repr(run.state)) <= LONGEST
        mdp._repr_html_()


def test_values_are_told_plainly():
    assert brief(np.float64(2214.25)) == "2214.25"
    assert brief(jnp.asarray([1.23456, -0.5])) == "[1.23, -0.5]"
    assert brief(np.array([True, False])) == "[True, False]"
    assert brief(np.zeros((2, 3))) == "float64[2, 3]"
    assert brief(jax.random.split(jax.random.key(0), 4)) == "key<fry>[4]"
    assert brief({"slack": 1, "ridge": 2}) == "{'slack', 'ridge'}"
    assert brief([1, None, "x"]) == "[1, None, 'x']"
    assert brief(list(range(100))) == "100 int"
    assert brief(lambda: 0) == "function"
    assert brief(jnp.sin) == "sin"
    assert len(brief("y" * 500)) <= 40
    assert len(brief(10**5000)) <= 80


def test_fields_give_way_where_there_are_too_many():
    @shown_briefly
    class Wide(NamedTuple):
        first: str = "x" * 30
        second: tuple = tuple("yyyyyyyyy" for _ in range(6))
        third: tuple = tuple("zzzzzzzzz" for _ in range(6))
        fourth: tuple = tuple("zzzzzzzzz" for _ in range(6))

    assert len(repr(Wide())) <= LONGEST
    assert repr(Wide()).startswith("Wide(first='xx")
    assert repr(Wide()).endswith(", ...)")


class Reader(HTMLParser):
    """Collects rows, and the tags and styles they are made with."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.text, self.tags, self.styles = "", set(), ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.styles += str(attrs)

    def handle_data(self, data):
        self.text += data + "\n"


def test_notebooks_get_a_small_table_without_colours_of_its_own(mdp, demonstration, run):
    for shown in (mdp, demonstration, lme_i2rl(mdp, Sensor()), run, run.state, run.infos[0]):
        page = Reader(shown._repr_html_())
        assert page.tags <= {"table", "caption", "tbody", "tr", "th", "td"}
        assert "color" not in page.styles
        assert page.text.startswith(type(shown).__name__)
        assert len(page.text) < 2000
    assert "2 to 4 steps" in demonstration._repr_html_()


def test_names_of_others_are_escaped_in_notebooks():
    mdp = TabularMDP.from_successors(
        np.zeros((1, 1, 1), int), np.ones((1, 1, 1)), np.zeros((1, 1, 1)), feature_names=["<b>&"]
    )
    page = Reader(mdp._repr_html_())
    assert "<b>&" in page.text
    assert "b" not in page.tags


def _public_tuples():
    for room in ("models", "inference", "domains"):
        package = importlib.import_module(f"i2rl.{room}")
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            for name, value in vars(importlib.import_module(found.name)).items():
                own = inspect.isclass(value) and value.__module__ == found.name and not name.startswith("_")
                if own and issubclass(value, tuple) and hasattr(value, "_fields"):
                    yield value


def test_every_named_tuple_that_may_hold_arrays_shows_itself_briefly():
    plain = [
        f"{cls.__module__}.{cls.__qualname__}"
        for cls in _public_tuples()
        if not hasattr(cls, "_repr_html_") and "Array" in str(cls.__annotations__)
    ]
    assert plain == []
    assert i2rl.__name__ == "i2rl"
    assert issubclass(Run, tuple)
