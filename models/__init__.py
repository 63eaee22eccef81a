"""What is believed: decision processes, demonstrations, evidence, and the law of a trajectory.

Importing this package switches JAX to 64-bit floats: likelihoods of long trajectories and warm-started
programs need the digits.
"""

from .. import precision  # noqa: F401  (before anything computes)
from .inputs.archives import StorageError
from .laws.mixture import MixtureLaw, mixture_model, stick_proportions, truncation_error
from .laws.occlusion import occlusion_model, weights_prior
from .laws.trajectory import TrajectoryLaw, sample_demonstration
from .observation.confusions import Confusions
from .observation.demonstration import (
    Demonstration,
    DemonstrationError,
    LineLimits,
    Record,
    concatenate,
    read_trajectories,
    write_trajectories,
)
from .observation.evidence import (
    FeatureNoise,
    Imperfection,
    ObservationModel,
    Sensor,
    Visibility,
    log_evidence,
    require_possible,
)
from .observation.recordings import GaussianSensor, Recording, RecordingError, ShiftSensor, distort, recording
from .observation.storage import load_mdp, save_mdp
from .process.layout import Layout, Mark
from .process.mdp import TabularMDP
from .process.planning import (
    FinitePlan,
    HardPlan,
    SoftPlan,
    deterministic_policy,
    feature_deviations,
    feature_expectations,
    features_to_go,
    finite_hard_plan,
    finite_occupancy,
    finite_soft_plan,
    hard_plan,
    occupancy,
    policy_values,
    reachable_states,
    reward_of,
    simulate,
    soft_plan,
)
from .process.units import feature_scale, with_scaled_features

__all__ = [
    "Confusions",
    "Demonstration",
    "DemonstrationError",
    "FeatureNoise",
    "FinitePlan",
    "GaussianSensor",
    "HardPlan",
    "Imperfection",
    "Layout",
    "LineLimits",
    "Mark",
    "MixtureLaw",
    "ObservationModel",
    "Record",
    "Recording",
    "RecordingError",
    "Sensor",
    "ShiftSensor",
    "SoftPlan",
    "StorageError",
    "TabularMDP",
    "TrajectoryLaw",
    "Visibility",
    "concatenate",
    "deterministic_policy",
    "distort",
    "feature_deviations",
    "feature_expectations",
    "feature_scale",
    "features_to_go",
    "finite_hard_plan",
    "finite_occupancy",
    "finite_soft_plan",
    "hard_plan",
    "load_mdp",
    "log_evidence",
    "mixture_model",
    "occlusion_model",
    "occupancy",
    "policy_values",
    "reachable_states",
    "read_trajectories",
    "recording",
    "require_possible",
    "reward_of",
    "sample_demonstration",
    "save_mdp",
    "simulate",
    "soft_plan",
    "stick_proportions",
    "truncation_error",
    "weights_prior",
    "with_scaled_features",
    "write_trajectories",
]
