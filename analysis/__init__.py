"""What is concluded: metrics, figures, studies, benchmarks, and the command line."""

import importlib
from typing import Any

_HOMES = {
    "assumptions": ("Assumption", "Bound", "BoundNotGuaranteed", "check"),
    "bound_figures": ("looseness_plot", "sample_size_plot"),
    "bounds": (
        "Monotonicity",
        "ObservedBound",
        "Regret",
        "demonstrations_needed",
        "error_for",
        "failure_probability",
        "lme_constraint_bound",
        "lme_i2rl_confidence",
        "maximum_entropy_confidence",
        "me_i2rl_confidence",
        "monotonicity",
        "no_regret",
        "no_regret_sizes",
        "observed_bound",
        "observed_size",
        "size_for",
        "sure_gap",
        "table_7_1a",
        "table_7_1b",
    ),
    "concentration": ("confidence_sequence", "empirical_bernstein", "hoeffding", "predictable_bernstein"),
    "coverage": ("Coverage", "Setting", "coverage_table", "full_view_coverage", "ignorance_gap"),
    "diagnostic_figures": (
        "completed_path",
        "completion_frequencies",
        "convergence_plot",
        "forest_plot",
        "predictive_plot",
        "rank_plot",
        "trace_plot",
        "weights_by_session",
    ),
    "diagnostics": ("InferenceDataError", "posterior_by_session", "require_posterior", "summary"),
    "figures": (
        "LearningCurve",
        "LearningTime",
        "SuccessRate",
        "learning_curves",
        "learning_time",
        "success_rates",
        "weights_plot",
    ),
    "estimates": ("Estimates",),
    "history": ("fleet_history", "run_history"),
    "identifiability": (
        "Identifiability",
        "describe_identifiability",
        "directions_table",
        "identifiability_of",
        "identifiability_section",
    ),
    "information": ("complete_information", "expected_information", "observed_information"),
    "invariance": ("Direction", "unidentified_directions"),
    "label_bias": ("Correlation", "LabelBiasStudy", "correlation"),
    "maps": ("hidden_path", "policy_map"),
    "metrics": (
        "Accuracy",
        "Evaluation",
        "LearningError",
        "chance_accuracy",
        "demonstration_log_likelihoods",
        "evaluate",
        "greedy_policy",
        "inverse_learning_error",
        "learned_behavior_accuracy",
        "learned_value",
        "optimal_actions",
        "policy_accuracy",
        "policy_error",
        "quantile_band",
    ),
    "multi_task_metrics": (
        "adjusted_rand_index",
        "assignment_accuracy",
        "expected_value_difference",
        "match_ways",
    ),
    "online_methods": ("methods_table", "turning_places"),
    "perception_bounds": (
        "noisy_confidence",
        "noisy_constraint_bound",
        "perception_needed",
        "rimeo_confidence",
        "rimeo_constraint_bound",
        "rimeo_no_regret",
        "rimeo_no_regret_sizes",
        "same_reports_constraint_bound",
    ),
    "noise_coverage": ("learned_perception_coverage", "perception_coverage", "posterior_change"),
    "perception_distance": (
        "ModelDistance",
        "Perception",
        "model_distance",
        "posterior_distance",
        "report_distance",
    ),
    "predictive": ("predictive_check", "predictive_visits"),
    "regret": (
        "BoundCurve",
        "Gaps",
        "RegretCurve",
        "excess_risk",
        "expected_visits",
        "last_confident_session",
        "log_log_slope",
        "regret_gaps",
        "regret_plot",
        "sure_bound",
    ),
    "page": ("Lead", "Picture", "Section", "Table", "write_page"),
    "results": ("study_provenance",),
    "selection": (
        "FeatureComparison",
        "compare_features",
        "compare_posteriors",
        "select_features",
        "with_features",
    ),
    "sorting_table": (
        "SortingRow",
        "SortingTable",
        "print_sorting_table",
        "sorting_table_plot",
        "sorting_table_summary",
        "table_7_2",
    ),
    "stopping": ("Sweep", "Verdict", "judge_stops", "stopping_plot", "sweep_tolerance"),
    "stream": ("learn_stream",),
    "style": ("DARK", "LIGHT", "Theme", "save", "save_themes"),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}
__all__ = sorted(_HOME_OF)


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_HOME_OF[name]}", __name__), name)


def __dir__() -> list[str]:
    return list(__all__)
