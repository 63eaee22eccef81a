"""Adversarial learners of tabular tasks, with exact expert and exact generator (chapter 6.2).

AIRL and GAIL in the session protocol. Both sides of the discriminator are weights on transitions: the
expert's are the posterior of the hidden truth given the observations, under the current policy; the
generator's are the occupancy of that policy. All expectations are exact, so hidden steps and noise, alone or
together, need no special treatment. The generator's step is a soft plan, not a policy gradient.

Sessions carry networks, optimiser, policy and key, as in the dissertation (``theta^{i-1}`` and
``theta_gen^{i-1}``). Later sessions soon overwrite their content, so a statistic of the expert's transitions
is carried as well by default (``memory``).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from ....extras import required
from ....models.inputs.arguments import as_key
from ....models.networks.modules import DTYPE
from ....models.observation.demonstration import Demonstration, DemonstrationError
from ....models.observation.evidence import (
    AnySensor,
    Sensor,
    checked_demonstration,
    fitting_sensor,
    require_possible,
)
from ....models.process.mdp import TabularMDP
from ....models.process.planning import require_discounted
from ...completion.smoothing import evidence_of
from ...completion.transitions import (
    Completed,
    Settling,
    TransitionStatistic,
    exact_transitions,
    gibbs_transitions,
    reported_transitions,
    summarised,
    wide_successors,
)
from ...sensors.confusions import ConfusionNoise, ConfusionStatistic, confusion_counts, fitted_confusions
from ...sessions.learner import Learner, digest_of, in_plain_numbers
from ...sessions.statistic import blend
from .discriminator import (
    AVERAGES,
    Losses,
    Sides,
    TabularDiscriminator,
    cross_entropy,
    proximal_plan,
    tabular_airl,
    tabular_gail,
)
from .training import (
    OCCUPANCIES,
    TabularAdversarialInfo,
    TabularAdversarialState,
    TabularTraining,
)

if TYPE_CHECKING:
    import optax
else:
    optax = required("optax")


# -- learners -----------------------------------------------------------------------------------------


def airl_tabular(mdp: TabularMDP, **options: Any) -> Learner:
    """Build online AIRL that takes observations for the truth and leaves out hidden steps.

    A session of hidden steps alone changes nothing. Options as for :func:`robust_airl_tabular`.

    See Also
    --------
    i2rl.inference.robust_airl_tabular : infers the truth behind the observations
    i2rl.inference.airl : the learner of continuous tasks

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import airl_tabular
    >>> corridor = five_cells()
    >>> learner = airl_tabular(corridor.mdp, iterations=2, horizon=8)
    >>> state, info = learner.update(learner.init(jax.random.key(0)), corridor.demonstration)
    >>> learner.name, info.session
    ('AIRL', 1)
    """
    return _at_face_value("AIRL", mdp, tabular_airl, _AIRL, options)


def robust_airl_tabular(mdp: TabularMDP, sensor: AnySensor, **options: Any) -> Learner:
    """Build robust-AIRL with the exact posterior of the truth behind the observations.

    Parameters
    ----------
    mdp : TabularMDP
        The expert's process without its reward; discount below 1.
    sensor : Sensor
        Visibility, noise, or both.
    **options
        Fields of :class:`TabularTraining`; ``features``, float ``[S, d]``, the networks' view of a state
        (one-hot by default); ``network``, a mapping of hidden layers: ``reward`` and ``potential`` of AIRL
        (32; 32, 32), ``hidden`` of GAIL (64, 8).

    Returns
    -------
    Learner
        Its ``update`` raises :class:`DemonstrationError` naming trajectory and step for an impossible
        observation, and for trajectories above the horizon; the given state stays valid.

    Raises
    ------
    ValueError
        For discount 1, a sensor for another task, features of another shape, or an invalid option.

    See Also
    --------
    i2rl.inference.airl_tabular : takes observations for the truth
    i2rl.inference.robust_airl : the learner of continuous tasks

    Examples
    --------
    >>> import jax
    >>> from i2rl.domains import five_cells
    >>> from i2rl.inference import robust_airl_tabular
    >>> corridor = five_cells()
    >>> learner = robust_airl_tabular(corridor.mdp, corridor.sensor, iterations=2, horizon=8)
    >>> state, info = learner.update(learner.init(jax.random.key(0)), corridor.demonstration)
    >>> learner.name, info.session
    ('robust-AIRL', 1)
    """
    return _in_expectation("robust-AIRL", mdp, sensor, tabular_airl, _AIRL, options)


def gibbs_airl_tabular(
    mdp: TabularMDP,
    sensor: AnySensor,
    *,
    draws: int = 20,
    burn_in: int = 20,
    change: float = 0.0,
    **options: Any,
) -> Learner:
    """Build robust-AIRL as in Algorithm 3: ``draws`` of the single-site sampler in every iteration.

    Sampling stops earlier if one more draw moves the average logit of a step by at most ``change`` (the mean
    over steps of its absolute change); 0 never stops early. The dissertation's ``delta_G`` is the sum over a
    batch and as many generated steps: its .1 with 1,024 steps is a ``change`` of 1e-4 here.
    """
    if draws < 1 or burn_in < 0:
        raise ValueError(f"a sampler needs at least one draw and no negative burn-in, got {draws}, {burn_in}")
    if not change >= 0:
        raise ValueError(f"change must not be negative, got {change}")
    sensor = fitting_sensor(sensor, mdp)

    def truth(
        key: Array, log_policy: Array, evidence: Any, seen: Demonstration, horizon: int, logits: Array
    ) -> Completed:
        settling = Settling(logits, change) if change else None
        return gibbs_transitions(key, mdp, log_policy, evidence, horizon, draws, burn_in, settling)

    settings = {
        "truth": "gibbs",
        "draws": draws,
        "burn_in": burn_in,
        "change": change,
        "sensor": digest_of(sensor),
    }
    look = _Look(truth, np.asarray(mdp.successors), sensor)
    return _learner("robust-AIRL, Gibbs", mdp, look, tabular_airl, _AIRL, options, settings)


def robust_airl_with_learned_sensor(
    mdp: TabularMDP,
    assumed: ConfusionNoise,
    *,
    visibility: AnySensor | None = None,
    trust: float = 2.0,
    **options: Any,
) -> Learner:
    """Build robust-AIRL that learns the probability of each confusion, by expectation-maximisation.

    ``assumed`` lists the possible confusions; its probabilities are the starting point, and count as
    ``trust`` observations of each. ``visibility`` is the sensor's visibility. Other options as for
    :func:`robust_airl_tabular`.
    """
    if not trust > 0:
        raise ValueError(f"trust in the assumed probabilities must be positive, got {trust}")
    visibility = None if visibility is None else fitting_sensor(visibility, mdp)
    if visibility is not None and visibility.noise is not None:
        raise ValueError("the visibility says what is hidden; how reports err is learned, not given")
    noise = np.asarray(assumed.chances)
    for m in np.flatnonzero(~((noise > 0) & (noise < 1))):
        raise ValueError(f"learning starts from probabilities in (0, 1); that of confusion {m} is {noise[m]}")
    sensor = fitting_sensor(Sensor(None if visibility is None else visibility.visibility, assumed.noise), mdp)
    known: Any = (assumed, visibility)
    settings = {"truth": "exact, sensor learned", "trust": trust, "sensor": digest_of(known)}
    look = _Look(_exact(mdp), np.asarray(mdp.successors), sensor, assumed, trust)
    return _learner("robust-AIRL, sensor learned", mdp, look, tabular_airl, _AIRL, options, settings)


def gail_tabular(mdp: TabularMDP, **options: Any) -> Learner:
    """Build online GAIL that takes observations for the truth and leaves out hidden steps (section 7.4.1).

    Its reward vanishes where the generator succeeds, so that an infinite step would undo the learning:
    ``step`` must be finite. Options as for :func:`robust_airl_tabular`.
    """
    return _at_face_value("GAIL", mdp, tabular_gail, _GAIL, options)


def robust_gail_tabular(mdp: TabularMDP, sensor: AnySensor, **options: Any) -> Learner:
    """Build GAIL on the exact posterior of the truth; options as for :func:`robust_airl_tabular`."""
    return _in_expectation("robust-GAIL", mdp, sensor, tabular_gail, _GAIL, options)


_AIRL = TabularTraining()
_GAIL = TabularTraining(entropy=0.01, step=0.1)


class _Look(NamedTuple):
    """Completion of observations: the truth behind them, as weights on ``successors [S, A, U]``.

    ``truth(key, log_policy, evidence, seen, horizon, logits)``.
    """

    truth: Callable[[Array, Float[Array, "S A"], Any, Demonstration, int, Float[Array, "S A U"]], Completed]
    successors: np.ndarray
    sensor: AnySensor | None
    learned: ConfusionNoise | None = None
    trust: float = 0.0


def _exact(mdp: TabularMDP) -> Callable[..., Completed]:
    def truth(
        key: Array, log_policy: Array, evidence: Any, seen: Demonstration, horizon: int, logits: Array
    ) -> Completed:
        return exact_transitions(mdp, log_policy, evidence, horizon)

    return truth


def _in_expectation(
    name: str,
    mdp: TabularMDP,
    sensor: AnySensor,
    kind: Callable[..., TabularDiscriminator],
    defaults: TabularTraining,
    options: Mapping[str, Any],
) -> Learner:
    sensor = fitting_sensor(sensor, mdp)
    look = _Look(_exact(mdp), np.asarray(mdp.successors), sensor)
    settings = {"truth": "exact", "sensor": digest_of(sensor)}
    return _learner(name, mdp, look, kind, defaults, options, settings)


def _at_face_value(
    name: str,
    mdp: TabularMDP,
    kind: Callable[..., TabularDiscriminator],
    defaults: TabularTraining,
    options: Mapping[str, Any],
) -> Learner:
    successors = wide_successors(mdp)

    def truth(
        key: Array, log_policy: Array, evidence: Any, seen: Demonstration, horizon: int, logits: Array
    ) -> Completed:
        return reported_transitions(mdp, jnp.asarray(successors), log_policy, seen, horizon)

    return _learner(name, mdp, _Look(truth, successors, None), kind, defaults, options, {"truth": "reports"})


# -- a session ----------------------------------------------------------------------------------------


def _learner(
    name: str,
    mdp: TabularMDP,
    look: _Look,
    kind: Callable[..., TabularDiscriminator],
    defaults: TabularTraining,
    options: Mapping[str, Any],
    settings: Mapping[str, Any],
) -> Learner:
    require_discounted(mdp)
    chosen = dict(options)
    features = _checked_features(mdp, chosen.pop("features", None))
    layers = dict(chosen.pop("network", None) or {})
    unknown = set(chosen) - set(TabularTraining._fields)
    if unknown:
        raise ValueError(
            f"there is no option {sorted(unknown)[0]!r}; options are features, network, "
            f"{', '.join(TabularTraining._fields)}"
        )
    how = defaults._replace(**chosen).checked()
    discriminator = kind(mdp, features, **layers)
    if discriminator.name == "GAIL" and np.isinf(how.step):
        raise ValueError("the reward of GAIL vanishes where it succeeds: its step must be finite")
    optimiser = optax.adam(how.learning_rate)
    successors = jnp.asarray(look.successors)
    generated = OCCUPANCIES[how.occupancy]
    average = AVERAGES[how.average]

    def init(key: Array) -> TabularAdversarialState:
        key, fresh = jax.random.split(as_key(key))
        network = discriminator.init(fresh)
        uniform = jnp.where(mdp.available, -jnp.log(jnp.sum(mdp.available, 1, keepdims=True)), -jnp.inf)
        none = None if look.learned is None else jnp.zeros(len(look.learned.chances))
        return TabularAdversarialState(
            network,
            optimiser.init(network),
            uniform,
            jnp.zeros(mdp.n_states),
            TransitionStatistic(
                jnp.zeros(()), jnp.zeros(successors.shape), jnp.zeros((how.horizon, mdp.n_states))
            ),
            () if none is None else ConfusionStatistic(none, none),
            jnp.zeros((), int),
            key,
        )

    def session(
        state: TabularAdversarialState, demonstration: Demonstration
    ) -> tuple[TabularAdversarialState, Any]:
        given = None if look.sensor is None else evidence_of(mdp, look.sensor, demonstration)

        def complete(key: Array, network: Any, log_policy: Array, confusions: Any) -> tuple[Completed, Any]:
            """Return the truth, and the sensor's statistic with it."""
            logits = discriminator.logits(network, log_policy, successors)
            if look.learned is None:
                return look.truth(key, log_policy, given, demonstration, how.horizon, logits), confusions
            believed = look.learned._replace(chances=fitted_confusions(look.learned, confusions, look.trust))
            sensor = Sensor(look.sensor.visibility, believed.noise)  # type: ignore[union-attr]
            evidence = evidence_of(mdp, sensor, demonstration)
            completed = look.truth(key, log_policy, evidence, demonstration, how.horizon, logits)
            new = confusion_counts(believed, jnp.sum(completed.steps, -1), demonstration)
            return completed, jax.tree.map(jnp.add, state.confusions, new)

        def descend(sides: Sides, log_policy: Array, carry: tuple, _: None) -> tuple:
            network, memory = carry
            (_, met), slope = jax.value_and_grad(
                lambda net: cross_entropy(discriminator, net, log_policy, successors, sides, average),
                has_aux=True,
            )(network)
            change, memory = optimiser.update(slope, memory, network)
            return (optax.apply_updates(network, change), memory), met

        def round_(carry: tuple, key: Array) -> tuple:
            network, memory, log_policy, values, confusions = carry
            completed, confusions = complete(key, network, log_policy, confusions)
            expert = blend(state.statistic, summarised(completed), how.forgetting)
            sides = Sides(expert, completed, generated(mdp, log_policy, expert.starts))
            (network, memory), met = cast(
                tuple, lax.scan(partial(descend, sides, log_policy), (network, memory), None, how.updates)
            )
            reward = discriminator.reward(network, log_policy).astype(float)
            log_policy, values = proximal_plan(mdp, reward, log_policy, values, how.entropy, how.step)
            last = jax.tree.map(lambda x: x[-1].astype(float), met)
            return (network, memory, log_policy, values, confusions), last

        keys = jax.random.split(state.key, how.iterations + 2)
        begun = (state.network, state.optimiser, state.log_policy, state.values, state.confusions)
        carry, met = cast(tuple, lax.scan(round_, begun, keys[2:]))
        network, memory, log_policy, values, confusions = carry
        completed, confusions = complete(keys[1], network, log_policy, confusions)
        kept = blend(state.statistic, summarised(completed), how.forgetting)
        own = jnp.sum(completed.log_likelihood)
        parts = (network, memory, log_policy, values, kept, confusions, state.session + 1, keys[0])
        # Keep the previous state if the observation has probability zero; compiled fleets cannot raise.
        possible = jnp.isfinite(own)
        new = jax.tree.map(partial(_chosen, possible), TabularAdversarialState(*parts), state)
        # A session without known steps has no side to distinguish the generator from.
        unseen = state._replace(session=state.session + possible, key=keys[0])
        new = jax.tree.map(partial(_chosen, jnp.any(kept.weights > 0)), new, unseen)
        return new, _report(new, own, demonstration, met)

    def _report(new: Any, own: Array, demonstration: Demonstration, met: Losses) -> Any:
        trajectories = jnp.sum(jnp.any(jnp.asarray(demonstration.kind) != 0, axis=1))
        noise = jnp.zeros(0)
        if look.learned is not None:
            noise = fitted_confusions(look.learned, new.confusions, look.trust)
        fields: dict[str, Any] = {
            "session": new.session,
            "log_likelihood": own / jnp.maximum(trajectories, 1),
            "demonstration_log_likelihood": own,
            "iterations": how.iterations,
            "noise": noise,
            "seconds": jnp.array(jnp.nan),
            "weights": new.weights,
        }
        return TabularAdversarialInfo(**fields, **met._asdict())

    run = jax.jit(session)

    def update(
        state: TabularAdversarialState, demonstration: Demonstration
    ) -> tuple[TabularAdversarialState, Any]:
        began = time.perf_counter()
        demonstration = checked_demonstration(mdp, demonstration, needed_by="a session")
        lengths = demonstration.lengths
        if lengths.max() > how.horizon:
            raise DemonstrationError(
                f"trajectory {int(lengths.argmax())} has {lengths.max()} steps, above the learner's horizon "
                f"of {how.horizon}: cut it with Demonstration.fragments, or set horizon"
            )
        new, report = run(state, demonstration.bucketed())
        if not np.isfinite(report.demonstration_log_likelihood):
            require_possible(look.sensor or Sensor(), mdp, demonstration)
            raise DemonstrationError("a trajectory has probability zero under the current policy")
        return new, in_plain_numbers(report, time.perf_counter() - began)

    known: Any = features
    digest = {"features": digest_of(known), "network": {k: list(v) for k, v in layers.items()}}
    configuration = {"discriminator": discriminator.name, **how._asdict(), **digest, **settings}
    return Learner(name, mdp, configuration, init, update, session)


def _chosen(possible: Array, new: Array, old: Array) -> Array:
    if jax.dtypes.issubdtype(new.dtype, jax.dtypes.prng_key):
        data = jnp.where(possible, jax.random.key_data(new), jax.random.key_data(old))
        return jax.random.wrap_key_data(data, impl=jax.random.key_impl(new))
    return jnp.where(possible, new, old)


def _checked_features(mdp: TabularMDP, features: ArrayLike | None) -> Float[Array, "S d"]:
    """Scale features of states to mean zero and deviation one, or encode them one-hot."""
    if features is None:
        return jnp.eye(mdp.n_states, dtype=DTYPE)
    x = np.asarray(features, float)
    if x.ndim != 2 or len(x) != mdp.n_states or not x.shape[1]:
        raise ValueError(f"features of states have shape [S, d] = [{mdp.n_states}, d], got {list(x.shape)}")
    if not np.isfinite(x).all():
        s, k = np.argwhere(~np.isfinite(x))[0]
        raise ValueError(f"feature {k} of state {mdp.state_names[s]} is {x[s, k]}, not a number")
    spread = x.std(0)
    return jnp.asarray((x - x.mean(0)) / np.where(spread > 0, spread, 1.0), DTYPE)
