"""How beliefs change: completion, convex programs, samplers, and the online learners.

Names are imported when they are first used: the solvers behind some of them take seconds to load.
"""

import importlib
from typing import Any

from .. import precision  # noqa: F401

_HOMES = {
    "adversarial.learner": (
        "AdversarialReport",
        "AdversarialState",
        "AdversarialTraining",
        "adversarial",
        "airl",
        "gail",
    ),
    "adversarial.tabular.learners": (
        "airl_tabular",
        "gail_tabular",
        "gibbs_airl_tabular",
        "robust_airl_tabular",
        "robust_airl_with_learned_sensor",
        "robust_gail_tabular",
    ),
    "learners.boltzmann": (
        "boltzmann_log_likelihoods",
        "boltzmann_log_policy",
        "optimal_action_values",
        "visit_counts",
    ),
    "mixtures.clustering": ("Clustering",),
    "learners.darko": (
        "darko_i2rl",
        "ending_at",
        "feature_margin",
        "goal_sessions",
        "stopping_places",
        "with_end",
    ),
    "adversarial.discriminator": (
        "Discriminator",
        "ExpertTransitions",
        "Transitions",
        "airl_discriminator",
        "gail_discriminator",
    ),
    "learners.dpm": ("DPMBIRL", "DPMTrace", "dpm_birl"),
    "programs.entropic": ("entropic_proportions",),
    "completion.gibbs": ("GaussianGibbs",),
    "completion.gaussian": (
        "GaussianTruth",
        "fitted_sensor",
        "jax_dynamics",
    ),
    "adversarial.robust": (
        "Smoothed",
        "SmoothedAndFitted",
        "fit_gaussian",
        "fit_isotropic",
        "fit_shift",
        "robust_airl",
        "robust_airl_with_sensor",
    ),
    "learners.identification": ("SensorIdentification", "sensor_identification", "sensor_identifier"),
    "learners.jin": ("jin_i2rl", "jin_i2rl_with_features", "reward_correction", "with_state_features"),
    "journal.journal": ("Journal", "JournalBusy", "JournalError", "JournalView", "Position", "SessionRecord"),
    "completion.kalman": (
        "AffineGaussian",
        "filter_gaussian",
        "smooth_gaussian",
    ),
    "learners.lme": (
        "Batch",
        "BatchFit",
        "LMEState",
        "batch_lme",
        "lme_i2rl",
        "lme_i2rl_with_random_weights",
        "me_i2rl",
    ),
    "programs.maximum_entropy": (
        "Solution",
        "WarmStart",
        "exponentiated_gradient",
        "fit_counts",
        "solve_dual",
    ),
    "programs.constraints": ("FeatureTarget", "InfeasibleProgram", "ProgramNotSolved"),
    "programs.dual": ("CountProgram", "DualProgram"),
    "programs.primal": ("PrimalProgram",),
    "learners.maximum_likelihood": ("EMMLIRL", "EMTrace", "MLIRLFit", "em_mlirl", "mlirl"),
    "programs.finite_horizon": (
        "CausalEntropyFit",
        "UnmatchedError",
        "expected_features",
        "expected_visits",
        "feature_dual",
        "fit_state_rewards",
        "fit_weights",
    ),
    "learners.mtirl": (
        "BatchMixture",
        "MixtureReport",
        "MixtureState",
        "assign_trajectories",
        "batch_mme_mtirl",
        "clustering_of",
        "mme_mtirl",
    ),
    "posteriors.noisy": ("sample_noisy_posterior",),
    "programs.observation": (
        "Identification",
        "ObservationProgram",
        "ObservationSolution",
        "unidentified_predicates",
    ),
    "programs.printed.observation": ("solve_printed_program",),
    "completion.partitioned": (
        "CandidateTruth",
        "PartitionTruth",
        "candidate_truth",
        "fitted_shift_sensor",
    ),
    "sensors.reliabilities": ("WithTruth",),
    "posteriors.policy_walk": ("birl",),
    "adversarial.policy_optimisation": ("PPO", "PPOState"),
    "programs.minmax": ("MinMaxProgram", "MinMaxSolution"),
    "programs.printed.minmax": (
        "TrajectorySpace",
        "ascend_printed",
        "coded_assignment_gradient",
        "printed_assignment_gradient",
    ),
    "posteriors.gibbs": ("gibbs_mixture_posterior",),
    "posteriors.mixture": ("sample_mixture_posterior",),
    "posteriors.mixture_problem": ("label_invariant",),
    "posteriors.weights": ("sample_posterior",),
    "learners.noisy": ("RIMEOReport", "RIMEOState", "rifom", "rimeo", "robust_irl"),
    "adversarial.rollouts": ("Episodes", "finished_returns", "play"),
    "sessions.schedule": ("Harmonic",),
    "sessions.learner": ("Learner", "Report"),
    "sessions.fleets": ("Fleet", "fleet", "run_streams"),
    "sessions.stopping": (
        "LearningErrorChange",
        "LikelihoodChange",
        "MovingWindow",
        "PolicyWindow",
        "StoppingCriterion",
    ),
    "sessions.running": ("Run", "average_regret", "run_sessions"),
    "completion.smoothing": (
        "Evidence",
        "Expectations",
        "blocked_expectations",
        "evidence_of",
        "expectations",
        "gibbs_expectations",
        "log_likelihoods",
        "sample_completions",
        "smooth_all",
    ),
    "adversarial.snippets": (
        "Regression",
        "SSRRReward",
    ),
    "sessions.statistic": ("CountStatistic", "FeatureStatistic"),
    "adversarial.tabular.training": (
        "TabularAdversarialReport",
        "TabularAdversarialState",
        "TabularTraining",
    ),
    "adversarial.truth": ("FaceValue",),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}
__all__ = sorted(_HOME_OF)


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_HOME_OF[name]}", __name__), name)


def __dir__() -> list[str]:
    return list(__all__)
