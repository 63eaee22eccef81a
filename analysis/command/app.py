"""The command line: ``i2rl run``, ``bounds``, ``simulate``, ``learn`` and ``show``.

Heavy modules are imported inside the commands, so that ``--help`` answers at once.
"""

from __future__ import annotations

import json
import math
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from ...compilation import keep_programs
from ..drawing.results import plain

if TYPE_CHECKING:
    from numpy.typing import ArrayLike
    from rich.console import Console

    from ...inference.journal.journal import JournalView, SessionRecord
    from ...models.observation.evidence import AnySensor
    from ...models.process.mdp import TabularMDP

BROKEN_PIPE = 128 + 13
"""Exit status of a command whose reader went away, as the shell gives it to one that SIGPIPE ends."""


LONGEST_MESSAGE = 1000


class _Commands(TyperGroup):
    """Commands that end quietly, as other tools do, when the reader of their output (``head``) goes away."""

    def invoke(self, ctx: Any) -> Any:
        try:
            result = super().invoke(ctx)
            sys.stdout.flush()  # not left to the interpreter's exit, which would complain
            return result
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(BROKEN_PIPE) from None


app = typer.Typer(
    cls=_Commands,
    help="Learn why somebody acts as they do, while they are still acting, from imperfect observations.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
run = typer.Typer(
    help="Do a whole study: learn, evaluate, and write a report with pictures.", no_args_is_help=True
)
simulate = typer.Typer(help="Write simulated demonstrations as JSON Lines.", no_args_is_help=True)
app.add_typer(run, name="run")
app.add_typer(simulate, name="simulate")


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
    em_mlirl_untold = "em-mlirl-untold"
    all = "all"


class NoisyStarts(StrEnum):
    """Where trajectories of ``run noisy-sorting`` and ``run noisy-patrol`` start."""

    all = "all"
    natural = "natural"


class Domain(StrEnum):
    """Tasks that ``run robust-airl`` knows."""

    patrol = "patrol"
    mountain_car = "mountain-car"
    hopper = "hopper"
    walker2d = "walker2d"
    half_cheetah = "half-cheetah"
    onion = "onion"


def _count(help: str, least: int = 1, most: int = 10**7) -> Any:
    """A whole number that can be counted to."""
    return typer.Option(min=least, max=most, help=help)


def _real(help: str, least: float | None = None, most: float | None = None) -> Any:
    """A finite number; a range alone would let NaN pass."""
    return typer.Option(min=least, max=most, help=help, callback=_finite)


def _finite(value: float | None) -> float | None:
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter(f"{value} is not a finite number.")
    return value


def _seed(help: str) -> Any:
    """A seed; NumPy, JAX and PyMC take 32 bits without a sign."""
    return typer.Option(min=0, max=2**32 - 1, help=help)


Json = Annotated[bool, typer.Option("--json", help="Print JSON for machines instead of tables.")]
Instance = Annotated[int, typer.Option(min=1, max=3, help="Patrol instance (1, 2 or 3).")]
Seed = Annotated[int, _seed("Random seed; the same seed gives the same result.")]
Percent = Annotated[
    int | None,
    _count("Percent of the patrol in view (100: everything); by default the instance's own.", 0, 100),
]


def _print_version(wanted: bool) -> None:
    if wanted:
        from ...version import __version__

        print(__version__)
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit."),
    ] = False,
) -> None:
    pass


# -- run ----------------------------------------------------------------------------------------------


@run.command("patrol")
def run_patrol(
    instance: Instance = 2,
    observability: Percent = None,
    sessions: Annotated[int, _count("Sessions of five steps a patroller.")] = 60,
    method: Annotated[Method, typer.Option(help="Which learners to run.")] = Method.all,
    trials: Annotated[int, _count("Simulated breaches per learned policy.")] = 200,
    runs: Annotated[int, _count("Independent repetitions.")] = 3,
    seed: Seed = 0,
    report: Annotated[Path, typer.Option(help="Folder for the report.")] = Path("report"),
    as_json: Json = False,
) -> None:
    """Watch patrollers through a keyhole, learn their reward online, and walk past them unseen."""
    from ..studies.patrol import study as patrol_study

    with _reported_errors(), _progress(as_json) as advance:
        study = patrol_study.patrol_study(
            instance, observability, sessions=sessions, trials=trials, runs=runs, seed=seed,
            methods=None if method is Method.all else (method.value,), advance=advance,
        )  # fmt: skip
        patrol_study.write(study, report)
    _tell(patrol_study, study, report, as_json)


@run.command("labyrinth")
def run_labyrinth(
    recording: Annotated[
        Path, typer.Option(help="JSON Lines file of bouts, each with its sequence of nodes.")
    ],
    hide_left: Annotated[
        bool, typer.Option(help="Learn also with the left half of the maze out of view.")
    ] = True,
    discount: Annotated[float | None, _real("Discount of the animal's future.", 0, 1)] = None,
    ridge: Annotated[float | None, _real("Precision of the weights' Gaussian prior.", 0)] = None,
    report: Annotated[Path, typer.Option(help="Folder for the report.")] = Path("report-labyrinth"),
    as_json: Json = False,
) -> None:
    """Learn a mouse's reward in a labyrinth, bout by bout, each bout predicted before it is learned from."""
    from ...domains.labyrinth.process import read_bouts
    from ..studies.labyrinth import page as labyrinth_page
    from ..studies.labyrinth import study as labyrinth

    with _reported_errors(), _progress(as_json) as advance:
        with recording.open("rb") as lines:
            bouts = list(read_bouts(lines, recording.name))
        study = labyrinth.labyrinth_study(
            bouts, recording=recording.stem, hide_left=hide_left,
            discount=labyrinth.DISCOUNT if discount is None else discount,
            ridge=labyrinth.RIDGE if ridge is None else ridge,
            on_bout=lambda view, number, bits: advance(f"{view}: bout {number}, {bits:.3f} bits", None),
        )  # fmt: skip
        labyrinth_page.write(study, report)
    _tell(labyrinth_page, study, report, as_json)


# -- bounds -------------------------------------------------------------------------------------------


@app.command()
def bounds(
    features: Annotated[int | None, _count("Number of reward features, K.", most=10**6)] = None,
    epsilon: Annotated[float, _real("Error of a feature's discounted average, below 1.", 1e-9, 1)] = 0.1,
    confidence: Annotated[float, _real("Probability with which the bound is to hold.", 0, 1)] = 0.8,
    epsilon_s: Annotated[float, _real("Error of sampling the hidden steps, below 1.", 1e-9, 1)] = 0.05,
    discount: Annotated[float | None, _real("Discount, below 1; 0.99 unless --mdp says.", 0, 1)] = None,
    deviation: Annotated[
        float | None, _real("Standard deviation of the features' discounted averages.", 0, 0.5)
    ] = None,
    mdp: Annotated[
        str | None, typer.Option(help="patrol1, patrol2 or patrol3: its features, discount and spread.")
    ] = None,
    predicates: Annotated[
        int | None, _count("Predicates whose reliabilities noisy perception is described by.")
    ] = None,
    steps: Annotated[int | None, _count("Steps of a trajectory, with --predicates.")] = None,
    as_json: Json = False,
) -> None:
    """Say how many demonstrations are enough: by the theorem, by tighter bounds, and what is assumed."""
    from ..bounds import sample_sizes as bounds_answer

    with _reported_errors():
        answer = bounds_answer.answer(
            features,
            epsilon,
            confidence,
            epsilon_s,
            discount,
            deviation,
            mdp,
            bounds_answer.PerceptionSize(predicates, steps),
        )
    if as_json:
        print(json.dumps(plain(bounds_answer.summary(answer))))
    else:
        bounds_answer.print_answer(answer, _console())


@run.command("methods")
def run_methods(
    instance: Instance = 2,
    sessions: Annotated[int, _count("Sessions of five steps a patroller.")] = 120,
    runs: Annotated[int, _count("Independent repetitions.")] = 3,
    seed: Seed = 0,
    report: Annotated[Path, typer.Option(help="Folder for the report.")] = Path("report-methods"),
    as_json: Json = False,
) -> None:
    """Compare online methods on a patrol in full view: how many pairs does each need, what does it keep?"""
    from ..studies.methods import study as online_methods

    with _reported_errors(), _progress(as_json) as advance:
        study = online_methods.methods_study(
            instance, sessions=sessions, runs=runs, seed=seed, advance=advance
        )
        online_methods.write(study, report)
    _tell(online_methods, study, report, as_json)


@run.command("label-bias")
def run_label_bias(
    worlds: Annotated[int, _count("Object Worlds drawn.")] = 100,
    trajectories: Annotated[int, _count("Expert trajectories a world.", 4)] = 75,
    walls: Annotated[int, _count("Walls a world, of 100 cells.", 0)] = 25,
    seed: Seed = 0,
    report: Annotated[Path, typer.Option(help="Folder for the report.")] = Path("report-label-bias"),
    as_json: Json = False,
) -> None:
    """Does a likelier trajectory earn more? Table 5.1, in many Object Worlds and under many assumptions."""
    from ..studies.label_bias import page as label_bias_report
    from ..studies.label_bias import study as label_bias

    with _reported_errors(), _progress(as_json) as advance:
        study = label_bias.label_bias_study(worlds, trajectories, walls=walls, seed=seed, advance=advance)
        label_bias_report.write(study, report)
    _tell(label_bias_report, study, report, as_json)


@run.command("sorting")
def run_sorting(
    tasks: Annotated[int, _count("Ways of sorting demonstrated, 2 or 3.", 2, 3)] = 2,
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
        _count("Sessions of the online learner; they end at the numbers above unless given."),
    ] = None,
    n_components: Annotated[int, _count("Ways that MME-MTIRL starts from: the most it can find.")] = 4,
    steps: Annotated[int, _count("Steps of a trajectory.")] = 50,
    runs: Annotated[int, _count("Independent repetitions.")] = 3,
    belts: Annotated[int, _count("Simulated belts of Table 7.2.")] = 300,
    seed: Seed = 0,
    report: Annotated[Path, typer.Option(help="Folder for the report.")] = Path("report-sorting"),
    as_json: Json = False,
) -> None:
    """Learn several ways of sorting onions from one jumble: how many there are, who did what, and why."""
    from ..studies.sorting import page as sorting_report
    from ..studies.sorting import study as sorting_study

    with _reported_errors(), _progress(as_json) as advance:
        study = sorting_study.sorting_study(
            tasks, sorting_study.counts_of(tasks, trajectories), runs=runs, seed=seed, sessions=sessions,
            n_components=n_components, steps=steps, belts=belts, advance=advance,
            methods=None if method is MultiTask.all else (method.value,),
        )  # fmt: skip
        sorting_report.write(study, report)
    _tell(sorting_report, study, report, as_json)


@run.command("robust-airl")
def run_robust_airl(
    domain: Annotated[Domain, typer.Option(help="Task, with its expert and its sensor.")] = Domain.hopper,
    seeds: Annotated[int, _count("Independent repetitions.")] = 1,
    sessions: Annotated[int | None, _count("Sessions; by default the study's own number.")] = None,
    noise: Annotated[float, _real("Times the study's noise (covariance, shift or probability).", 0)] = 1.0,
    workers: Annotated[int, _count("Processes that share the runs.", most=1024)] = 1,
    kept: Annotated[
        Path | None, typer.Option(help="Folder where finished runs are kept and found again.")
    ] = None,
    report: Annotated[Path, typer.Option(help="Folder for the report.")] = Path("report-robust-airl"),
    as_json: Json = False,
) -> None:
    """Learn rewards as networks from noisy reports: AIRL, robust-AIRL and SSRR, judged by the true reward."""
    from ..studies.adversarial import running as robust_airl

    with _reported_errors(), _progress(as_json) as advance:
        results = robust_airl.answer(
            domain.value, seeds, sessions, noise, workers=workers, kept=kept, advance=advance
        )
        robust_airl.write(results, report)
    _tell(robust_airl, results, report, as_json)


NoisyRuns = Annotated[int, _count("Independent repetitions.")]
NoisySessions = Annotated[int, _count("Sessions, of two trajectories of three pairs each.")]
StartsOption = Annotated[
    NoisyStarts,
    typer.Option(help="Trajectories start in all states alike, or where the task naturally does."),
]


@run.command("noisy-sorting")
def run_noisy_sorting(
    runs: NoisyRuns = 50,
    sessions: NoisySessions = 20,
    starts: StartsOption = NoisyStarts.all,
    belts: Annotated[int, _count("Simulated belts for each method.")] = 1000,
    seed: Seed = 0,
    report: Annotated[Path, typer.Option(help="Folder for the report.")] = Path("report-noisy-sorting"),
    as_json: Json = False,
) -> None:
    """Learn to sort onions from reports that may be wrong, and how often they are."""
    _run_noisy("sorting", runs, sessions, starts, seed, report, as_json, belts=belts)


@run.command("noisy-patrol")
def run_noisy_patrol(
    runs: NoisyRuns = 50,
    sessions: NoisySessions = 20,
    starts: StartsOption = NoisyStarts.all,
    seed: Seed = 0,
    report: Annotated[Path, typer.Option(help="Folder for the report.")] = Path("report-noisy-patrol"),
    as_json: Json = False,
) -> None:
    """Learn a patroller's reward from reports that may be wrong, also where most of it is out of view."""
    _run_noisy("patrol", runs, sessions, starts, seed, report, as_json)


def _run_noisy(
    task: str,
    runs: int,
    sessions: int,
    starts: NoisyStarts,
    seed: int,
    report: Path,
    as_json: bool,
    **options: Any,
) -> None:
    from ..studies.noisy import page as noisy_report
    from ..studies.noisy import study as noisy_study

    with _reported_errors(), _progress(as_json) as advance:
        study = noisy_study.noisy_study(
            task, runs=runs, sessions=sessions, starts=starts.value, seed=seed, advance=advance, **options
        )
        noisy_report.write(study, report)
    _tell(noisy_report, study, report, as_json)


# -- simulate -----------------------------------------------------------------------------------------


@simulate.command("patrol")
def simulate_patrol(
    instance: Instance = 2,
    observability: Percent = None,
    sessions: Annotated[int, _count("Trajectories per patroller.")] = 60,
    steps: Annotated[int, _count("Steps of a trajectory.")] = 5,
    seed: Seed = 0,
) -> None:
    """Write what a learner sees of the patrollers, one trajectory a line, to standard output."""
    import jax

    from ...domains.patrol.process import demonstrate
    from ...domains.patrol.process import instance as patrol_instance
    from ...models.observation.demonstration import write_trajectories

    with _reported_errors():
        patrol = patrol_instance(instance)
        demonstrations = demonstrate(jax.random.key(seed), patrol, observability, sessions, steps)
        for i in range(sessions):
            for agent, demonstration in enumerate(demonstrations):
                name = f"{patrol.name}-{i}-{agent}"
                write_trajectories(
                    sys.stdout, demonstration.select([i]), patrol.mdp, ids=[name], agents=[agent]
                )  # fmt: skip


# -- learn --------------------------------------------------------------------------------------------


@app.command()
def learn(
    mdp: Annotated[str, typer.Option(help="patrol1, patrol2, patrol3, labyrinth, or an MDP.npz file.")],
    demos: Annotated[str, typer.Option(help="JSON Lines file of trajectories, or - for standard input.")],
    journal: Annotated[
        Path, typer.Option(help="SQLite file that keeps every session; resumed if it exists.")
    ],
    observability: Annotated[
        int | None, _count("Percent in view, for the patrols; a file's in_view array otherwise.", 0, 100)
    ] = None,
    session_size: Annotated[int, _count("Trajectories a session.")] = 1,
    agent: Annotated[int | None, typer.Option(help="Learn from this agent's lines only.")] = None,
    statistic: Annotated[
        str, typer.Option(help="What is kept of a session: seen, counts or features.")
    ] = "seen",
    solver: Annotated[str, typer.Option(help="newton, ipopt, cvxpy or 'exponentiated gradient'.")] = "newton",
    slack: Annotated[float | None, _real("L1 slack, nats per trajectory.", 0)] = None,
    ridge: Annotated[float, _real("Precision of a Gaussian prior on the weights.", 0)] = 0.0,
    follow: Annotated[
        bool, typer.Option("--follow", help="Keep waiting for new lines, also when the file is rotated.")
    ] = False,
    quarantine: Annotated[
        Path | None, typer.Option(help="Set bad lines aside in this file, with reasons, and go on past them.")
    ] = None,
    line_bytes: Annotated[int, _count("Most bytes of a line; a longer one is bad.", most=2**40)] = 4 * 2**20,
    line_steps: Annotated[int, _count("Most steps of a trajectory; a longer one is bad.")] = 10_000,
    seed: Annotated[int, _seed("Seed of the first weights; ignored when resuming.")] = 0,
    as_json: Json = False,
) -> None:
    """Learn online from a stream of trajectories; safe to interrupt, and to run again.

    Every session is on disk before the next begins. Run the same command again and it goes on where it
    stopped, to the bit. It checks that the input begins with the lines that it learned from: of a file that
    was rotated, give all parts one after the other, on standard input.
    """
    import jax

    from ...inference.journal.journal import Journal, journal_files, require_apart
    from ...inference.learners.lme import DEFAULT_SLACK, lme_i2rl
    from ...models.observation.demonstration import LineLimits
    from .quarantine import Quarantine
    from .stream import learn_stream, open_lines

    with _reported_errors():
        process, sensor = _decision_process(mdp, observability)
        learner = lme_i2rl(
            process, sensor, statistic=statistic, solver=solver, ridge=ridge,
            slack=DEFAULT_SLACK if slack is None else slack,
        )  # fmt: skip
        # Another agent is another expert, and other sessions are another history: a journal of one must
        # not go on with the other.
        stream = ({} if agent is None else {"agent": agent}) | (
            {} if session_size == 1 else {"session_size": session_size}
        )
        learner = learner._replace(configuration={**learner.configuration, **stream})
        limits = LineLimits(line_bytes, line_steps)
        if quarantine is not None:
            require_apart("--quarantine", quarantine, demos, *journal_files(journal))
        lines, source = open_lines(demos, follow, limits, skip=quarantine is not None, say=_say)
        with Journal.open(journal, learner) as opened, _progress(as_json) as advance:
            before = opened.session
            aside = None if quarantine is None else Quarantine(quarantine)

            def report_session(report: Any) -> None:
                if as_json:
                    print(json.dumps(plain(report._asdict())), flush=True)
                advance(f"session {report.session}", None)

            try:
                done = learn_stream(
                    learner, lines, opened, jax.random.key(seed), size=session_size, agent=agent,
                    source=source, on_session=report_session, limits=limits, quarantine=aside,
                )  # fmt: skip
            except KeyboardInterrupt:
                _say(f"Interrupted; {opened.session} sessions are in {journal}. Run again to go on.")
                raise typer.Exit(130) from None
            except BrokenPipeError:
                _say(f"The output's reader went away; {opened.session} sessions are in {journal}. "
                     "Run again to go on.")  # fmt: skip
                raise
            if aside is not None:
                counts = f"{aside.added} new, {aside.lines} in all"
                _say(f"Lines set aside in {quarantine}: {counts}.")
            if not as_json:
                _print_weights(process, opened.state)
                print(f"{done} sessions learned ({before} were in {journal} before).")


@app.command()
def show(
    journal: Annotated[Path, typer.Argument(help="A journal written by learn.")],
    export: Annotated[Path | None, typer.Option(help="Also write the history to this NetCDF file.")] = None,
    last: Annotated[int | None, _count("Sessions to show; 10, or all with --json, unless given.")] = None,
    verify: Annotated[
        bool, typer.Option("--verify", help="Check the whole file against its digests first.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Show what a journal holds; works while a learner is writing it.

    Sessions that are shown are checked against their digests, and no others are read.
    """
    from ...inference.journal.journal import Journal

    with _reported_errors(), Journal.read(journal) as view:
        if view.lacks_log:
            _say(f"Sessions may be missing: {journal} was moved or copied without its {journal}-wal while a "
                 "learner had it open, or after a kill.")  # fmt: skip
        if verify:
            _say(f"All {view.verify()} sessions are as they were committed.")
        if export is not None:
            view.to_netcdf(export)
        if as_json:
            _print_sessions(view, last)
            return
        _print_history(view, list(view.records(10 if last is None else last)))
        if export is not None:
            print(f"Exported to {export}")


def _print_sessions(view: JournalView, last: int | None) -> None:
    """One JSON object, a session a line, so that a long history is never held whole."""
    print(f'{{"origin": {json.dumps(plain(view.origin._asdict()))}, "sessions": [', end="")
    for i, r in enumerate(view.records(last)):
        fields = {
            "session": r.session,
            "committed": r.committed,
            "weights": r.weights.tolist(),
            **plain(r.report),
        }
        print(f"{',' if i else ''}\n{json.dumps(fields)}", end="")
    print("\n]}")


# -- shared -------------------------------------------------------------------------------------------


def _tell(teller: Any, study: Any, folder: Path, as_json: bool) -> None:
    """Print a study's results: those of its page's ``results.json``, or its tables and where the page is."""
    from ..drawing.text import printable

    if as_json:
        print(json.dumps(json.loads((folder / "results.json").read_text(encoding="utf-8"))))
        return
    teller.print_tables(study, _console())
    print(printable(f"Report: {folder / 'index.html'}"))


def _decision_process(name: str, observability: int | None) -> tuple[TabularMDP, AnySensor]:
    from ...models.observation.evidence import Sensor, Visibility

    if name in ("patrol1", "patrol2", "patrol3"):
        from ...domains.patrol.process import instance

        patrol = instance(int(name[-1]))
        return patrol.mdp, patrol.visibility(observability)
    if observability is not None:
        raise ValueError("--observability is for the patrols; give an MDP file an in_view array instead")
    if name == "labyrinth":
        from ...domains.labyrinth.process import mouse_labyrinth

        return mouse_labyrinth().mdp, Sensor()
    if not name.endswith(".npz"):
        raise ValueError(f"--mdp is patrol1, patrol2, patrol3, labyrinth or an .npz file, got {name!r}")
    from ...models.observation.storage import load_mdp

    stored = load_mdp(name)
    return stored.mdp, Sensor() if stored.in_view is None else Visibility(stored.in_view)


@contextmanager
def _reported_errors() -> Iterator[None]:
    """Mistakes in what was given end with one clear line, not a traceback."""
    from ...inference.journal.journal import JournalError
    from ...inference.programs.constraints import ProgramNotSolved

    try:
        yield
    except BrokenPipeError:
        raise
    except (ValueError, OSError, JournalError, ProgramNotSolved) as error:
        if os.environ.get("I2RL_TRACEBACK"):
            raise
        message = str(error)
        if isinstance(error, OSError) and error.filename is not None:
            message = f"{error.filename}: {error.strerror}"
        if len(message) > LONGEST_MESSAGE:
            message = f"{message[: LONGEST_MESSAGE - 200]} ... {message[-200:]}"
        _say(f"Error: {message}")
        raise typer.Exit(1) from None
    except MemoryError:
        _say("Error: there is not enough memory for so much; ask for less")
        raise typer.Exit(1) from None


@contextmanager
def _progress(quiet: bool) -> Iterator[Any]:
    """A progress bar on a terminal; ``advance(description, fraction)``, nothing elsewhere."""
    if quiet or not sys.stderr.isatty():
        yield lambda description, fraction: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    from ..drawing.text import printable

    description = TextColumn("{task.description}", markup=False)
    columns = (SpinnerColumn(), description, BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("starting", total=None)

        def advance(description: str, fraction: float | None) -> None:
            total = None if fraction is None else 1.0
            bar.update(task, description=printable(description), total=total, completed=fraction or 0.0)

        yield advance


def _interrupt_again(unraisable: Any) -> None:
    """Raise Ctrl-C once more where Python swallowed it: in JAX's callback of the garbage collector."""
    if unraisable.exc_type is KeyboardInterrupt:
        main_thread = threading.main_thread().ident
        threading.Timer(0.01, signal.pthread_kill, (main_thread, signal.SIGINT)).start()
    else:
        sys.__unraisablehook__(unraisable)


def _console() -> Console:
    """Tables fit the terminal, and are not squeezed where there is none."""
    from rich.console import Console

    class Output(Console):
        def on_broken_pipe(self) -> None:
            raise BrokenPipeError  # where Rich would end the process

    return Output(width=None if sys.stdout.isatty() else 120)


def _say(text: str) -> None:
    from ..drawing.text import printable

    print(printable(text), file=sys.stderr)


def _print_weights(mdp: TabularMDP, state: Any) -> None:
    if state is None:
        return
    title = f"Reward after {int(state.session)} sessions"
    _print_rewards(_console(), mdp.feature_names, state.weights, title)


def _print_history(view: JournalView, records: list[SessionRecord]) -> None:
    from rich.table import Table

    from ..drawing.text import for_terminal

    origin = view.origin
    console = _console()
    console.print(for_terminal(f"{origin.method} on an MDP of {origin.n_states} states and "
                               f"{origin.n_actions} actions; {view.sessions} sessions"))  # fmt: skip
    if not records:
        return
    table = Table(title=f"Last {len(records)} sessions")
    formats = {"log_likelihood": ".4f", "iterations": ".0f", "seconds": ".4f"}
    titles = {"log_likelihood": "log-likelihood (nats/trajectory)", "iterations": "EM steps"}
    shown = [name for name in formats if name in records[-1].report]
    for column in ("session", *(titles.get(name, name) for name in shown)):
        table.add_column(column, justify="right")
    for r in records:
        table.add_row(str(r.session), *(f"{float(r.report[name]):{formats[name]}}" for name in shown))
    console.print(table)
    weights = records[-1].weights
    if weights.shape[-1:] == (len(origin.feature_names),) and weights.ndim <= 2:
        _print_rewards(console, origin.feature_names, weights, "Reward weights")
    if "agreement" in records[-1].report:
        sensor = Table(title="How often reports agree with the truth")
        sensor.add_column("predicate")
        sensor.add_column("agreement", justify="right")
        for j, agreement in enumerate(records[-1].report["agreement"]):
            sensor.add_row(str(j), f"{agreement:.3f}")
        console.print(sensor)


def _print_rewards(console: Console, names: Sequence[str], weights: ArrayLike, title: str) -> None:
    """Print weights ``[K]`` or ``[n, K]`` as a table, a feature a row: two columns for each reward."""
    import numpy as np
    from rich.table import Table

    from ..drawing.text import for_terminal

    rewards = np.atleast_2d(np.asarray(weights))
    table = Table(title=title)
    table.add_column("feature")
    scales = np.maximum(np.abs(rewards).sum(1), 1e-300)
    for i in range(len(rewards)):
        number = f" {i}" if len(rewards) > 1 else ""
        for column in (f"weight{number}", f"L1-normalised{number}"):
            table.add_column(column, justify="right")
    for name, row in zip(names, rewards.T, strict=True):
        cells = [x for w, scale in zip(row, scales, strict=True) for x in (f"{w:.3f}", f"{w / scale:.3f}")]
        table.add_row(for_terminal(name), *cells)
    console.print(table)


def main() -> None:
    """Entry point of the ``i2rl`` command."""
    sys.unraisablehook = _interrupt_again
    if sys.stdout is None:  # closed by whoever started this
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
    keep_programs()
    app()


if __name__ == "__main__":
    main()
