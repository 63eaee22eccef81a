"""Chains of NUTS: their starts, the run of one, and the parallel run of several.

They are for densities over unconstrained sites, whose meaning and output the caller defines.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, TypedDict, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from numpyro.infer import NUTS
from numpyro.infer.hmc import HMCState
from scipy import optimize

from ...models.inputs.display import shown_briefly

# Largest ratio of the axes of NUTS's initial metric: the curvature at the mode does not show how far a prior
# with a kink or a saturated likelihood reaches.
_MAX_STRETCH = 10.0

Drawn = TypeVar("Drawn")


class Sampling(NamedTuple):
    """Lengths and number of NUTS's chains, and NumPyro's settings of the sampler."""

    draws: int = 500
    warmup: int = 300
    chains: int = 4
    target_accept: float = 0.9
    max_tree_depth: int = 10

    def but(self, options: SamplingOptions) -> Sampling:
        """Return these settings with some replaced; ``TypeError`` for an unknown option."""
        fields: dict[str, Any] = {**self._asdict(), **options}
        return Sampling(**fields)

    def checked(self) -> Sampling:
        """Return the settings; ``ValueError`` for numbers of draws or chains below one."""
        for name, least in (("draws", 1), ("chains", 1), ("warmup", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} must be at least {least}, got {getattr(self, name)}")
        return self


class SamplingOptions(TypedDict, total=False):
    """:class:`Sampling` as keyword arguments."""

    draws: int
    warmup: int
    chains: int
    target_accept: float
    max_tree_depth: int


@shown_briefly
class Transitions(NamedTuple):
    """Statistics of NUTS for each draw of a chain.

    Fields
    ------
    lp : float ``[draws]``
        Log-density of the unconstrained sites, up to the evidence.
    energy, acceptance_rate, step_size : float ``[draws]``
    n_steps : int ``[draws]``
        Leapfrog steps.
    diverging : bool ``[draws]``
    """

    lp: Float[Array, " draws"]
    energy: Float[Array, " draws"]
    acceptance_rate: Float[Array, " draws"]
    step_size: Float[Array, " draws"]
    n_steps: Int[Array, " draws"]
    diverging: Bool[Array, " draws"]


def run_nuts(
    key: Array,
    kernel: NUTS,
    start: Any,
    constrain: Callable[[Any], Drawn],
    warmup: int,
    draws: Any,
    room: int | None = None,
) -> tuple[Drawn, Transitions]:
    """Run one chain of NUTS; traceable, so that chains and replications can be mapped over.

    Parameters
    ----------
    key : JAX random key
    kernel : numpyro.infer.NUTS
        Made with a ``potential_fn``; each call needs its own kernel, since a kernel stores its set-up.
    start : array, or pytree of arrays
        Unconstrained sites.
    constrain : function
        Function from unconstrained sites to the stored form of a draw, an array or a pytree of arrays; draws
        of ``warmup`` are stored too, until the chain ends.
    warmup, draws : int
        Draws discarded, in which the kernel adapts, and draws returned.
    room : int, optional
        Makes ``draws`` a number that JAX may trace, at most ``room``: one compiled chain then serves every
        number of draws up to it.

    Returns
    -------
    drawn : as ``constrain`` returns, with a leading axis ``[draws]``, or ``[room]``, filled up to ``draws``
    transitions : Transitions
    """

    @jax.jit  # traced once, though the shapes of what it returns are asked for
    def advance(state: HMCState, _: None) -> tuple[HMCState, tuple[Drawn, Transitions]]:
        state = kernel.sample(state, (), {})
        return state, (
            constrain(state.z),
            Transitions(
                lp=-state.potential_energy,
                energy=state.energy,
                acceptance_rate=state.accept_prob,
                step_size=state.adapt_state.step_size,
                n_steps=state.num_steps,
                diverging=state.diverging,
            ),
        )

    state = kernel.init(key, warmup, start, (), {})
    if room is not None:
        shapes = jax.eval_shape(advance, state, None)[1]
        empty = jax.tree.map(lambda x: jnp.zeros((room, *x.shape), x.dtype), shapes)

        def keep(i: Int[Array, ""], carry: tuple) -> tuple:
            state, kept = carry
            state, new = advance(state, None)
            # The first place is written in the warm-up too, and keeps the first draw after it.
            place = jnp.maximum(i - warmup, 0)
            return state, jax.tree.map(lambda xs, x: xs.at[place].set(x), kept, new)

        return lax.fori_loop(0, warmup + draws, keep, (state, empty))[1]
    # One scan, its beginning dropped: two would each trace and compile the whole sampler.
    chain = lax.scan(advance, state, None, warmup + draws)[1]
    return jax.tree.map(lambda x: x[warmup:], chain)


def room_for(number: int, least: int = 8) -> int:
    """Round a size up to one of few, by a quarter at most: programs are then compiled for few shapes."""
    step = max(2 ** (max(number - 1, 1).bit_length() - 3), 1)
    return max(-(-number // step) * step, least)


def in_threads(run: Callable[..., Drawn], arguments: Sequence[tuple]) -> Drawn:
    """Call ``run`` with each of ``arguments``, in as many threads as there are processors; stack the results.

    Threads rather than ``vmap``: mapped chains would wait for the longest tree, and solves do not batch.
    """
    with ThreadPoolExecutor(min(len(arguments), os.cpu_count() or 1)) as pool:
        jobs = [pool.submit(lambda xs: jax.block_until_ready(run(*xs)), xs) for xs in arguments]
        return jax.tree.map(lambda *xs: np.stack(xs), *[job.result() for job in jobs])


@shown_briefly
class Mode(NamedTuple):
    """Start of NUTS: the mode of the unconstrained density and a covariance from its curvature."""

    position: Float[np.ndarray, " D"]
    covariance: Float[np.ndarray, "D D"]


def mode_of(
    value_and_gradient: Callable[[np.ndarray], tuple[Any, Any]], origin: Float[np.ndarray, " D"]
) -> Mode:
    """Climb from ``origin`` to a mode (L-BFGS) and measure its curvature by differences of gradients.

    ``value_and_gradient`` is of the negative log-density. The covariance is the inverse curvature, except
    that no axis is longer than ten times the shortest: flatter or negative curvature is clipped to that.
    """

    def objective(x: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = value_and_gradient(x)
        return float(value), np.asarray(gradient)

    mode = optimize.minimize(objective, origin, jac=True, method="L-BFGS-B").x
    offsets = 1e-4 * np.eye(len(mode))
    curvature = np.stack([objective(mode + h)[1] - objective(mode - h)[1] for h in offsets]) / 2e-4
    scales, axes = np.linalg.eigh((curvature + curvature.T) / 2)
    scales = np.maximum(scales, max(scales.max() / _MAX_STRETCH**2, 1e-8))
    return Mode(mode, (axes / scales) @ axes.T)
