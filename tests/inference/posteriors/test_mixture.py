"""Posterior over the components of a mixture, by two samplers and by enumeration."""

from functools import partial
from typing import NamedTuple

import arviz as az
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import numpyro.distributions as dist
import pytest
from numpyro.infer.util import log_density
from scipy import integrate
from scipy.special import gammaln, logsumexp

from i2rl.analysis.benchmarks.statistics.mixture import Drawn, compare, invariant_statistics, tails
from i2rl.inference.posteriors.gibbs import gibbs_mixture_posterior, move_concentration
from i2rl.inference.posteriors.mixture import sample_mixture_posterior
from i2rl.inference.posteriors.mixture_problem import label_invariant, log_partition
from i2rl.models import Demonstration, DemonstrationError, TabularMDP, TrajectoryLaw, Visibility
from i2rl.models.laws.mixture import component_log_likelihoods, mixture_model, perceive, soft_policies

N, LENGTH, SD = 6, 6, 1.5
ALPHA = dist.Gamma(6.0, 10.0)
OPTIONS = {"components": 10, "concentration": ALPHA, "prior": dist.Normal(0.0, SD), "chains": 2}
SAMPLERS = {
    "nuts": partial(sample_mixture_posterior, **OPTIONS, draws=700, warmup=300),
    "gibbs": partial(gibbs_mixture_posterior, **OPTIONS, draws=700, warmup=50, thin=2),
}


def ring(features):
    n_states = 4
    state = np.arange(n_states)
    transitions = np.zeros((n_states, 2, n_states))
    for a, move in enumerate((1, -1)):
        transitions[state, a, (state + move) % n_states] = 0.8
        transitions[state, a, state] = 0.2
    return TabularMDP.from_dense(transitions, features, discount=0.8, feature_names=("home", "turned"))


@pytest.fixture(scope="module")
def mdp():
    features = np.zeros((4, 2, 2))
    features[0, :, 0] = 1
    features[:, 1, 1] = 1
    return ring(features)


@pytest.fixture(scope="module")
def sensor():
    return Visibility(np.array([1.0, 1.0, 1.0, 0.5]))


@pytest.fixture(scope="module")
def demonstration(mdp, sensor):
    """Simulate three trajectories of each of two components; some steps are hidden, a frame is lost, one is
    short.
    """
    codes = np.concatenate(
        [
            np.asarray(simulated(jax.random.key(seed), mdp, jnp.array(w), sensor, 3))
            for seed, w in ((2, [1.0, -3.0]), (3, [-1.0, 3.0]))
        ]
    )
    codes[1, 2] = [3, -1, -1]
    codes[4, 4:] = [0, -1, -1]
    perceived, _ = perceive(mdp, sensor, codes)
    assert len(perceived.counts) == len(perceived.live) == 8
    return Demonstration.from_codes(codes)


@pytest.fixture(scope="module")
def posteriors(mdp, sensor, demonstration):
    return {name: sample(jax.random.key(0), mdp, sensor, demonstration) for name, sample in SAMPLERS.items()}


@pytest.fixture(scope="module", params=SAMPLERS)
def idata(request, posteriors):
    return posteriors[request.param]


@partial(jax.jit, static_argnames="n")
def simulated(key, mdp, weights, sensor, n):
    return TrajectoryLaw(mdp, weights, sensor, LENGTH).sample(key, (n,))


@jax.jit
def log_probabilities(mdp, weights, sensor, codes):
    """Compute the log-probability of each trajectory under a component of its own."""
    return jax.lax.map(lambda x: TrajectoryLaw(mdp, x[0], sensor, LENGTH).log_prob(x[1]), (weights, codes))


@jax.jit
def log_likelihood(mdp, sensor, codes, sites):
    """Compute the likelihood of the declared model: its density without that of its prior."""
    options = {"components": len(sites["weights"]), "concentration": ALPHA, "prior": OPTIONS["prior"]}
    prior = ALPHA.log_prob(sites["concentration"]) + OPTIONS["prior"].log_prob(sites["weights"]).sum()
    prior += dist.Beta(1.0, sites["concentration"]).log_prob(sites["sticks"]).sum()
    return log_density(mixture_model, (mdp, sensor, codes), options, sites)[0] - prior


class Exact(NamedTuple):
    """Every partition, as labels ``[P, n]``; its log-evidence ``[P]``; mean weights in it ``[P, n, K]``."""

    partitions: np.ndarray
    log_evidence: np.ndarray
    trajectory_weights: np.ndarray


def partitions_of(n):
    labels = np.zeros((1, 1), int)
    for _ in range(n - 1):
        labels = np.array([[*row, d] for row in labels for d in range(row.max() + 2)])
    return labels


def enumerate_partitions(mdp, sensor, demonstration, log_prior, axis):
    """Enumerate the partitions; integrate each component over a grid of weights."""
    grid = jnp.stack(jnp.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    perceived, rows = perceive(mdp, sensor, demonstration.codes)
    table = jax.jit(lambda w: component_log_likelihoods(mdp, soft_policies(mdp, w), perceived))(grid)
    table = np.asarray(table)[:, rows]
    mass = np.asarray(log_prior(grid)) + 2 * np.log(axis[1] - axis[0])
    partitions = partitions_of(demonstration.n_trajectories)
    cells = {}

    def cell(members):
        if members not in cells:
            logs = mass + table[:, list(members)].sum(1)
            weight = np.exp(logs - logs.max())
            cells[members] = logsumexp(logs), weight @ np.asarray(grid) / weight.sum()
        return cells[members]

    log_evidence, means = [], []
    for labels in partitions:
        members = [tuple(np.flatnonzero(labels == d)) for d in range(labels.max() + 1)]
        log_evidence.append(sum(cell(m)[0] for m in members))
        means.append([cell(members[d])[1] for d in labels])
    return Exact(partitions, np.array(log_evidence), np.array(means))


@pytest.fixture(scope="module")
def exact(mdp, sensor, demonstration):
    def log_prior(w):
        return dist.Normal(0.0, SD).log_prob(w).sum(-1)

    return enumerate_partitions(mdp, sensor, demonstration, log_prior, np.linspace(-8.0, 8.0, 61))


CONCENTRATIONS = np.linspace(0, 4, 401)[1:] - 0.005


def process(partitions, alpha):
    """Log-probability of each partition under the Chinese restaurant process, seat by seat; ``[P, ...]``."""
    logs = np.zeros((len(partitions), *np.shape(alpha)))
    for p, labels in enumerate(partitions):
        for i, d in enumerate(labels):
            sitting = (labels[:i] == d).sum()
            logs[p] += np.log((sitting or alpha) / (i + alpha))
    return logs


def weighed(partitions, log_evidence=0.0):
    """Probability of each partition, and mean concentration."""
    logs = process(partitions, CONCENTRATIONS) + np.asarray(ALPHA.log_prob(CONCENTRATIONS))
    logs = logs + np.reshape(log_evidence, (-1, 1))
    posterior = np.exp(logs - logsumexp(logs))
    return posterior.sum(1), posterior.sum(0) @ CONCENTRATIONS


def assert_mean(draws, expected, floor=1e-3):
    """Check that the mean of draws ``(chain, draw)`` is as expected, within Monte-Carlo error."""
    draws = np.asarray(draws, float)
    if np.ptp(draws) == 0:
        assert draws.flat[0] == pytest.approx(float(expected), abs=5e-3)
        return
    error = draws.std() / np.sqrt(az.ess(draws, method="mean")) + floor
    assert abs(draws.mean() - expected) < 4.5 * error, (draws.mean(), expected, error)


def shared_ways(idata):
    components = idata.assignments.assignment.values
    return components[..., :, None] == components[..., None, :]


def test_the_process_scores_a_partition_seat_by_seat():
    partitions = partitions_of(5)
    assert len(partitions) == 52
    expected = process(partitions, 0.7)
    assert np.exp(expected).sum() == pytest.approx(1.0)
    for labels, value in zip(partitions[::7], expected[::7], strict=True):
        assert float(log_partition(jnp.bincount(labels, length=6), 0.7)) == pytest.approx(value)


def test_partitions_and_weights_agree_with_enumeration(idata, exact):
    posterior, concentration = weighed(exact.partitions, exact.log_evidence)
    together = exact.partitions[:, :, None] == exact.partitions[:, None, :]
    expected = np.einsum("p,pij->ij", posterior, together)
    assert ((expected > 0.02) & (expected < 0.98)).sum() > 10
    shared = shared_ways(idata)
    np.testing.assert_allclose(idata.assignments.co_clustering, shared.mean((0, 1)))
    for i in range(N):
        for j in range(i):
            assert_mean(shared[..., i, j], expected[i, j])
    components = exact.partitions.max(1) + 1
    for k in (1, 2, 3):
        assert_mean(idata.assignments.n_components == k, posterior[components == k].sum())
    assert_mean(idata.posterior.concentration, concentration)
    weights = np.einsum("p,pnk->nk", posterior, exact.trajectory_weights)
    drawn = label_invariant(idata).trajectory_weights
    assert drawn.dims == ("chain", "draw", "trajectory", "feature")
    for i in range(N):
        for k in range(2):
            assert_mean(drawn[..., i, k], weights[i, k])


def test_samplers_agree_on_what_does_not_depend_on_labels(posteriors):
    compared = compare(0, **posteriors)
    names = {c.name for c in compared}
    assert {"2 components", "concentration", "largest proportion"} < names
    assert sum("together" in name for name in names) > 4
    assert len(names) == len(compared) > 25
    assert tails(compared)["largest z"]["z"] == max((c.z for c in compared), key=abs)
    assert all(abs(c.z) < 4.5 for c in compared), tails(compared)["largest z"]


def test_what_is_compared_and_ranked_does_not_depend_on_labels(posteriors):
    idata = posteriors["gibbs"]
    posterior, group = idata.posterior, idata.assignments
    drawn = Drawn(
        *(posterior[name].values for name in ("weights", "proportions", "concentration")),
        group.assignment.values,
        idata.log_likelihood.demonstration.values.sum(-1),
        group.log_joint.values,
    )
    order = np.random.default_rng(0).permutation(posterior.sizes["component"])
    renamed = drawn._replace(
        weights=drawn.weights[..., order, :],
        proportions=drawn.proportions[..., order],
        assignment=np.argsort(order)[drawn.assignment],
    )
    assert (renamed.assignment != drawn.assignment).any()
    ranked = invariant_statistics(drawn, ("home", "turned"))
    for name, value in invariant_statistics(renamed, ("home", "turned")).items():
        np.testing.assert_allclose(value, ranked[name], rtol=1e-12, err_msg=name)
    np.testing.assert_array_equal(ranked["components"], group.n_components)
    together = group.co_clustering.values
    assert ranked["pairs together"].mean() == pytest.approx((together.sum() - N) / 2)


def test_a_biased_sampler_is_found_out(posteriors):
    biased = posteriors["gibbs"].copy()
    biased.posterior["concentration"] = biased.posterior.concentration + 0.1
    worst = tails(compare(0, posteriors["nuts"], biased))
    assert worst["largest z"]["name"] == "concentration"
    assert worst["chance of one as large"] < 0.001
    assert worst["beyond 3"] >= 1 > worst["expected beyond 3"]


def test_without_information_partitions_follow_the_process(demonstration, sensor):
    """Check the prior: with zero features the posterior is the prior."""
    indifferent = ring(np.zeros((4, 2, 2)))
    partitions = partitions_of(N)
    (chance, _), components = weighed(partitions), partitions.max(1) + 1
    for sample in SAMPLERS.values():
        idata = sample(jax.random.key(1), indifferent, sensor, demonstration)
        for k in range(1, 5):
            assert_mean(idata.assignments.n_components == k, chance[components == k].sum())
        assert_mean(shared_ways(idata)[..., 0, 4], chance[partitions[:, 0] == partitions[:, 4]].sum())
        assert_mean(idata.posterior.concentration, 0.6)
        assert_mean((idata.posterior.proportions**2).sum("component"), self_meeting())
        weights = label_invariant(idata).trajectory_weights.values
        assert_mean(weights[..., 0, 0], 0.0)
        assert_mean(weights[..., 3, 1] ** 2, SD**2)


def self_meeting():
    """Compute the expected sum of squared proportions: the chance that two more trajectories share a
    component.
    """
    return integrate.quad(lambda a: np.exp(float(ALPHA.log_prob(a))) / (1 + a), 0, 5)[0]


def test_identical_trajectories_are_exchangeable(mdp, sensor, demonstration, exact):
    rows = perceive(mdp, sensor, demonstration.codes)[1]
    clear, veiled = (np.flatnonzero(side)[0] for side in (rows < 8, rows >= 8))
    copies = demonstration.select([clear] * 3 + [veiled] * 3)
    for sample in SAMPLERS.values():
        idata = sample(jax.random.key(2), mdp, sensor, copies)
        assert (np.ptp(idata.log_likelihood.demonstration.values[..., :3], axis=-1) == 0).all()
        shared = shared_ways(idata)
        for i, j in ((0, 2), (1, 2)):
            assert_mean(shared[..., 0, 1].astype(float) - shared[..., i, j], 0.0)
        assert_mean(shared[..., 0, 3].astype(float) - shared[..., 2, 5], 0.0)


def test_one_trajectory_under_a_prior_on_positive_weights(mdp, sensor, demonstration):
    half, one = dist.HalfNormal(1.5), demonstration.select([1])
    axis = np.linspace(0, 7, 141)[1:] - 0.025
    exact = enumerate_partitions(mdp, sensor, one, lambda w: half.log_prob(w).sum(-1), axis)
    options = {"concentration": 0.8, "prior": half, "chains": 2, "components": 3, "draws": 500, "thin": 2}
    idata = gibbs_mixture_posterior(jax.random.key(3), mdp, sensor, one, **options)
    assert (idata.assignments.n_components == 1).all()
    assert idata.assignments.co_clustering.values == [[1.0]]
    assert "concentration" not in idata.posterior
    weights = label_invariant(idata).trajectory_weights
    for k in range(2):
        assert_mean(weights[..., 0, k], exact.trajectory_weights[0, 0, k])


def test_the_concentration_moves_towards_its_conditional():
    prior, components, n = dist.Gamma(2.0, 1.0), 3, 9

    def density(x):
        return np.exp(np.log(x) - x + components * np.log(x) + gammaln(x) - gammaln(x + n))

    total, mean = (integrate.quad(lambda x, p=p: x**p * density(x), 0, 40)[0] for p in (0, 1))
    step = jax.jit(
        lambda key: jax.lax.scan(
            lambda x, k: (move_concentration(k, x, prior, components, n),) * 2,
            1.0,
            jax.random.split(key, 4000),
        )[1]
    )
    draws = np.stack([step(jax.random.key(seed)) for seed in (0, 1)])
    assert_mean(draws, mean / total)


def test_draws_are_those_of_the_declared_model(idata, mdp, sensor, demonstration):
    weights = jnp.asarray(idata.posterior.weights.values[1, 3])
    proportions = np.asarray(idata.posterior.proportions.values[1, 3])
    assert idata.posterior.weights.dims == ("chain", "draw", "component", "feature")
    np.testing.assert_allclose(idata.posterior.proportions.sum("component"), 1.0)
    sticks = jnp.asarray(proportions[:-1] / (1 - np.concatenate([[0], proportions[:-2].cumsum()])))
    alpha = float(idata.posterior.concentration[1, 3])
    sites = {"weights": weights, "sticks": sticks, "concentration": alpha}
    drawn = idata.log_likelihood.demonstration[1, 3].sum()
    expected = log_likelihood(mdp, sensor, jnp.asarray(demonstration.codes), sites)
    np.testing.assert_allclose(drawn, expected, rtol=1e-8)
    components = idata.assignments.assignment.values[1, 3]
    used, labels = np.unique(components, return_inverse=True)
    joint = process(labels[None], alpha)[0] + dist.Normal(0.0, SD).log_prob(weights[used]).sum()
    joint += ALPHA.log_prob(alpha)
    joint += log_probabilities(mdp, weights[components], sensor, jnp.asarray(demonstration.codes)).sum()
    np.testing.assert_allclose(idata.assignments.log_joint[1, 3], joint, rtol=1e-8)


def test_diagnosis_is_by_what_does_not_depend_on_labels(idata):
    invariant = label_invariant(idata)
    summary = az.summary(invariant, round_to="none")
    assert list(summary.index[:3]) == ["n_components", "log_joint", "log_likelihood"]
    assert summary.loc["concentration", "mean"] == pytest.approx(float(idata.posterior.concentration.mean()))
    assert "trajectory_weights[5, turned]" in summary.index
    assert summary["r_hat"].max() < 1.1
    assert summary["ess_bulk"].min() > 20
    axes = az.plot_trace(invariant, var_names=["n_components", "concentration", "log_joint"], compact=False)
    assert [axis.get_title() for axis in axes[:, 0]] == ["n_components", "concentration", "log_joint"]
    drawn = [line.get_ydata() for line in axes[1, 1].lines[:2]]
    np.testing.assert_array_equal(drawn, idata.posterior.concentration)
    plt.close("all")
    loo = az.loo(idata, pointwise=True)
    assert loo.loo_i.dims == ("trajectory",)
    assert loo.n_samples == 1400
    in_sample = logsumexp(idata.log_likelihood.demonstration.values, axis=(0, 1)) - np.log(1400)
    assert (loo.loo_i.values < in_sample).all()


def test_the_number_of_ways_and_who_shares_one_are_those_of_the_assignments(idata):
    components = idata.assignments.assignment.values
    numbers = np.apply_along_axis(lambda row: len(set(row)), -1, components)
    np.testing.assert_array_equal(idata.assignments.n_components, numbers)
    chance = idata.assignments.n_ways_probability
    assert list(chance.components) == list(range(1, N + 1))
    np.testing.assert_allclose(chance, [(numbers == k).mean() for k in range(1, N + 1)])
    together = idata.assignments.co_clustering
    assert together.dims == ("trajectory", "trajectory_")
    np.testing.assert_array_equal(np.diag(together), 1.0)
    pair = together.sel(trajectory=0, trajectory_=4)
    assert float(pair) == pytest.approx((components[..., 0] == components[..., 4]).mean())


def test_posterior_survives_a_file(idata, tmp_path):
    path = tmp_path / "mixture.nc"
    idata.to_netcdf(str(path), engine="h5netcdf")
    back = az.from_netcdf(str(path), engine="h5netcdf")
    for group in idata.groups():
        assert back[group].equals(idata[group]), group
    assert back.attrs["truncation_error"] == idata.attrs["truncation_error"] > 0


def test_gibbs_writes_out_as_many_components_as_draws_need(mdp, sensor, demonstration, posteriors):
    options = {**SAMPLERS["gibbs"].keywords, "components": 1}
    small = gibbs_mixture_posterior(jax.random.key(0), mdp, sensor, demonstration, **options)
    large = posteriors["gibbs"]
    assert (small.assignments.n_components == large.assignments.n_components).all()
    assert small.posterior.sizes["component"] == int(small.assignments.n_components.max()) + 1


def test_rows_of_padding_are_no_trajectories(mdp, sensor, demonstration, posteriors):
    wide = demonstration.padded(9, LENGTH)
    wide = wide.select([0, 7, 1, 2, 3, 4, 5, 6])
    padded = SAMPLERS["gibbs"](jax.random.key(0), mdp, sensor, wide)
    assert list(padded.assignments.trajectory) == [0, 2, 3, 4, 5, 6]
    plain = posteriors["gibbs"].assignments.assignment
    np.testing.assert_array_equal(padded.assignments.assignment, plain)


def test_wrong_input_is_refused(mdp, sensor, demonstration):
    impossible = Demonstration.from_steps([["hidden"], [(0, 0), (2, 1)]], mdp)
    for sample in (sample_mixture_posterior, gibbs_mixture_posterior):
        call = partial(sample, jax.random.key(0), mdp, sensor)
        with pytest.raises(DemonstrationError, match="trajectory 1, step 1: impossible observation"):
            call(impossible)
        with pytest.raises(ValueError, match="components must be at least 1, got 0"):
            call(demonstration, components=0)
        with pytest.raises(ValueError, match="no trajectories"):
            call(demonstration.select([]))
        with pytest.raises(ValueError, match="positive number, got 0"):
            call(demonstration, concentration=0.0)
        with pytest.raises(ValueError, match=r"over \[2\] numbers"):
            call(demonstration, prior=dist.Normal(jnp.zeros(3), 1.0))
    with pytest.raises(ValueError, match="auxiliary must be at least 1, got 0"):
        gibbs_mixture_posterior(jax.random.key(0), mdp, sensor, demonstration, auxiliary=0)
