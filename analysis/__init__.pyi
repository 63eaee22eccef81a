from .bounds.assumptions import (
    check as check,
)
from .bounds.perception import (
    perception_needed as perception_needed,
)
from .bounds.perception import (
    rimeo_confidence as rimeo_confidence,
)
from .bounds.stopping import (
    judge_stops as judge_stops,
)
from .bounds.theorems import (
    demonstrations_needed as demonstrations_needed,
)
from .bounds.theorems import (
    lme_i2rl_confidence as lme_i2rl_confidence,
)
from .bounds.theorems import (
    me_i2rl_confidence as me_i2rl_confidence,
)
from .bounds.theorems import (
    no_regret as no_regret,
)
from .bounds.theorems import (
    observed_bound as observed_bound,
)
from .drawing.charts import (
    learning_curves as learning_curves,
)
from .drawing.charts import (
    weights_plot as weights_plot,
)
from .drawing.maps import (
    hidden_path as hidden_path,
)
from .drawing.maps import (
    policy_map as policy_map,
)
from .drawing.maps import (
    value_map as value_map,
)
from .judging.metrics import (
    demonstration_log_likelihoods as demonstration_log_likelihoods,
)
from .judging.metrics import (
    evaluate as evaluate,
)
from .judging.metrics import (
    inverse_learning_error as inverse_learning_error,
)
from .judging.metrics import (
    learned_behavior_accuracy as learned_behavior_accuracy,
)
from .judging.metrics import (
    policy_accuracy as policy_accuracy,
)
from .judging.metrics import (
    quantile_band as quantile_band,
)
from .judging.multi_task import (
    assignment_accuracy as assignment_accuracy,
)
from .judging.multi_task import (
    expected_value_difference as expected_value_difference,
)
from .judging.multi_task import (
    match_components as match_components,
)
from .posteriors.diagnostics import (
    posterior_by_session as posterior_by_session,
)
from .posteriors.diagnostics import (
    summary as summary,
)
from .posteriors.figures import (
    completed_path as completed_path,
)
from .posteriors.figures import (
    forest_plot as forest_plot,
)
from .posteriors.figures import (
    rank_plot as rank_plot,
)
from .posteriors.figures import (
    trace_plot as trace_plot,
)
from .posteriors.figures import (
    weights_by_session as weights_by_session,
)
from .posteriors.history import (
    fleet_history as fleet_history,
)
from .posteriors.history import (
    run_history as run_history,
)
from .posteriors.identifiability import (
    identifiability_of as identifiability_of,
)
from .posteriors.predictive import (
    predictive_check as predictive_check,
)
from .posteriors.predictive import (
    predictive_visits as predictive_visits,
)
from .posteriors.selection import (
    compare_features as compare_features,
)
from .posteriors.selection import (
    compare_posteriors as compare_posteriors,
)
from .posteriors.selection import (
    select_features as select_features,
)
from .studies.adversarial.study import (
    adversarial_study as adversarial_study,
)
from .studies.label_bias.study import (
    label_bias_study as label_bias_study,
)
from .studies.labyrinth.study import (
    labyrinth_study as labyrinth_study,
)
from .studies.methods.study import (
    methods_study as methods_study,
)
from .studies.noisy.study import (
    noisy_study as noisy_study,
)
from .studies.patrol.study import (
    patrol_study as patrol_study,
)
from .studies.sorting.study import (
    sorting_study as sorting_study,
)
