"""What is believed: decision processes, demonstrations, evidence, and the law of a trajectory.

Importing this package switches JAX to 64-bit floats: likelihoods of long trajectories and warm-started
programs need the digits.

The laws are imported when they are first used: NumPyro takes a second to load.
"""

import importlib
from typing import TYPE_CHECKING, Any

from .. import precision  # noqa: F401  (before anything computes)
from .inputs.archives import StorageError
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

if TYPE_CHECKING:
    from .laws.mixture import MixtureLaw, mixture_model, stick_proportions, truncation_error
    from .laws.occlusion import occlusion_model, weights_prior
    from .laws.trajectory import TrajectoryLaw, sample_demonstration

_HOMES = {
    "mixture": ("MixtureLaw", "mixture_model", "stick_proportions", "truncation_error"),
    "occlusion": ("occlusion_model", "weights_prior"),
    "trajectory": ("TrajectoryLaw", "sample_demonstration"),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "Confusions",
    "Demonstration",
    "DemonstrationError",
    "FeatureNoise",
    "FinitePlan",
    "GaussianSensor",
    "HardPlan",
    "Imperfection",
    "LineLimits",
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


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".laws.{_HOME_OF[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
