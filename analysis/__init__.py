"""What is concluded: metrics, figures, studies, benchmarks, and the command line."""

import importlib
from typing import Any

_HOMES = {
    "bounds.assumptions": ("Assumption", "Bound", "BoundNotGuaranteed", "check"),
    "bounds.figures": ("looseness_plot", "sample_size_plot"),
    "bounds.theorems": (
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
    "bounds.concentration": (
        "confidence_sequence",
        "empirical_bernstein",
        "hoeffding",
        "predictable_bernstein",
    ),
    "bounds.coverage": ("Coverage", "Setting", "coverage_table", "full_view_coverage", "ignorance_gap"),
    "posteriors.figures": (
        "completed_path",
        "completion_frequencies",
        "convergence_plot",
        "forest_plot",
        "predictive_plot",
        "rank_plot",
        "trace_plot",
        "weights_by_session",
    ),
    "posteriors.diagnostics": ("InferenceDataError", "posterior_by_session", "require_posterior", "summary"),
    "drawing.charts": (
        "LearningCurve",
        "LearningTime",
        "SuccessRate",
        "learning_curves",
        "learning_time",
        "success_rates",
        "weights_plot",
    ),
    "drawing.estimates": ("Estimates",),
    "posteriors.history": ("fleet_history", "run_history"),
    "posteriors.identifiability": (
        "Identifiability",
        "describe_identifiability",
        "directions_table",
        "identifiability_of",
        "identifiability_section",
    ),
    "posteriors.information": ("complete_information", "expected_information", "observed_information"),
    "posteriors.invariance": ("Direction", "unidentified_directions"),
    "studies.label_bias.study": ("Correlation", "LabelBiasStudy", "correlation"),
    "drawing.maps": ("hidden_path", "policy_map", "value_map"),
    "judging.metrics": (
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
    "judging.multi_task": (
        "adjusted_rand_index",
        "assignment_accuracy",
        "expected_value_difference",
        "match_ways",
    ),
    "studies.methods.study": ("methods_table", "turning_places"),
    "bounds.perception": (
        "noisy_confidence",
        "noisy_constraint_bound",
        "perception_needed",
        "rimeo_confidence",
        "rimeo_constraint_bound",
        "rimeo_no_regret",
        "rimeo_no_regret_sizes",
        "same_reports_constraint_bound",
    ),
    "bounds.noise_coverage": ("learned_perception_coverage", "perception_coverage", "posterior_change"),
    "bounds.distance": (
        "ModelDistance",
        "Perception",
        "model_distance",
        "posterior_distance",
        "report_distance",
    ),
    "posteriors.predictive": ("predictive_check", "predictive_visits"),
    "bounds.regret": (
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
    "drawing.page": ("Lead", "Picture", "Section", "Table", "write_page"),
    "drawing.results": ("study_provenance",),
    "posteriors.selection": (
        "FeatureComparison",
        "compare_features",
        "compare_posteriors",
        "select_features",
        "with_features",
    ),
    "studies.sorting.table": (
        "SortingRow",
        "SortingTable",
        "print_sorting_table",
        "sorting_table_plot",
        "sorting_table_summary",
        "table_7_2",
    ),
    "bounds.stopping": ("Sweep", "Verdict", "judge_stops", "stopping_plot", "sweep_tolerance"),
    "command.stream": ("learn_stream",),
    "drawing.style": ("DARK", "LIGHT", "Theme", "save", "save_themes"),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}
__all__ = sorted(_HOME_OF)


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_HOME_OF[name]}", __name__), name)


def __dir__() -> list[str]:
    return list(__all__)
