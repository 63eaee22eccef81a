from .inputs.archives import (
    StorageError as StorageError,
)
from .laws.feature_noise import (
    observation_feature_model as observation_feature_model,
)
from .laws.feature_noise import (
    sample_observation_features as sample_observation_features,
)
from .laws.mixture import (
    MixtureLaw as MixtureLaw,
)
from .laws.mixture import (
    mixture_model as mixture_model,
)
from .laws.noisy_behaviour import (
    noisy_behaviour_model as noisy_behaviour_model,
)
from .laws.occlusion import (
    occlusion_model as occlusion_model,
)
from .laws.occlusion import (
    weights_prior as weights_prior,
)
from .laws.trajectory import (
    TrajectoryLaw as TrajectoryLaw,
)
from .laws.trajectory import (
    sample_demonstration as sample_demonstration,
)
from .observation.agreement import (
    reported_matches as reported_matches,
)
from .observation.confusions import (
    Confusions as Confusions,
)
from .observation.demonstration import (
    Demonstration as Demonstration,
)
from .observation.demonstration import (
    DemonstrationError as DemonstrationError,
)
from .observation.demonstration import (
    concatenate as concatenate,
)
from .observation.demonstration import (
    read_trajectories as read_trajectories,
)
from .observation.demonstration import (
    write_trajectories as write_trajectories,
)
from .observation.evidence import (
    FeatureNoise as FeatureNoise,
)
from .observation.evidence import (
    ObservationModel as ObservationModel,
)
from .observation.evidence import (
    Sensor as Sensor,
)
from .observation.evidence import (
    Visibility as Visibility,
)
from .observation.evidence import (
    log_evidence as log_evidence,
)
from .observation.evidence import (
    observe as observe,
)
from .observation.evidence import (
    require_possible as require_possible,
)
from .observation.recordings import (
    GaussianSensor as GaussianSensor,
)
from .observation.recordings import (
    Recording as Recording,
)
from .observation.recordings import (
    RecordingError as RecordingError,
)
from .observation.recordings import (
    ShiftSensor as ShiftSensor,
)
from .observation.recordings import (
    distort as distort,
)
from .observation.recordings import (
    recording as recording,
)
from .observation.storage import (
    load_mdp as load_mdp,
)
from .observation.storage import (
    save_mdp as save_mdp,
)
from .process.layout import (
    Layout as Layout,
)
from .process.mdp import (
    TabularMDP as TabularMDP,
)
from .process.planning import (
    SoftPlan as SoftPlan,
)
from .process.planning import (
    deterministic_policy as deterministic_policy,
)
from .process.planning import (
    feature_expectations as feature_expectations,
)
from .process.planning import (
    finite_soft_plan as finite_soft_plan,
)
from .process.planning import (
    hard_plan as hard_plan,
)
from .process.planning import (
    occupancy as occupancy,
)
from .process.planning import (
    policy_values as policy_values,
)
from .process.planning import (
    reward_of as reward_of,
)
from .process.planning import (
    simulate as simulate,
)
from .process.planning import (
    soft_plan as soft_plan,
)
