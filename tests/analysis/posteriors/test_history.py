from __future__ import annotations

import json
from typing import NamedTuple

import arviz as az
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2rl.analysis.posteriors.history import fleet_history, provenance, run_history
from i2rl.inference import Learner, SessionInfo, darko_i2rl, fleet, jin_i2rl, run_sessions
from i2rl.inference.sessions.statistic import CountStatistic, FeatureStatistic, blend
from i2rl.models import TrajectoryLaw, sample_demonstration
from i2rl.models.observation.evidence import Sensor
from i2rl.version import __version__

SESSIONS = 3


@pytest.fixture(scope="module")
def mdp(random_mdp):
    return random_mdp(2)


@pytest.fixture(scope="module")
def demonstration(mdp):
    law = TrajectoryLaw(mdp, jnp.array([2.0, -1.0]), Sensor(), 4)
    return sample_demonstration(jax.random.key(0), law, 2 * SESSIONS)


class State(NamedTuple):
    statistic: CountStatistic
    session: jax.Array


@pytest.fixture(scope="module")
def learner(mdp):
    """Make a learner that accumulates visits and weighs a feature by its frequency."""

    def session(state, demonstration):
        pairs = jnp.zeros((mdp.n_states, mdp.n_actions)).at[demonstration.state, demonstration.action].add(1)
        n = demonstration.state.shape[0]
        kept = blend(state.statistic, CountStatistic(jnp.array(float(n)), pairs / n))
        weights = jnp.einsum("sa,sak->k", kept.counts, mdp.features)
        number = state.session + 1
        info = SessionInfo(
            number,
            -weights.sum(),
            -2 * weights.sum(),
            weights.max(),
            number,
            3 * number,
            jnp.array(True),
            0.1 * number,
            weights,
        )
        return State(kept, number), info

    def init(key):
        del key
        return State(CountStatistic(jnp.zeros(()), jnp.zeros((mdp.n_states, mdp.n_actions))), jnp.array(0))

    def update(state, demonstration):
        state, info = jax.jit(session)(state, demonstration)
        return state, SessionInfo(*(x.item() if np.ndim(x) == 0 else np.asarray(x) for x in info))

    return Learner("counting", mdp, {"iterations": 3}, init, update, session)


@pytest.fixture(scope="module")
def run(learner, demonstration):
    return run_sessions(learner, demonstration.sessions(2), key=jax.random.key(1))


@pytest.fixture(scope="module")
def history(learner, run):
    return run_history(learner, run, seed=1, true_weights=[2.0, -1.0])


def soft_policy(mdp, moves, weights):
    reward, values = np.asarray(mdp.features) @ weights, np.zeros(mdp.n_states)
    for _ in range(400):
        q = reward + float(mdp.discount) * moves @ values
        values = np.log(np.exp(q).sum(1))
    return np.exp(q - values[:, None])


def test_sessions_hold_every_field_of_the_reports(history, run, mdp):
    sessions = history.sessions
    assert list(sessions.session) == [1, 2, 3]
    assert list(sessions.feature) == list(mdp.feature_names)
    assert sessions.weights.dims == ("session", "feature")
    np.testing.assert_array_equal(sessions.weights, [r.weights for r in run.infos])
    for name in set(run.infos[0]._fields) - {"session", "weights"}:
        assert sessions[name].dims == ("session",), name
        np.testing.assert_array_equal(sessions[name], [getattr(r, name) for r in run.infos])
    assert sessions.seconds.attrs["units"] == "s"
    np.testing.assert_array_equal(history.constant_data.true_weights, [2.0, -1.0])


def test_the_policy_learned_is_that_of_the_last_weights(history, run, mdp, dense_transitions):
    expected = soft_policy(mdp, dense_transitions(mdp), np.asarray(run.infos[-1].weights))
    np.testing.assert_allclose(history.learned.soft_policy, expected, atol=1e-8)
    assert list(history.learned.state.values) == list(mdp.state_names)


def test_the_statistic_learned_counts_the_demonstration(history, demonstration, mdp):
    counts = np.zeros((mdp.n_states, mdp.n_actions))
    np.add.at(counts, (demonstration.state, demonstration.action), 1)
    learned = history.learned
    assert learned.counts.dims == ("state", "action")
    assert learned["size"] == demonstration.n_trajectories
    np.testing.assert_allclose(learned.counts * learned["size"], counts, atol=1e-12)


def test_a_feature_statistic_has_its_own_dimensions(learner, run):
    statistic = FeatureStatistic(jnp.array(3.0), jnp.arange(2.0), jnp.full(4, 0.25))
    learned = run_history(learner, run.infos, statistic=statistic).learned
    assert learned.features.dims == ("feature",)
    assert learned.start.dims == ("state",)
    np.testing.assert_array_equal(learned.features, [0.0, 1.0])


def test_attributes_say_where_it_comes_from(history, learner, mdp):
    for attrs in (history.attrs, history.sessions.attrs, history.learned.attrs):
        assert attrs["method"] == "counting"
        assert attrs["seed"] == 1
        assert attrs["i2rl_version"] == __version__
        assert attrs["mdp_fingerprint"] == mdp.fingerprint()
        assert attrs["signature"] == learner.signature
        assert json.loads(attrs["configuration"])["iterations"] == 3
        assert json.loads(attrs["library_versions"])["arviz"] == az.__version__


def test_a_configuration_of_arrays_and_objects_becomes_text(mdp):
    attrs = provenance(mdp, "any", {"a": np.arange(2), "b": jnp.array(1.5), "c": {1}})
    assert json.loads(attrs["configuration"]) == {"a": [0, 1], "b": 1.5, "c": "{1}"}
    assert "seed" not in attrs


def test_a_history_survives_a_file(history, tmp_path):
    path = str(tmp_path / "history.nc")
    history.to_netcdf(path, engine="h5netcdf")
    back = az.from_netcdf(path, engine="h5netcdf")
    assert set(back.groups()) == {"sessions", "learned", "constant_data"}
    for group in history.groups():
        assert back[group].identical(history[group]), group
    assert back.attrs == history.attrs


def test_reports_alone_make_a_history_without_a_statistic(learner, run, history):
    alone = run_history(learner, run.infos)
    assert alone.sessions.equals(history.sessions)
    assert set(alone.learned.data_vars) == {"weights", "soft_policy"}
    assert alone.groups() == ["sessions", "learned"]
    given = run_history(learner, run.infos, statistic=run.state.statistic)
    assert given.learned.equals(history.learned)


def test_a_fleet_has_the_history_of_each_of_its_streams(mdp, learner):
    law = TrajectoryLaw(mdp, jnp.array([2.0, -1.0]), Sensor(), 4)
    streams = [list(sample_demonstration(jax.random.key(i), law, 4).sessions(2)) for i in range(2)]
    many = fleet(learner)
    states, infos = many.init(jax.random.key(5), 2), []
    for session in zip(*streams, strict=True):
        states, info = many.update(states, jax.tree.map(lambda *x: np.stack(x), *session))
        infos.append(info)
    history = fleet_history(learner, infos, state=states)
    assert history.sessions.weights.dims == ("run", "session", "feature")
    assert history.learned.counts.dims == ("run", "state", "action")
    assert history.learned["size"].dims == ("run",)
    for i, key in enumerate(jax.random.split(jax.random.key(5), 2)):
        alone = run_history(learner, run_sessions(learner, streams[i], key=key))
        for group, name in (
            ("sessions", "weights"),
            ("sessions", "log_likelihood"),
            ("learned", "counts"),
            ("learned", "soft_policy"),
        ):
            one = history[group][name].isel(run=i)
            np.testing.assert_allclose(one, alone[group][name], rtol=1e-6, atol=1e-9)
    with pytest.raises(ValueError, match="use fleet_history"):
        run_history(learner, infos)


def test_what_is_no_history_is_refused(learner, run):
    with pytest.raises(ValueError, match="at least one session; got no infos"):
        run_history(learner, [])
    with pytest.raises(ValueError, match="a run or a list of infos; got int"):
        run_history(learner, [1, 2])
    with pytest.raises(ValueError, match="use run_history"):
        fleet_history(learner, run.infos)
    with pytest.raises(ValueError, match=r"true_weights must have shape \(2,\), got \(3,\)"):
        run_history(learner, run, true_weights=np.zeros(3))
    wide = [info._replace(weights=np.zeros(5)) for info in run.infos]
    with pytest.raises(ValueError, match=r"must have shape \(2,\), one for each feature, got \(5,\)"):
        run_history(learner, wide)


@pytest.mark.parametrize("make", [jin_i2rl, darko_i2rl])
def test_methods_without_a_statistic_have_histories_too(mdp, demonstration, make):
    learner = make(mdp)
    history = run_history(learner, run_sessions(learner, demonstration.sessions(2), key=jax.random.key(1)))
    assert history["sessions"].sizes == {"session": SESSIONS, "feature": learner.mdp.n_features}
    assert set(history["learned"].data_vars) == {"weights", "soft_policy"}
    assert list(history["sessions"]["feature"].values) == list(learner.mdp.feature_names)
