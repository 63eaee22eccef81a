from .adversarial.learner import (
    AdversarialTraining as AdversarialTraining,
)
from .adversarial.learner import (
    airl as airl,
)
from .adversarial.learner import (
    gail as gail,
)
from .adversarial.noise_injection import (
    noisy_airl as noisy_airl,
)
from .adversarial.policy_optimisation import (
    ppo as ppo,
)
from .adversarial.robust import (
    robust_airl as robust_airl,
)
from .adversarial.self_supervised import (
    ssrr as ssrr,
)
from .adversarial.tabular.learners import (
    airl_tabular as airl_tabular,
)
from .adversarial.tabular.learners import (
    robust_airl_tabular as robust_airl_tabular,
)
from .completion.gaussian import (
    gaussian_truth as gaussian_truth,
)
from .completion.smoothing import (
    expectations as expectations,
)
from .completion.smoothing import (
    log_likelihoods as log_likelihoods,
)
from .completion.smoothing import (
    sample_completions as sample_completions,
)
from .journal.journal import (
    Journal as Journal,
)
from .journal.locking import (
    JournalError as JournalError,
)
from .learners.darko import (
    darko_i2rl as darko_i2rl,
)
from .learners.dpm import (
    dpm_birl as dpm_birl,
)
from .learners.identification import (
    sensor_identification as sensor_identification,
)
from .learners.jin import (
    jin_i2rl as jin_i2rl,
)
from .learners.lme import (
    batch_lme as batch_lme,
)
from .learners.lme import (
    lme_i2rl as lme_i2rl,
)
from .learners.lme import (
    me_i2rl as me_i2rl,
)
from .learners.maximum_likelihood import (
    em_mlirl as em_mlirl,
)
from .learners.maximum_likelihood import (
    mlirl as mlirl,
)
from .learners.mtirl import (
    batch_mme_mtirl as batch_mme_mtirl,
)
from .learners.mtirl import (
    mme_mtirl as mme_mtirl,
)
from .learners.noisy import (
    rifom as rifom,
)
from .learners.noisy import (
    rimeo as rimeo,
)
from .learners.noisy import (
    robust_irl as robust_irl,
)
from .posteriors.gibbs import (
    gibbs_mixture_posterior as gibbs_mixture_posterior,
)
from .posteriors.mixture import (
    sample_mixture_posterior as sample_mixture_posterior,
)
from .posteriors.noisy import (
    sample_noisy_posterior as sample_noisy_posterior,
)
from .posteriors.policy_walk import (
    birl as birl,
)
from .posteriors.weights import (
    sample_posterior as sample_posterior,
)
from .programs.constraints import (
    InfeasibleProgram as InfeasibleProgram,
)
from .programs.dual import (
    DualProgram as DualProgram,
)
from .programs.finite_horizon import (
    fit_weights as fit_weights,
)
from .programs.maximum_entropy import (
    fit_counts as fit_counts,
)
from .programs.maximum_entropy import (
    solve_dual as solve_dual,
)
from .programs.minmax import (
    MinMaxProgram as MinMaxProgram,
)
from .programs.observation import (
    ObservationProgram as ObservationProgram,
)
from .programs.primal import (
    PrimalProgram as PrimalProgram,
)
from .sessions.fleets import (
    fleet as fleet,
)
from .sessions.fleets import (
    run_streams as run_streams,
)
from .sessions.learner import (
    Learner as Learner,
)
from .sessions.learner import (
    SessionInfo as SessionInfo,
)
from .sessions.running import (
    Run as Run,
)
from .sessions.running import (
    average_regret as average_regret,
)
from .sessions.running import (
    run_sessions as run_sessions,
)
from .sessions.schedule import (
    Harmonic as Harmonic,
)
from .sessions.stopping import (
    LearningErrorChange as LearningErrorChange,
)
from .sessions.stopping import (
    LikelihoodChange as LikelihoodChange,
)
from .sessions.stopping import (
    MovingWindow as MovingWindow,
)
from .sessions.stopping import (
    PolicyWindow as PolicyWindow,
)
