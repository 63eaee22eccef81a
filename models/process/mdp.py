"""The decision process of an expert, without its reward."""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy import sparse

from ..inputs.display import brief, brief_repr, brief_table, fields_of
from ..inputs.probabilities import normalised, sum_tolerance
from ..inputs.text import listed, shortened

# Gathering from predecessors beats scattering to successors on a CPU unless some state has far more
# predecessors than the average; past this ratio (an absorbing sink, say) the padding costs more.
_MAX_INFLOW_RATIO = 6
# For very many states, whose processes nobody batches, the table does not pay either: there scattering is
# 3 times faster (6 ms against 18 at 300 000 states).
_MAX_INFLOW_STATES = 10_000
_SURROGATE = re.compile("[\ud800-\udfff]")


@dataclass(frozen=True)
class Labels:
    """Names of states, actions and features; absent names default to ``s3``, ``a1``, ``f0``."""

    states: tuple[str, ...] | None = None
    actions: tuple[str, ...] | None = None
    features: tuple[str, ...] | None = None
    _hash: int = field(init=False, repr=False, compare=False, default=0)

    def __post_init__(self) -> None:
        # Hashed once: a compiled function looks up its static arguments at every call.
        object.__setattr__(self, "_hash", hash((self.states, self.actions, self.features)))

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        if self is other:
            return True
        if not isinstance(other, Labels) or self._hash != other._hash:
            return False
        return (self.states, self.actions, self.features) == (other.states, other.actions, other.features)

    def __reduce__(self) -> tuple:
        # Hashes of strings differ between processes: rebuild them.
        return Labels, (self.states, self.actions, self.features)


@partial(
    jax.tree_util.register_dataclass,
    data_fields=[
        "successors",
        "probabilities",
        "features",
        "initial",
        "discount",
        "available",
        "inflow_pairs",
        "inflow_slots",
    ],
    meta_fields=["labels"],
)
@dataclass(frozen=True, eq=False)
class TabularMDP:
    """A finite MDP without a reward, ``<S, A, P, phi, gamma, p0>`` (Definition 1), as successor lists.

    Built by :meth:`from_successors`, :meth:`from_dense` or :meth:`from_sparse`, which check it once;
    immutable, and a JAX pytree, so it passes through ``jit``, ``vmap`` and ``grad``. Comparison is by
    identity;
    :meth:`fingerprint` compares contents.

    Attributes
    ----------
    successors : int ``[S, A, B]``
        The states that may follow each pair; padded entries have probability zero.
    probabilities : float ``[S, A, B]``
        Their probabilities, summing to one over ``B`` for every available pair.
    features : float ``[S, A, K]``
        Reward features ``phi(s, a)``; the reward is ``theta . phi``.
    initial : float ``[S]``
        Distribution of the first state, ``p0``.
    discount : float scalar
        ``gamma`` in (0, 1]; 1 only for finite horizons.
    available : bool ``[S, A]``
        The actions that exist in each state.
    inflow_pairs, inflow_slots : int ``[S, M]`` or None
        The same transitions indexed by the state they lead to: flat indices of the pair and of the entry of
        ``probabilities`` (-1 on padding). Stored up to 10 000 states unless some state has far more
        predecessors than the average. The numbers are in ``probabilities`` alone, so that a derivative covers
        all of them.
    labels : Labels
        Names.
    """

    successors: Int[Array, "S A B"]
    probabilities: Float[Array, "S A B"]
    features: Float[Array, "S A K"]
    initial: Float[Array, " S"]
    discount: Float[Array, ""]
    available: Bool[Array, "S A"]
    inflow_pairs: Int[Array, "S M"] | None
    inflow_slots: Int[Array, "S M"] | None
    labels: Labels = Labels()

    # -- construction ---------------------------------------------------------------------------------

    @staticmethod
    def from_successors(
        successors: np.ndarray,
        probabilities: np.ndarray,
        features: np.ndarray,
        *,
        initial: np.ndarray | None = None,
        discount: float = 0.99,
        available: np.ndarray | None = None,
        states: Sequence[str] | None = None,
        actions: Sequence[str] | None = None,
        feature_names: Sequence[str] | None = None,
    ) -> TabularMDP:
        """Build an MDP from successor lists ``[S, A, B]``.

        ``initial`` defaults to uniform, ``available`` to every pair. Probabilities may sum to one within the
        precision of their type (:func:`~i2rl.models.inputs.probabilities.sum_tolerance`). Those of
        ``initial``, and those of transitions shorter than 64 bits, are then divided by their sum; sums within
        64-bit rounding of one keep their bits. Raises ``ValueError`` naming the state, action or feature at
        fault: probabilities that are negative, NaN or do not sum to one, successors out of range, features of
        the wrong shape or not finite, a discount outside (0, 1], a state with no available action, names of
        the wrong number or repeated.
        """
        successors = np.asarray(successors)
        given = np.asarray(probabilities)
        probabilities, features = _real("probabilities", given), _real("features", features)
        if successors.ndim != 3 or successors.shape != probabilities.shape:
            raise ValueError(
                "successors and probabilities must have one shape [S, A, B], got "
                f"{successors.shape} and {probabilities.shape}"
            )
        n_states, n_actions, _ = successors.shape
        if min(successors.shape) == 0:
            raise ValueError(f"an MDP needs at least one state, action and successor, got {successors.shape}")
        if not np.issubdtype(successors.dtype, np.integer):
            raise ValueError(f"successors must be integers (indices of states), got {successors.dtype}")
        labels = _checked_labels(states, actions, feature_names, n_states, n_actions, features)
        name = PairNames(labels)
        if features.ndim != 3 or features.shape[:2] != (n_states, n_actions) or features.shape[2] == 0:
            raise ValueError(
                f"features must have shape [S, A, K] = [{n_states}, {n_actions}, K >= 1], "
                f"got {features.shape}"
            )
        available = np.ones((n_states, n_actions), bool) if available is None else np.asarray(available)
        if available.shape != (n_states, n_actions) or available.dtype != bool:
            raise ValueError(
                f"available must be a boolean array [{n_states}, {n_actions}], "
                f"got {available.dtype} {available.shape}"
            )
        if not available.any(1).all():
            s = int(np.flatnonzero(~available.any(1))[0])
            raise ValueError(
                f"state {name.state(s)} has no available action; an absorbing state needs an action that "
                "stays there"
            )
        if not np.isfinite(features[available]).all():
            s, a, k = np.argwhere(~np.isfinite(features) & available[..., None])[0]
            raise ValueError(
                f"feature {name.feature(k)} of {name.pair(s, a)} is {features[s, a, k]}, not a number"
            )
        tolerance = sum_tolerance(given.dtype, given.shape[-1])
        _check_transitions(successors, probabilities, available, n_states, name, tolerance)
        if not 0 < discount <= 1:
            raise ValueError(f"discount must lie in (0, 1], got {discount}")
        start = np.full(n_states, 1 / n_states) if initial is None else np.asarray(initial)
        initial = _real("initial", start)
        if initial.shape != (n_states,):
            raise ValueError(f"initial must have shape [{n_states}], got {initial.shape}")
        with np.errstate(over="ignore"):
            total, within = initial.sum(), sum_tolerance(start.dtype, n_states)
        if not np.isfinite(initial).all() or (initial < 0).any() or abs(total - 1) > within:
            raise ValueError(
                f"initial must be a distribution over states: its least value is {initial.min()}, "
                f"its sum {total}"
            )
        # Unavailable pairs keep their place with zero probability and zero features.
        probabilities = np.where(available[..., None], probabilities, 0.0)
        if tolerance > sum_tolerance(float, 1):  # given in fewer than 64 bits
            probabilities = normalised(probabilities)
        features = np.where(available[..., None], features, 0.0)
        successors = np.where(probabilities > 0, successors, np.arange(n_states)[:, None, None]).astype(
            np.int32
        )
        inflow = _inflow(successors, available)
        return TabularMDP(
            successors=jnp.asarray(successors),
            probabilities=jnp.asarray(probabilities),
            features=jnp.asarray(features),
            initial=jnp.asarray(normalised(initial)),
            discount=jnp.asarray(float(discount)),
            available=jnp.asarray(available),
            inflow_pairs=None if inflow is None else jnp.asarray(inflow[0]),
            inflow_slots=None if inflow is None else jnp.asarray(inflow[1]),
            labels=labels,
        )

    @staticmethod
    def from_dense(transitions: np.ndarray, features: np.ndarray, **options: Any) -> TabularMDP:
        """Build an MDP from dense transitions ``[S, A, S]``; options as for :meth:`from_successors`."""
        transitions = np.asarray(transitions)
        if transitions.ndim != 3 or transitions.shape[0] != transitions.shape[2]:
            raise ValueError(f"dense transitions must have shape [S, A, S], got {transitions.shape}")
        n_states, n_actions, _ = transitions.shape
        rows = sparse.csr_array(transitions.reshape(n_states * n_actions, n_states).astype(float))
        return _from_rows(rows, transitions.dtype, features, **options)

    @staticmethod
    def from_sparse(
        transitions: sparse.sparray | sparse.spmatrix | Sequence[sparse.sparray | sparse.spmatrix],
        features: np.ndarray,
        **options: Any,
    ) -> TabularMDP:
        """Build an MDP from SciPy-sparse transitions.

        The transitions are one matrix ``[S * A, S]`` whose row ``s * A + a`` is the distribution after pair
        ``(s, a)``, or a sequence of ``A`` matrices ``[S, S]``. Options as for :meth:`from_successors`.
        """
        if not sparse.issparse(transitions):
            blocks = [sparse.csr_array(block) for block in transitions]
            if not blocks:
                raise ValueError("sparse transitions need at least one action's matrix, got none")
            n_states, n_actions = blocks[0].shape[0], len(blocks)
            if any(block.shape != (n_states, n_states) for block in blocks):
                raise ValueError(f"each action's matrix must be [S, S], got {[b.shape for b in blocks]}")
            stacked = sparse.vstack(blocks, format="csr")
            rows = stacked[np.arange(n_states * n_actions).reshape(n_actions, n_states).T.ravel()]
        else:
            # A copy: merging duplicates works in place and would change the caller's matrix.
            rows = sparse.csr_array(transitions, copy=True)
            n_states = rows.shape[1]
            if n_states == 0 or rows.shape[0] % n_states:
                raise ValueError(f"transitions must have shape [S * A, S], got {rows.shape}")
        return _from_rows(rows, rows.dtype, features, **options)

    # -- shape and names ------------------------------------------------------------------------------

    @property
    def n_states(self) -> int:
        """Number of states, ``S``."""
        return self.successors.shape[-3]

    @property
    def n_actions(self) -> int:
        """Number of actions, ``A``."""
        return self.successors.shape[-2]

    @property
    def n_features(self) -> int:
        """Number of reward features, ``K``."""
        return self.features.shape[-1]

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states, given or ``s0, s1, ...``."""
        return self.labels.states or tuple(f"s{i}" for i in range(self.n_states))

    @property
    def action_names(self) -> tuple[str, ...]:
        """Names of the actions, given or ``a0, a1, ...``."""
        return self.labels.actions or tuple(f"a{i}" for i in range(self.n_actions))

    @property
    def feature_names(self) -> tuple[str, ...]:
        """Names of the features, given or ``f0, f1, ...``."""
        return self.labels.features or tuple(f"f{i}" for i in range(self.n_features))

    def __repr__(self) -> str:
        sizes = self._sizes()
        if sizes is None:
            return brief_repr(self)
        told = ", ".join(f"{n} {name}" for name, n in sizes.items())
        return f"{type(self).__name__}({told}, discount {brief(self.discount)})"

    def _repr_html_(self) -> str:
        sizes = self._sizes()
        if sizes is None:
            return brief_table(type(self).__name__, fields_of(self))
        given = (self.labels.states, self.labels.actions, self.labels.features)
        rows = [
            (name, f"{n}: {listed(names, 8)}" if names else str(n))
            for (name, n), names in zip(sizes.items(), given, strict=True)
        ]
        return brief_table(type(self).__name__, [*rows, ("discount", self.discount)])

    def _sizes(self) -> dict[str, int] | None:
        """Numbers of states, actions and features; None where JAX put something else into the fields."""
        try:
            sizes = {"states": self.n_states, "actions": self.n_actions, "features": self.n_features}
        except (AttributeError, IndexError, TypeError):
            return None
        return sizes if all(isinstance(n, int) for n in sizes.values()) else None

    def fingerprint(self) -> str:
        """Digest everything that defines this MDP, in hexadecimal; equal exactly for equal MDPs.

        The initial distribution enters divided by its sum, as older versions stored it: journals hold such
        digests.
        """
        initial = np.asarray(self.initial)
        if sum_tolerance(initial.dtype, initial.size) >= abs(initial.sum() - 1):
            initial = initial / initial.sum()
        digest = hashlib.sha256()
        for leaf in (
            self.successors,
            self.probabilities,
            self.features,
            initial,
            self.discount,
            self.available,
        ):
            array = np.ascontiguousarray(leaf)
            digest.update(f"{array.dtype}{array.shape}".encode())
            digest.update(array.tobytes())
        digest.update(repr((self.labels.states, self.labels.actions, self.labels.features)).encode())
        return digest.hexdigest()

    def with_initial(self, initial: Float[Array | np.ndarray, " S"]) -> TabularMDP:
        """Replace the initial distribution (unchecked, so that it works under a trace)."""
        return replace(self, initial=jnp.asarray(initial))

    def with_probabilities(self, probabilities: Float[Array | np.ndarray, "S A B"]) -> TabularMDP:
        """Replace the probabilities of the same successors (unchecked, so that it works under a trace)."""
        return replace(self, probabilities=jnp.asarray(probabilities))

    def without_inflow(self) -> TabularMDP:
        """Drop the inflow table, whose width differs between processes of one size."""
        return replace(self, inflow_pairs=None, inflow_slots=None)

    # -- the two directions of the dynamics -----------------------------------------------------------

    @property
    def inflow_probabilities(self) -> Float[Array, "S M"] | None:
        """Probabilities of the transitions into each state, zero on padding; None without the table."""
        if self.inflow_slots is None:
            return None
        return jnp.where(self.inflow_slots < 0, 0.0, self.probabilities.reshape(-1)[self.inflow_slots])

    def expect_next(self, values: Float[Array | np.ndarray, " S"]) -> Float[Array, "S A"]:
        """Return the expected value after each pair, ``sum_s' P(s' | s, a) v(s')``."""
        return jnp.einsum("sab,sab->sa", self.probabilities, values[self.successors])

    def push_forward(self, pairs: Float[Array | np.ndarray, "S A"]) -> Float[Array, " S"]:
        """Return mass on the next state from mass on pairs, ``sum_{s, a} x(s, a) P(s' | s, a)``."""
        if self.inflow_pairs is not None:
            return jnp.einsum("sm,sm->s", self.inflow_probabilities, pairs.reshape(-1)[self.inflow_pairs])
        flow = pairs[..., None] * self.probabilities
        return jax.ops.segment_sum(flow.reshape(-1), self.successors.reshape(-1), self.n_states)

    def transition_probability(self, state: Int[Array | np.ndarray, ""]) -> Float[Array, "S A"]:
        """Return the probability of reaching ``state`` from each pair, ``P(state | s, a)``."""
        return jnp.sum(jnp.where(self.successors == state, self.probabilities, 0.0), axis=-1)

    def state_transitions(self, policy: Float[Array | np.ndarray, "S A"]) -> Float[Array, "S S"]:
        """Return the Markov chain of a policy as a dense matrix ``[S, S]`` (small state spaces only)."""
        flow = policy[..., None] * self.probabilities
        rows = jnp.broadcast_to(jnp.arange(self.n_states)[:, None, None], self.successors.shape)
        return jnp.zeros((self.n_states, self.n_states)).at[rows, self.successors].add(flow)


def _real(name: str, given: Any) -> Float[np.ndarray, "..."]:
    """Convert the numbers to 64-bit floats."""
    array = np.asarray(given)
    if array.dtype.kind == "c":
        raise ValueError(f"{name} must be real numbers; got {array.dtype}")
    return array.astype(float, copy=False)


def _from_rows(rows: sparse.csr_array, dtype: np.dtype, features: np.ndarray, **options: Any) -> TabularMDP:
    """Build the MDP from a row of ``[S * A, S]`` per pair, whose probabilities were given in ``dtype``."""
    rows.sum_duplicates()
    counts = np.diff(rows.indptr)
    width = max(int(counts.max(initial=0)), 1)
    slot = np.arange(rows.nnz) - np.repeat(rows.indptr[:-1], counts)
    pair = np.repeat(np.arange(len(counts)), counts)
    n_states = rows.shape[1]
    n_actions = rows.shape[0] // n_states
    successors = np.repeat(np.repeat(np.arange(n_states), n_actions)[:, None], width, axis=1)
    probabilities = np.zeros((len(counts), width))
    successors[pair, slot] = rows.indices
    probabilities[pair, slot] = rows.data
    shape = (n_states, n_actions, width)
    return TabularMDP.from_successors(
        successors.reshape(shape),
        probabilities.reshape(shape).astype(dtype),
        features,
        **options,
    )


@dataclass(frozen=True)
class PairNames:
    """Names for error messages, looked up one at a time (a million states need no million names)."""

    labels: Labels

    def state(self, s: int) -> str:
        """Return the name of a state, with its number."""
        return f"{shortened(self.labels.states[s])} ({s})" if self.labels.states else f"{int(s)}"

    def action(self, a: int) -> str:
        """Return the name of an action, with its number."""
        return f"{shortened(self.labels.actions[a])} ({a})" if self.labels.actions else f"{int(a)}"

    def feature(self, k: int) -> str:
        """Return the name of a feature, with its number."""
        return f"{shortened(self.labels.features[k])} ({k})" if self.labels.features else f"{int(k)}"

    def pair(self, s: int, a: int) -> str:
        """Return the names of a state-action pair."""
        return f"state {self.state(s)}, action {self.action(a)}"


def _checked_labels(
    states: Sequence[str] | None,
    actions: Sequence[str] | None,
    features: Sequence[str] | None,
    n_states: int,
    n_actions: int,
    feature_array: np.ndarray,
) -> Labels:
    sizes = {
        "state": n_states,
        "action": n_actions,
        "feature": feature_array.shape[-1] if feature_array.ndim else 0,
    }
    given = {
        kind: None if names is None else tuple(str(name) for name in names)
        for kind, names in (("state", states), ("action", actions), ("feature", features))
    }
    for kind, names in given.items():
        if names is None:
            continue
        if len(names) != sizes[kind]:
            raise ValueError(f"{len(names)} {kind} names were given for {sizes[kind]} {kind}s")
        # Lone surrogates cannot be written to any file or terminal.
        if not all(name.isascii() or _SURROGATE.search(name) is None for name in names):
            wrong = next(name for name in names if _SURROGATE.search(name))
            raise ValueError(f"{kind} names must be text; got {shortened(wrong)}, half a character")
        if len(set(names)) != len(names):
            repeated = [name for name, count in Counter(names).items() if count > 1]
            raise ValueError(f"{kind} names must differ; repeated: {listed(repeated)}")
    return Labels(*given.values())


def _check_transitions(
    successors: np.ndarray,
    probabilities: np.ndarray,
    available: np.ndarray,
    n_states: int,
    name: PairNames,
    tolerance: float,
) -> None:
    mask = available[..., None]
    probabilities = np.where(mask, probabilities, 0.0)
    if not np.isfinite(probabilities).all():
        s, a, _ = np.argwhere(~np.isfinite(probabilities))[0]
        raise ValueError(f"a transition probability of {name.pair(s, a)} is not a number")
    if (probabilities < 0).any():
        s, a, b = np.argwhere(probabilities < 0)[0]
        raise ValueError(
            f"a transition probability of {name.pair(s, a)} is negative: {probabilities[s, a, b]}"
        )
    with np.errstate(over="ignore"):
        total = probabilities.sum(-1)
    wrong = available & (np.abs(total - 1) > tolerance)
    if wrong.any():
        s, a = np.argwhere(wrong)[0]
        raise ValueError(
            f"transition probabilities must sum to 1; those of {name.pair(s, a)} sum to {total[s, a]}"
        )
    outside = ((successors < 0) | (successors >= n_states)) & (probabilities > 0)
    if outside.any():
        s, a, b = np.argwhere(outside)[0]
        raise ValueError(
            f"{name.pair(s, a)} leads to state {successors[s, a, b]}, but states are 0 to {n_states - 1}"
        )


def _inflow(successors: np.ndarray, available: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """List the pairs and entries that lead to each state, those of probability zero included."""
    n_states, _, width = successors.shape
    if n_states > _MAX_INFLOW_STATES:
        return None
    source = np.flatnonzero(np.repeat(available.ravel(), width))
    target = successors.ravel()[source]
    order = np.argsort(target, kind="stable")
    source, target = source[order], target[order]
    counts = np.bincount(target, minlength=n_states)
    most = max(int(counts.max(initial=0)), 1)
    if most > _MAX_INFLOW_RATIO * max(len(source) / n_states, 1):
        return None
    slot = np.arange(len(source)) - np.repeat(np.cumsum(counts) - counts, counts)
    pairs = np.zeros((n_states, most), np.int32)
    slots = np.full((n_states, most), -1, np.int32)
    pairs[target, slot] = source // width
    slots[target, slot] = source
    return pairs, slots
