"""Builders of tiny random problems, and their solution by enumeration."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from html import unescape
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import pytest
from hypothesis import settings

from i2rl.analysis.drawing.page import GLOSSARY
from i2rl.compilation import compile_quickly, keep_programs
from i2rl.models import Demonstration, TabularMDP
from i2rl.models.observation.demonstration import HIDDEN, LOST, PAD, SEEN, UNKNOWN
from i2rl.models.observation.evidence import observe
from i2rl.models.process.planning import simulate

settings.register_profile("deterministic", derandomize=True, deadline=None, max_examples=25, database=None)
settings.load_profile("deterministic")

# For this process, for other workers and for the commands that tests start.
compile_quickly()
keep_programs()


# Linux lets a process map 65,530 regions of memory and ends it where a compiler asks for more.
_MANY_REGIONS = 20_000


@pytest.fixture(autouse=True, scope="module")
def _compiled_programs_are_let_go():
    """Release compiled programs: each takes some regions, and a worker runs many modules."""
    yield
    regions = Path("/proc/self/maps")
    if regions.exists() and len(regions.read_text().splitlines()) > _MANY_REGIONS:
        jax.clear_caches()


@pytest.fixture
def small_pictures(monkeypatch):
    """Pages with pictures of few dots: what is on them is tested on figures themselves."""
    monkeypatch.setattr("i2rl.analysis.drawing.style.DPI", 30)


@pytest.fixture(scope="session")
def page_faults() -> Callable[[str], list[str]]:
    """List the faults of a page that would disturb a reader; empty for a sound page."""
    return _page_faults


def _page_faults(page: str) -> list[str]:
    body = re.sub(r"<(style|h1|h2|title|footer|code)\b.*?</\1>", " ", page, flags=re.DOTALL)
    text = unescape(re.sub(r"<[^>]*>", " ", body))
    of_one = "run|seed|session|world|trajectorie|breache|belt|bout|patroller|feature|way"
    patterns = {
        "backtick": r"`",
        "exponent": r"\d\.?\d*e[+-]?\d",
        "not a number": r"\bnan\b",
        "plural of one": rf"(?<![\d.,])1 (?:[a-z]+ )?(?:{of_one})s\b",
    }
    faults = [
        f"{fault}: {hit[0]}" for fault, pattern in patterns.items() if (hit := re.search(pattern, text))
    ]
    if not re.search(r'</h1>\s*<p class="lead">', page):
        faults.append("no lead")
    for name, meaning in GLOSSARY.items():
        stands = re.search(rf"(?<![\w-]){re.escape(name)}(?![\w-])", text) is not None
        spelled = re.findall(rf"(?<![\w-]){re.escape(name)}(?: \(|: ){re.escape(meaning)}", text)
        if len(spelled) != stands:
            faults.append(f"{name} is spelled out {len(spelled)} times")
    return faults


def _random_mdp(
    seed: int,
    n_states: int = 4,
    n_actions: int = 3,
    n_successors: int = 2,
    n_features: int = 2,
    *,
    masked: bool = False,
    discount: float = 0.9,
    starts: int | None = None,
) -> TabularMDP:
    """Random successors, probabilities and features; ``masked`` removes actions, ``starts`` limits ``p0``."""
    rng = np.random.default_rng(seed)
    shape = (n_states, n_actions, n_successors)
    successors = np.stack(
        [rng.permutation(n_states)[:n_successors] for _ in range(n_states * n_actions)]
    ).reshape(shape)
    available = np.ones(shape[:2], bool)
    if masked:
        available = rng.random(shape[:2]) < 0.6
        available[np.arange(n_states), rng.integers(n_actions, size=n_states)] = True
    initial = np.zeros(n_states)
    allowed = rng.permutation(n_states)[: starts or n_states]
    initial[allowed] = rng.dirichlet(np.ones(len(allowed)))
    return TabularMDP.from_successors(
        successors,
        rng.dirichlet(np.ones(n_successors), shape[:2]),
        rng.random((n_states, n_actions, n_features)),
        initial=initial,
        discount=discount,
        available=available,
    )


def _dense(mdp: TabularMDP) -> np.ndarray:
    table = np.zeros((mdp.n_states, mdp.n_actions, mdp.n_states))
    for s, a, b in np.ndindex(*mdp.successors.shape):
        table[s, a, int(mdp.successors[s, a, b])] += float(mdp.probabilities[s, a, b])
    return table


class Enumeration(NamedTuple):
    """Every completion of one trajectory: ``states, actions [N, L]``, posterior ``[N]``, log-likelihood."""

    states: np.ndarray
    actions: np.ndarray
    posterior: np.ndarray
    log_likelihood: float


def _enumerate(mdp: TabularMDP, log_policy: np.ndarray, log_evidence: np.ndarray) -> Enumeration:
    moves, n_pairs = _dense(mdp), mdp.n_states * mdp.n_actions
    step_weight = np.exp(np.asarray(log_policy) + np.asarray(log_evidence)).reshape(-1, n_pairs)
    into = np.repeat(moves.reshape(n_pairs, -1), mdp.n_actions, axis=1)
    weight = np.repeat(np.asarray(mdp.initial), mdp.n_actions) * step_weight[0]
    paths = np.flatnonzero(weight)[:, None]
    weight = weight[paths[:, 0]]
    for now in step_weight[1:]:
        grown = weight[:, None] * into[paths[:, -1]] * now
        prefix, pair = np.nonzero(grown)
        paths, weight = np.column_stack([paths[prefix], pair]), grown[prefix, pair]
    total = weight.sum()
    states, actions = np.divmod(paths, mdp.n_actions)
    return Enumeration(
        states,
        actions,
        weight / total if total > 0 else weight,
        float(np.log(total)) if total > 0 else -np.inf,
    )


@partial(jax.jit, static_argnums=4)
def _perceive(keys, mdp, log_policy, sensor, length):
    def one(key):
        act, look = jax.random.split(key)
        return observe(look, sensor, *simulate(act, mdp, log_policy, length))

    return jax.vmap(one)(keys)


def _imperfect_demonstration(
    seed: int, mdp: TabularMDP, log_policy: np.ndarray, sensor: object, n: int, length: int
) -> Demonstration:
    """Simulate ragged trajectories through a sensor, with lost frames and unobserved coordinates."""
    rng = np.random.default_rng(seed)
    keys = jax.random.split(jax.random.key(seed), n)
    codes = np.array(_perceive(keys, mdp, log_policy, sensor, length))
    chance = rng.random((n, length))
    seen = codes[..., 0] == SEEN
    codes[seen & (chance < 0.15), 1] = UNKNOWN
    codes[seen & (chance > 0.85), 2] = UNKNOWN
    codes[rng.random((n, length)) < 0.15] = (LOST, UNKNOWN, UNKNOWN)
    lengths = rng.integers(1, length + 1, n)
    lengths[0] = length
    codes[np.arange(length) >= lengths[:, None]] = (PAD, UNKNOWN, UNKNOWN)
    assert {HIDDEN, LOST, PAD, SEEN} >= set(np.unique(codes[..., 0]))
    return Demonstration.from_codes(codes)


@pytest.fixture(scope="session")
def random_mdp() -> Callable[..., TabularMDP]:
    return _random_mdp


@pytest.fixture(scope="session")
def dense_transitions() -> Callable[[TabularMDP], np.ndarray]:
    """Transitions ``[S, A, S]`` accumulated entry by entry."""
    return _dense


@pytest.fixture(scope="session")
def enumerate_completions() -> Callable[..., Enumeration]:
    """Enumerate the completions of one trajectory ``log_evidence [L, S, A]`` with their posterior."""
    return _enumerate


@pytest.fixture(scope="session")
def imperfect_demonstration() -> Callable[..., Demonstration]:
    return _imperfect_demonstration
