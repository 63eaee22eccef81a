"""SSRR: rewards regressed on performance under noisy actions (Chen, Paleja and Gombolay 2020).

The baseline of robust-AIRL (section 7.3) has four steps. Noisy-AIRL learns a policy and a first reward from
the demonstration. That policy, acting at twenty levels of noise, shows how the first reward falls with the
noise (:func:`fit_noise_curve`). Networks are then regressed on the value that the curve gives each snippet of
these trajectories (:mod:`~i2rl.inference.adversarial.snippets`), and a second policy is learned from their
mean. Only the first step uses the demonstration, so the learned reward can be better than the expert's
behaviour, and can be far from the expert's reward (section 2.3.3).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.optimize import isotonic_regression, least_squares

from ...models.inputs.arguments import as_key
from ...models.inputs.display import shown_briefly
from ...models.networks.environment import Environment, HostEnvironment, Rollout
from ...models.networks.modules import DTYPE, ShapedReward
from ...models.observation.recordings import Recording
from ..sessions.learner import Learner
from .discriminator import Discriminator
from .learner import AdversarialInfo, AdversarialState, action_log_likelihood
from .noise_injection import NoisyRollout, NoisyTraining, noisy_airl, roll_out_noisily
from .policy_optimisation import PPO, PPOState
from .rollouts import begin, finished_returns
from .snippets import Ranked, Regression, SSRRReward, snippet_regression
from .truth import reported_steps

# -- performance against noise ----------------------------------------------------------------------------

LEAST = np.array([-0.5, -1.0, 1e-6, -200.0])
MOST = np.array([1.5, 1.0, 2.0, -1e-3])
_STARTS = [(x0, 0.0, 1.0, k) for x0 in (0.1, 0.4, 0.7) for k in (-3.0, -15.0)]


@shown_briefly
class NoiseCurve(NamedTuple):
    """Performance as a decreasing function of the noise in the actions.

    Fields
    ------
    levels : float ``[E]``
        Probabilities of a random action.
    scores : float ``[E]``
        Measured performance, scaled to [0, 1].
    values : float ``[E]``
        The fitted curve at the levels.
    parameters : float ``[4]``
        ``x0, y0, c, k`` of the sigmoid ``c / (1 + exp(-k (eps - x0))) + y0``.
    sigmoid : bool
        True if ``values`` are the sigmoid's, False if they are the best decreasing curve's.
    explained : float
        Share of the scores' variance that ``values`` explain; 0 if the scores do not fall with the noise
        (the first reward then carries no information, and neither does the regression).
    """

    levels: Float[np.ndarray, " E"]
    scores: Float[np.ndarray, " E"]
    values: Float[np.ndarray, " E"]
    parameters: Float[np.ndarray, "4"]
    sigmoid: Bool[np.ndarray, ""]
    explained: Float[np.ndarray, ""]


def sigmoid_curve(
    levels: Float[np.ndarray, "..."], parameters: Float[np.ndarray, "4"]
) -> Float[np.ndarray, "..."]:
    """Evaluate ``c / (1 + exp(-k (eps - x0))) + y0`` with the parameters ``x0, y0, c, k``."""
    x0, y0, c, k = parameters
    return c / (1 + np.exp(-k * (np.asarray(levels) - x0))) + y0


def _sigmoid_slopes(levels: Float[np.ndarray, " E"], parameters: Float[np.ndarray, "4"]) -> np.ndarray:
    x0, _, c, k = parameters
    share = 1 / (1 + np.exp(-k * (levels - x0)))
    steep = c * share * (1 - share)
    return np.stack([-k * steep, np.ones_like(levels), share, (levels - x0) * steep], 1)


def fit_noise_curve(
    levels: Float[np.ndarray, " E"], returns: Float[np.ndarray, " E"], loss: float = 0.05
) -> NoiseCurve:
    """Fit a falling sigmoid to mean returns at levels of noise, scaled to [0, 1].

    Least squares from six starts within ``x0 in [-.5, 1.5]``, ``y0 in [-1, 1]``, ``c in (0, 2]`` and
    ``k in [-200, 0)``: without bounds, as released, most published fits have no sigmoid shape (heights of 50
    to 2000 above floors as deep). The best decreasing curve (isotonic regression) replaces the sigmoid if it
    explains more of the scores' variance by more than ``loss``.

    Raises ``ValueError`` for levels outside [0, 1] or not increasing, fewer than four of them, returns of
    another shape, or numbers that are not finite (naming the level).
    """
    levels, returns = np.asarray(levels, float), np.asarray(returns, float)
    if levels.ndim != 1 or returns.shape != levels.shape or len(levels) < 4:
        raise ValueError(
            "a noise curve needs at least four levels and one return each, got the shapes "
            f"{levels.shape} and {returns.shape}"
        )
    if not (np.all(np.diff(levels) > 0) and levels[0] >= 0 and levels[-1] <= 1):
        raise ValueError(f"levels of noise are probabilities in increasing order, got {levels}")
    if not np.isfinite(returns).all():
        i = int(np.flatnonzero(~np.isfinite(returns))[0])
        raise ValueError(f"the return at noise level {levels[i]:g} is {returns[i]}, not finite")
    spread = returns.max() - returns.min()
    scores = (returns - returns.min()) / spread if spread > 0 else np.zeros_like(returns)

    fits = [
        least_squares(
            lambda p: sigmoid_curve(levels, p) - scores,
            start,
            lambda p: _sigmoid_slopes(levels, p),
            bounds=(LEAST, MOST),
            max_nfev=200,
        )
        for start in _STARTS
    ]
    best = min(fits, key=lambda fit: fit.cost)
    falling = isotonic_regression(scores, increasing=False).x
    total = np.sum((scores - scores.mean()) ** 2)
    left_by_falling = np.sum((falling - scores) ** 2)
    sigmoid = 2 * best.cost - left_by_falling <= loss * total + 1e-9
    left = 2 * best.cost if sigmoid else left_by_falling
    return NoiseCurve(
        levels,
        scores,
        sigmoid_curve(levels, best.x) if sigmoid else falling,
        best.x,
        np.asarray(sigmoid),
        np.asarray(max(0.0, 1 - left / total) if total > 0 else 0.0),
    )


AVERAGES: dict[str, Callable[..., np.ndarray]] = {"mean": np.mean, "median": np.median}


def rank(
    environment: Environment | HostEnvironment,
    acting: PPOState,
    network: ShapedReward,
    levels: Float[np.ndarray, " E"],
    trajectories: int,
    key: Array,
    average: str = "mean",
) -> tuple[NoiseCurve, Ranked]:
    """Run a policy with noise, and rank each trajectory by its level of noise alone.

    Each level has ``trajectories`` whole episodes, scored by the sum of the state rewards ``network``; after
    a termination the reward of the absorbing state fills the remaining steps. The curve is fitted to their
    ``average`` at each level, "mean" or "median".
    """
    k_start, k_roll = jax.random.split(key)
    each = np.repeat(levels, trajectories)
    _, noisy = roll_out_noisily(
        environment,
        acting.policy,
        acting.critic,
        begin(environment, k_start, len(each)),
        each,
        k_roll,
        environment.horizon,
    )
    scores, lengths = _scored(network, noisy)
    of_level = np.asarray(scores, float).reshape(-1, trajectories)
    curve = fit_noise_curve(levels, AVERAGES[average](of_level, 1))
    observations = jnp.swapaxes(noisy.rollout.observations, 0, 1)
    return curve, Ranked(observations, lengths, jnp.asarray(np.repeat(curve.values, trajectories), DTYPE))


@jax.jit
def _scored(network: ShapedReward, noisy: NoisyRollout) -> tuple[Float[Array, " n"], Int[Array, " n"]]:
    """Return the summed rewards and the length of the first episode in each environment."""
    steps = noisy.steps("executed")
    done = noisy.rollout.terminated | noisy.rollout.truncated
    live = jnp.cumsum(done, 0) - done == 0
    lengths = live.sum(0)
    left = jnp.where((live & steps.terminated).any(0), len(live) - lengths, 0)
    earned = jnp.where(live, network(steps.observations, network.actions.clip(steps.actions)), 0).sum(0)
    return earned + left * network.absorbing, lengths


# -- the learner ------------------------------------------------------------------------------------------


STARTS = ("scratch", "first")


class SSRRTraining(NamedTuple):
    """Settings of a session's training, after noisy-AIRL.

    Fields
    ------
    levels : probabilities of a random action for the first policy's episodes, in increasing order.
        Scores are scaled by the least. If a robot falls, the first reward may plunge outside its training
        states, and the highest levels leave no difference among the others (for Hopper the released end at
        0.75)
    trajectories : int, episodes at each level
    regression : Regression
    iterations : int, of the second policy, in a session
    average : "mean" (as released) or "median", of the scores at a level; a plunge of the first reward in one
        episode moves the mean of five far
    start : "scratch" (as released, with a million steps and more) or "first", the initial second policy:
        untrained, or a copy of the first after the first session
    """

    levels: Sequence[float] = tuple(0.05 * i for i in range(20))
    trajectories: int = 5
    regression: Regression = Regression()
    iterations: int = 10
    average: str = "mean"
    start: str = "scratch"

    def checked(self) -> SSRRTraining:
        """Validate the settings and return them. Raises ``ValueError`` naming an invalid field."""
        for name in ("trajectories", "iterations"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.average not in AVERAGES:
            raise ValueError(f"average is one of {', '.join(AVERAGES)}, got {self.average!r}")
        if self.start not in STARTS:
            raise ValueError(f"the second policy starts from one of {', '.join(STARTS)}, got {self.start!r}")
        fit_noise_curve(np.array(self.levels), np.zeros(len(self.levels)))
        self.regression.checked()
        return self


@shown_briefly
class SSRRState(NamedTuple):
    """State that is carried from session to session.

    Fields
    ------
    session : int
    key : random key
    first : AdversarialState, noisy-AIRL's
    network : SSRRReward, the learned reward
    optimiser : state of its Adam
    generator : PPOState of the second policy, the learned one
    """

    session: Int[Array, ""]
    key: Array
    first: AdversarialState
    network: SSRRReward
    optimiser: Any
    generator: PPOState

    @property
    def weights(self) -> Float[np.ndarray, " P"]:
        """All parameters of the ensemble in one vector."""
        return np.concatenate([np.ravel(x) for x in jax.tree.leaves(self.network.members)])


@shown_briefly
class SSRRInfo(NamedTuple):
    """Measures of a session.

    Fields
    ------
    session : int
    log_likelihood : float
        Log-likelihood of the expert's observed actions under the second policy, nats per step.
    curve : NoiseCurve
    loss, held_out : float ``[members]``
        Mean squared errors of the regression: on its last batch, and on snippets held out.
    returns : float ``[iterations]``
        Mean return, by the environment's own reward, of the episodes that the second policy finished; NaN
        if none ended. Learning does not use it.
    first : AdversarialInfo, noisy-AIRL's
    pairs, environment_steps : int
        Observed pairs, and steps of both policies and the ranking, in all sessions so far.
    iterations : int
        Iterations of both policies in this session.
    seconds : float
    weights : float ``[P]``
    """

    session: int
    log_likelihood: float
    curve: NoiseCurve
    loss: Float[np.ndarray, " members"]
    held_out: Float[np.ndarray, " members"]
    returns: Float[np.ndarray, " rounds"]
    first: AdversarialInfo
    pairs: int
    environment_steps: int
    iterations: int
    seconds: float
    weights: Float[np.ndarray, " P"]


def ssrr(
    agent: PPO,
    discriminator: Discriminator,
    noisy: NoisyTraining | None = None,
    training: SSRRTraining | None = None,
    configuration: Mapping[str, Any] | None = None,
) -> Learner:
    """Build SSRR as a learner of the session protocol; its demonstrations are :class:`Recording`.

    A session is one of noisy-AIRL (see :func:`~i2rl.inference.adversarial.noise_injection.noisy_airl` for the
    first three parameters), a ranking by noise, a regression and some iterations of a second policy with the
    regressed reward. Both policies, both rewards and their optimisers continue from the session before; the
    demonstrations and the ranked trajectories are discarded. The published method uses SAC and episodes that
    do not end early; here ``agent`` improves both policies.

    See Also
    --------
    i2rl.inference.noisy_airl : the first part of each session

    Examples
    --------
    >>> from i2rl.domains import cart_pole
    >>> from i2rl.inference import ppo, ssrr
    >>> from i2rl.inference.adversarial.discriminator import airl_discriminator
    >>> agent = ppo(cart_pole(), n_envs=10, n_steps=8, minibatch=8)
    >>> discriminator = airl_discriminator(4, agent.environment.actions, state_only=True)
    >>> learner = ssrr(agent, discriminator)
    >>> learner.name, learner.mdp.name
    ('SSRR', 'cart-pole')
    """
    environment, settings = agent.environment, agent.settings
    how = (training or SSRRTraining()).checked()
    levels = np.array(how.levels)
    first = noisy_airl(agent, discriminator, noisy)
    remember, regress = snippet_regression(how.regression)
    ranking_steps = len(levels) * how.trajectories * environment.horizon

    @jax.jit
    def rewarded(network: SSRRReward, rollout: Rollout) -> Float[Array, "T n"]:
        return network(rollout.observations)

    def init(key: Array) -> SSRRState:
        k_first, k_network, k_agent, key = jax.random.split(as_key(key), 4)
        network = SSRRReward.create(k_network, environment.observation_size, how.regression)
        return SSRRState(
            session=jnp.zeros((), jnp.int64),
            key=key,
            first=first.init(k_first),
            network=network,
            optimiser=remember(network),
            generator=agent.init(k_agent),
        )

    def update(state: SSRRState, recording: Recording) -> tuple[SSRRState, SSRRInfo]:
        began = time.perf_counter()
        key, k_rank, k_regress = jax.random.split(state.key, 3)
        imitated: AdversarialInfo
        imitation, imitated = first.update(state.first, recording)  # type: ignore[arg-type]
        curve, ranked = rank(
            environment, imitation.generator, imitation.network, levels, how.trajectories, k_rank, how.average
        )
        network, memory, fit = regress(state.network, state.optimiser, ranked, k_regress)
        acting, returns = state.generator, []
        if how.start == "first" and state.session == 0:
            acting = acting._replace(policy=imitation.generator.policy)
        for _ in range(how.iterations):
            before = acting.running
            acting, rollout = agent.collect(acting)
            acting = agent.improve(acting, rollout, rewarded(network, rollout))
            finished = finished_returns(before, rollout)
            returns.append(finished.mean() if len(finished) else np.nan)
        state = SSRRState(state.session + 1, key, imitation, network, memory, acting)
        session = int(state.session)
        info = SSRRInfo(
            session=session,
            log_likelihood=float(action_log_likelihood(acting.policy, reported_steps(recording))),
            curve=curve,
            loss=np.asarray(fit.trained, np.float64),
            held_out=np.asarray(fit.held_out, np.float64),
            returns=np.asarray(returns, np.float64),
            first=imitated,
            pairs=imitated.pairs,
            environment_steps=imitated.environment_steps
            + session * (ranking_steps + how.iterations * settings.steps),
            iterations=imitated.iterations + how.iterations,
            seconds=time.perf_counter() - began,
            weights=state.weights,
        )
        return state, info

    known = {**first.configuration, "ssrr": how._replace(regression=how.regression._asdict())._asdict()}  # type: ignore[arg-type]
    return Learner("SSRR", first.mdp, {**known, **dict(configuration or {})}, init, update)  # type: ignore[arg-type]
