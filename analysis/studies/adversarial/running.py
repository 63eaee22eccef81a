"""Study of one task at one level of noise, and its page: the command ``i2rl run robust-airl``."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from . import study as adversarial_study
from .cases import PLANS, Plan
from .page import print_tables, summary
from .page import write as write_study
from .results import AdversarialResults

__all__ = ["answer", "print_tables", "summary", "write"]


def answer(
    domain: str,
    replications: int = 1,
    sessions: int | None = None,
    noise: float = 1.0,
    *,
    workers: int = 1,
    cache: Path | None = None,
    advance: Callable[[str, float | None], None] = lambda text, share: None,
) -> AdversarialResults:
    """Study a task with ``noise`` times its own noise.

    Raises ``ValueError`` for noise of zero, and for a domain that is not studied.
    """
    if not noise > 0:
        raise ValueError(f"noise is a multiple, above zero, of the study's own; got {noise}")
    if domain == "patrol":
        from .patrol import patrol_results

        results = patrol_results(replications, sessions, noise, advance=advance)
        return results._replace(machine=_machine())
    if domain not in PLANS:
        raise ValueError(f"the domain is one of patrol, {', '.join(PLANS)}; got {domain!r}")
    plan = _scaled(PLANS[domain], noise)
    if sessions is not None:
        plan = plan._replace(sessions=sessions)
    return adversarial_study.adversarial_study(
        domain, replications, plan, workers=workers, folder=cache, machine=_machine(), advance=advance
    )


def write(results: AdversarialResults, folder: Path | str) -> Path:
    """Write the page of one task; patrol's also shows one learner's posterior of a trajectory."""
    if results.domain != "patrol":
        return write_study(results, folder)
    from .patrol import believed_trajectories

    return write_study(results, folder, believed_trajectories(results))


def _scaled(plan: Plan, noise: float) -> Plan:
    return plan._replace(covariance=noise * plan.covariance, shift=noise * plan.shift)


def _machine() -> str:
    return f"{os.cpu_count()} processor cores"
