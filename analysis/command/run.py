"""``i2rl run``: whole studies."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from .console import print_results, progress, reported_errors
from .options import Instance, Json, Percent, Seed, count_option, real_option

commands = typer.Typer(
    help="Run a whole study: learn, evaluate, and write a page with pictures.", no_args_is_help=True
)


class Method(StrEnum):
    """Learners that ``run patrol`` can compare."""

    online = "lme-i2rl"
    batch = "batch"
    random = "random"
    all = "all"


class MultiTask(StrEnum):
    """Learners that ``run sorting`` can compare."""

    batch = "mme-mtirl"
    online = "online"
    dpm_birl = "dpm-birl"
    em_mlirl = "em-mlirl"
    em_mlirl_unknown = "em-mlirl-unknown"
    all = "all"


class NoisyStarts(StrEnum):
    """Starts of the trajectories of ``run noisy-sorting`` and ``run noisy-patrol``."""

    all = "all"
    natural = "natural"


class Domain(StrEnum):
    """Tasks of ``run robust-airl``."""

    patrol = "patrol"
    mountain_car = "mountain-car"
    hopper = "hopper"
    walker2d = "walker2d"
    half_cheetah = "half-cheetah"
    onion = "onion"


@commands.command("patrol")
def run_patrol(
    instance: Instance = 2,
    observability: Percent = None,
    sessions: Annotated[int, count_option("Sessions of five steps a patroller.")] = 60,
    method: Annotated[Method, typer.Option(help="Which learners to run.")] = Method.all,
    trials: Annotated[int, count_option("Simulated breaches per learned policy.")] = 200,
    replications: Annotated[int, count_option("Independent repetitions.")] = 3,
    seed: Seed = 0,
    folder: Annotated[Path, typer.Option(help="Folder of the page and its results.")] = Path("report"),
    as_json: Json = False,
) -> None:
    """Watch patrollers through a keyhole, learn their reward online, and walk past them undetected."""
    from ..studies.patrol import study as patrol_study

    with reported_errors(), progress(as_json) as advance:
        study = patrol_study.patrol_study(
            instance,
            observability,
            sessions=sessions,
            trials=trials,
            replications=replications,
            seed=seed,
            methods=None if method is Method.all else (method.value,),
            advance=advance,
        )
        patrol_study.write(study, folder)
    print_results(patrol_study, study, folder, as_json)


@commands.command("labyrinth")
def run_labyrinth(
    recording: Annotated[
        Path, typer.Option(help="JSON Lines file of bouts, each with its sequence of nodes.")
    ],
    hide_left: Annotated[
        bool, typer.Option(help="Learn also with the left half of the maze out of view.")
    ] = True,
    discount: Annotated[float | None, real_option("Discount of the animal's future.", 0, 1)] = None,
    ridge: Annotated[float | None, real_option("Precision of the weights' Gaussian prior.", 0)] = None,
    folder: Annotated[Path, typer.Option(help="Folder of the page and its results.")] = Path(
        "report-labyrinth"
    ),
    as_json: Json = False,
) -> None:
    """Learn a mouse's reward in a labyrinth, bout by bout; predict each bout before learning from it."""
    from ...domains.labyrinth.process import read_bouts
    from ..studies.labyrinth import page as labyrinth_page
    from ..studies.labyrinth import study as labyrinth

    with reported_errors(), progress(as_json) as advance:
        with recording.open("rb") as lines:
            bouts = list(read_bouts(lines, recording.name))
        study = labyrinth.labyrinth_study(
            bouts,
            recording=recording.stem,
            hide_left=hide_left,
            discount=labyrinth.DISCOUNT if discount is None else discount,
            ridge=labyrinth.RIDGE if ridge is None else ridge,
            on_bout=lambda view, number, bits: advance(f"{view}: bout {number}, {bits:.3f} bits", None),
        )
        labyrinth_page.write(study, folder)
    print_results(labyrinth_page, study, folder, as_json)


@commands.command("methods")
def run_methods(
    instance: Instance = 2,
    sessions: Annotated[int, count_option("Sessions of five steps a patroller.")] = 120,
    replications: Annotated[int, count_option("Independent repetitions.")] = 3,
    seed: Seed = 0,
    folder: Annotated[Path, typer.Option(help="Folder of the page and its results.")] = Path(
        "report-methods"
    ),
    as_json: Json = False,
) -> None:
    """Compare online methods on a patrol in full view: the pairs that each needs, and its memory."""
    from ..studies.methods import study as online_methods

    with reported_errors(), progress(as_json) as advance:
        study = online_methods.methods_study(
            instance, sessions=sessions, replications=replications, seed=seed, advance=advance
        )
        online_methods.write(study, folder)
    print_results(online_methods, study, folder, as_json)


@commands.command("label-bias")
def run_label_bias(
    worlds: Annotated[int, count_option("Object Worlds drawn.")] = 100,
    trajectories: Annotated[int, count_option("Expert trajectories a world.", 4)] = 75,
    walls: Annotated[int, count_option("Walls a world, of 100 cells.", 0)] = 25,
    seed: Seed = 0,
    folder: Annotated[Path, typer.Option(help="Folder of the page and its results.")] = Path(
        "report-label-bias"
    ),
    as_json: Json = False,
) -> None:
    """Test whether likelier trajectories earn more: Table 5.1 in many Object Worlds and settings."""
    from ..studies.label_bias import page as label_bias_page
    from ..studies.label_bias import study as label_bias

    with reported_errors(), progress(as_json) as advance:
        study = label_bias.label_bias_study(worlds, trajectories, walls=walls, seed=seed, advance=advance)
        label_bias_page.write(study, folder)
    print_results(label_bias_page, study, folder, as_json)


@commands.command("sorting")
def run_sorting(
    tasks: Annotated[int, count_option("Behaviours demonstrated, 2 or 3.", 2, 3)] = 2,
    trajectories: Annotated[
        str | None,
        typer.Option(
            help="Numbers of trajectories to learn from, such as 8,16,32, or all for the dissertation's six. "
            "Few by default: methods are compiled for each."
        ),
    ] = None,
    method: Annotated[MultiTask, typer.Option(help="Which learners to run.")] = MultiTask.all,
    sessions: Annotated[
        int | None,
        count_option("Sessions of the online learner; they end at the numbers above unless given."),
    ] = None,
    n_components: Annotated[
        int,
        typer.Option(
            "--components",
            min=1,
            max=10**7,
            help="Components that MME-MTIRL starts with: the most it can find.",
        ),
    ] = 4,
    steps: Annotated[int, count_option("Steps of a trajectory.")] = 50,
    replications: Annotated[int, count_option("Independent repetitions.")] = 3,
    belts: Annotated[int, count_option("Simulated belts of Table 7.2.")] = 300,
    seed: Seed = 0,
    folder: Annotated[Path, typer.Option(help="Folder of the page and its results.")] = Path(
        "report-sorting"
    ),
    as_json: Json = False,
) -> None:
    """Learn the components of onion sorting from mixed demonstrations: number, rewards and trajectories."""
    from ..studies.sorting import page as sorting_page
    from ..studies.sorting import study as sorting_study

    with reported_errors(), progress(as_json) as advance:
        study = sorting_study.sorting_study(
            tasks,
            sorting_study.counts_of(tasks, trajectories),
            replications=replications,
            seed=seed,
            sessions=sessions,
            n_components=n_components,
            steps=steps,
            belts=belts,
            advance=advance,
            methods=None if method is MultiTask.all else (method.value,),
        )
        sorting_page.write(study, folder)
    print_results(sorting_page, study, folder, as_json)


@commands.command("robust-airl")
def run_robust_airl(
    domain: Annotated[Domain, typer.Option(help="Task, with its expert and its sensor.")] = Domain.hopper,
    replications: Annotated[int, count_option("Independent repetitions.")] = 1,
    sessions: Annotated[int | None, count_option("Sessions; by default the study's own number.")] = None,
    noise: Annotated[
        float, real_option("Times the study's noise (covariance, shift or probability).", 0)
    ] = 1.0,
    workers: Annotated[int, count_option("Processes that share the replications.", most=1024)] = 1,
    cache: Annotated[
        Path | None, typer.Option(help="Folder of finished replications; a later command reuses them.")
    ] = None,
    folder: Annotated[Path, typer.Option(help="Folder of the page and its results.")] = Path(
        "report-robust-airl"
    ),
    as_json: Json = False,
) -> None:
    """Learn rewards as networks from noisy observations by AIRL, robust-AIRL and SSRR; judge them by the true
    reward.
    """
    from ..studies.adversarial import running as robust_airl

    with reported_errors(), progress(as_json) as advance:
        results = robust_airl.answer(
            domain.value, replications, sessions, noise, workers=workers, cache=cache, advance=advance
        )
        robust_airl.write(results, folder)
    print_results(robust_airl, results, folder, as_json)


NoisyRuns = Annotated[int, count_option("Independent repetitions.")]
NoisySessions = Annotated[int, count_option("Sessions, of two trajectories of three pairs each.")]
Draws = Annotated[
    int, count_option("Draws of each of two chains of the joint posterior; none are sampled for 0.", 0)
]
StartsOption = Annotated[
    NoisyStarts,
    typer.Option(help="Trajectories start in all states alike, or where the task naturally does."),
]


@commands.command("noisy-sorting")
def run_noisy_sorting(
    replications: NoisyRuns = 50,
    sessions: NoisySessions = 20,
    starts: StartsOption = NoisyStarts.all,
    belts: Annotated[int, count_option("Simulated belts for each method.")] = 1000,
    draws: Draws = 100,
    seed: Seed = 0,
    folder: Annotated[Path, typer.Option(help="Folder of the page and its results.")] = Path(
        "report-noisy-sorting"
    ),
    as_json: Json = False,
) -> None:
    """Learn to sort onions from noisy observations, and the noise."""
    _run_noisy("sorting", replications, sessions, starts, seed, folder, as_json, belts=belts, draws=draws)


@commands.command("noisy-patrol")
def run_noisy_patrol(
    replications: NoisyRuns = 50,
    sessions: NoisySessions = 20,
    starts: StartsOption = NoisyStarts.all,
    draws: Draws = 100,
    seed: Seed = 0,
    folder: Annotated[Path, typer.Option(help="Folder of the page and its results.")] = Path(
        "report-noisy-patrol"
    ),
    as_json: Json = False,
) -> None:
    """Learn a patroller's reward from noisy observations, also with most of the patrol out of view."""
    _run_noisy("patrol", replications, sessions, starts, seed, folder, as_json, draws=draws)


def _run_noisy(
    task: str,
    replications: int,
    sessions: int,
    starts: NoisyStarts,
    seed: int,
    folder: Path,
    as_json: bool,
    **options: Any,
) -> None:
    from ..studies.noisy import page as noisy_page
    from ..studies.noisy import study as noisy_study

    with reported_errors(), progress(as_json) as advance:
        study = noisy_study.noisy_study(
            task,
            replications=replications,
            sessions=sessions,
            starts=starts.value,
            seed=seed,
            advance=advance,
            **options,
        )
        noisy_page.write(study, folder)
    print_results(noisy_page, study, folder, as_json)
