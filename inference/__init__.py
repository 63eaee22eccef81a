"""How beliefs change: completion, convex programs, samplers, and the online learners.

Names are imported when they are first used: the solvers behind some of them take seconds to load.
"""

import importlib
from typing import Any

from .. import precision  # noqa: F401

_HOMES = {
    "adversarial_learner": (
        "AdversarialReport",
        "AdversarialState",
        "AdversarialTraining",
        "adversarial",
        "airl",
        "gail",
    ),
    "adversarial_tabular": (
        "airl_tabular",
        "gail_tabular",
        "gibbs_airl_tabular",
        "robust_airl_tabular",
        "robust_airl_with_learned_sensor",
        "robust_gail_tabular",
    ),
    "boltzmann": (
        "boltzmann_log_likelihoods",
        "boltzmann_log_policy",
        "optimal_action_values",
        "visit_counts",
    ),
    "clustering": ("Clustering",),
    "darko": ("darko_i2rl", "ending_at", "feature_margin", "goal_sessions", "stopping_places", "with_end"),
    "discriminator": (
        "Discriminator",
        "ExpertTransitions",
        "Transitions",
        "airl_discriminator",
        "gail_discriminator",
    ),
    "dpm": ("DPMBIRL", "DPMTrace", "dpm_birl"),
    "entropic": ("entropic_proportions",),
    "gaussian_gibbs": ("GaussianGibbs",),
    "gaussian_truth": (
        "GaussianTruth",
        "fitted_sensor",
        "jax_dynamics",
    ),
    "hidden_truth": (
        "Smoothed",
        "SmoothedAndFitted",
        "fit_gaussian",
        "fit_isotropic",
        "fit_shift",
        "robust_airl",
        "robust_airl_with_sensor",
    ),
    "identification": ("SensorIdentification", "sensor_identification", "sensor_identifier"),
    "jin": ("jin_i2rl", "jin_i2rl_with_features", "reward_correction", "with_state_features"),
    "journal": ("Journal", "JournalBusy", "JournalError", "JournalView", "Position", "SessionRecord"),
    "kalman": (
        "AffineGaussian",
        "filter_gaussian",
        "smooth_gaussian",
    ),
    "lme": (
        "Batch",
        "BatchFit",
        "LMEState",
        "batch_lme",
        "lme_i2rl",
        "lme_i2rl_with_random_weights",
        "me_i2rl",
    ),
    "maxent": ("Solution", "WarmStart", "exponentiated_gradient", "fit_counts", "solve_dual"),
    "maxent_constraints": ("FeatureTarget", "InfeasibleProgram", "ProgramNotSolved"),
    "maxent_dual": ("CountProgram", "DualProgram"),
    "maxent_primal": ("PrimalProgram",),
    "maximum_likelihood": ("EMMLIRL", "EMTrace", "MLIRLFit", "em_mlirl", "mlirl"),
    "mce": (
        "CausalEntropyFit",
        "UnmatchedError",
        "expected_features",
        "expected_visits",
        "feature_dual",
        "fit_state_rewards",
        "fit_weights",
    ),
    "mtirl": (
        "BatchMixture",
        "MixtureReport",
        "MixtureState",
        "assign_trajectories",
        "batch_mme_mtirl",
        "clustering_of",
        "mme_mtirl",
    ),
    "noisy_posterior": ("sample_noisy_posterior",),
    "observation_program": (
        "Identification",
        "ObservationProgram",
        "ObservationSolution",
        "unidentified_predicates",
    ),
    "observation_printed": ("solve_printed_program",),
    "partition_truth": (
        "CandidateTruth",
        "PartitionTruth",
        "candidate_truth",
        "fitted_shift_sensor",
    ),
    "perception": ("WithTruth",),
    "policy_walk": ("birl",),
    "ppo": ("PPO", "PPOState"),
    "minmax": ("MinMaxProgram", "MinMaxSolution"),
    "minmax_printed": (
        "TrajectorySpace",
        "ascend_printed",
        "coded_assignment_gradient",
        "printed_assignment_gradient",
    ),
    "mixture_gibbs": ("gibbs_mixture_posterior",),
    "mixture_posterior": ("sample_mixture_posterior",),
    "mixture_problem": ("label_invariant",),
    "posterior": ("sample_posterior",),
    "robust": ("RIMEOReport", "RIMEOState", "rifom", "rimeo", "robust_irl"),
    "rollouts": ("Episodes", "finished_returns", "play"),
    "schedule": ("Harmonic",),
    "session": (
        "Fleet",
        "Learner",
        "LearningErrorChange",
        "LikelihoodChange",
        "MovingWindow",
        "PolicyWindow",
        "Report",
        "Run",
        "StoppingCriterion",
        "average_regret",
        "fleet",
        "run_sessions",
        "run_streams",
    ),
    "smoothing": (
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
    "snippet_regression": (
        "Regression",
        "SSRRReward",
    ),
    "statistic": ("CountStatistic", "FeatureStatistic"),
    "tabular_training": (
        "TabularAdversarialReport",
        "TabularAdversarialState",
        "TabularTraining",
    ),
    "truth_sampling": ("FaceValue",),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}
__all__ = sorted(_HOME_OF)


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_HOME_OF[name]}", __name__), name)


def __dir__() -> list[str]:
    return list(__all__)
