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
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rich.console import Console

    from ..models.evidence import Imperfection
    from ..models.mdp import TabularMDP

app = typer.Typer(
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


Json = Annotated[bool, typer.Option("--json", help="Print JSON for machines instead of tables.")]
Instance = Annotated[int, typer.Option(min=1, max=3, help="Patrol instance (1, 2 or 3).")]
Seed = Annotated[int, typer.Option(help="Random seed; the same seed gives the same result.")]


def _print_version(wanted: bool) -> None:
    if wanted:
        from ..version import __version__

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
    observability: Annotated[
        int | None,
        typer.Option(help="Percent of the patrol in view; by default the dissertation's (30, 30, 18)."),
    ] = None,
    sessions: Annotated[int, typer.Option(min=1, help="Sessions of five steps a patroller.")] = 60,
    method: Annotated[Method, typer.Option(help="Which learners to run.")] = Method.all,
    trials: Annotated[int, typer.Option(min=1, help="Simulated breaches per learned policy.")] = 200,
    runs: Annotated[int, typer.Option(min=1, help="Independent repetitions.")] = 3,
    seed: Seed = 0,
    report: Annotated[Path, typer.Option(help="Folder for the report.")] = Path("report"),
    as_json: Json = False,
) -> None:
    """Watch patrollers through a keyhole, learn their reward online, and walk past them unseen."""
    from . import patrol_study

    with _reported_errors(), _progress(as_json) as advance:
        study = patrol_study.study(
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
    discount: Annotated[
        float | None, typer.Option(min=0, max=1, help="Discount of the animal's future.")
    ] = None,
    ridge: Annotated[
        float | None, typer.Option(min=0, help="Precision of the weights' Gaussian prior.")
    ] = None,
    report: Annotated[Path, typer.Option(help="Folder for the report.")] = Path("report-labyrinth"),
    as_json: Json = False,
) -> None:
    """Learn a mouse's reward in a labyrinth, bout by bout, each bout predicted before it is learned from."""
    from ..domains.labyrinth import read_bouts
    from . import labyrinth

    with _reported_errors(), _progress(as_json) as advance:
        with recording.open(encoding="utf-8") as lines:
            bouts = list(read_bouts(lines, recording.name))
        study = labyrinth.study(
            bouts, recording=recording.stem, hide_left=hide_left,
            discount=labyrinth.DISCOUNT if discount is None else discount,
            ridge=labyrinth.RIDGE if ridge is None else ridge,
            on_bout=lambda view, number, bits: advance(f"{view}: bout {number}, {bits:.3f} bits", None),
        )  # fmt: skip
        labyrinth.write(study, report)
    _tell(labyrinth, study, report, as_json)


# -- bounds -------------------------------------------------------------------------------------------


@app.command()
def bounds(
    features: Annotated[int | None, typer.Option(help="Number of reward features, K.")] = None,
    epsilon: Annotated[float, typer.Option(help="Error of a feature's discounted average, in (0, 1).")] = 0.1,
    confidence: Annotated[float, typer.Option(help="Probability with which the bound is to hold.")] = 0.8,
    epsilon_s: Annotated[float, typer.Option(help="Error of sampling the hidden steps.")] = 0.05,
    discount: Annotated[float | None, typer.Option(help="Discount; 0.99 unless --mdp says.")] = None,
    deviation: Annotated[
        float | None, typer.Option(help="Standard deviation of the features' discounted averages.")
    ] = None,
    mdp: Annotated[
        str | None, typer.Option(help="patrol1, patrol2 or patrol3: its features, discount and spread.")
    ] = None,
    predicates: Annotated[
        int | None, typer.Option(help="Predicates whose reliabilities noisy perception is described by.")
    ] = None,
    steps: Annotated[int | None, typer.Option(help="Steps of a trajectory, with --predicates.")] = None,
    as_json: Json = False,
) -> None:
    """Say how many demonstrations are enough: by the theorem, by tighter bounds, and what is assumed."""
    from . import bounds_answer

    with _reported_errors():
        answer = bounds_answer.answer(
            features, epsilon, confidence, epsilon_s, discount, deviation, mdp, predicates, steps
        )
    if as_json:
        print(json.dumps(_plain(bounds_answer.summary(answer))))
    else:
        bounds_answer.print_answer(answer, _console())


@run.command("methods")
def run_methods(
    instance: Instance = 2,
    sessions: Annotated[int, typer.Option(min=1, help="Sessions of five steps a patroller.")] = 120,
    runs: Annotated[int, typer.Option(min=1, help="Independent repetitions.")] = 3,
    seed: Seed = 0,
    report: Annotated[Path, typer.Option(help="Folder for the report.")] = Path("report-methods"),
    as_json: Json = False,
) -> None:
    """Compare online methods on a patrol in full view: how many pairs does each need, what does it keep?"""
    from . import online_methods

    with _reported_errors(), _progress(as_json) as advance:
        study = online_methods.study(instance, sessions=sessions, runs=runs, seed=seed, advance=advance)
        online_methods.write(study, report)
    _tell(online_methods, study, report, as_json)


@run.command("label-bias")
def run_label_bias(
    worlds: Annotated[int, typer.Option(min=1, help="Object Worlds drawn.")] = 100,
    trajectories: Annotated[int, typer.Option(min=4, help="Expert trajectories a world.")] = 75,
    walls: Annotated[int, typer.Option(min=0, help="Walls a world, of 100 cells.")] = 25,
    seed: Seed = 0,
    report: Annotated[Path, typer.Option(help="Folder for the report.")] = Path("report-label-bias"),
    as_json: Json = False,
) -> None:
    """Does a likelier trajectory earn more? Table 5.1, in many Object Worlds and under many assumptions."""
    from . import label_bias, label_bias_report

    with _reported_errors(), _progress(as_json) as advance:
        study = label_bias.study(worlds, trajectories, walls=walls, seed=seed, advance=advance)
        label_bias_report.write(study, report)
    _tell(label_bias_report, study, report, as_json)


@run.command("sorting")
def run_sorting(
    tasks: Annotated[int, typer.Option(help="Ways of sorting demonstrated, 2 or 3.")] = 2,
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
        typer.Option(help="Sessions of the online learner; they end at the numbers above unless given."),
    ] = None,
    ways: Annotated[int, typer.Option(help="Ways that MME-MTIRL starts from: the most it can find.")] = 4,
    steps: Annotated[int, typer.Option(help="Steps of a trajectory.")] = 50,
    runs: Annotated[int, typer.Option(help="Independent repetitions.")] = 3,
    belts: Annotated[int, typer.Option(help="Simulated belts of Table 7.2.")] = 300,
    seed: Seed = 0,
    report: Annotated[Path, typer.Option(help="Folder for the report.")] = Path("report-sorting"),
    as_json: Json = False,
) -> None:
    """Learn several ways of sorting onions from one jumble: how many there are, who did what, and why."""
    from . import sorting_report, sorting_study

    with _reported_errors(), _progress(as_json) as advance:
        study = sorting_study.study(
            tasks, sorting_study.counts_of(tasks, trajectories), runs=runs, seed=seed, sessions=sessions,
            ways=ways, steps=steps, belts=belts, advance=advance,
            methods=None if method is MultiTask.all else (method.value,),
        )  # fmt: skip
        sorting_report.write(study, report)
    _tell(sorting_report, study, report, as_json)


@run.command("robust-airl")
def run_robust_airl(
    domain: Annotated[Domain, typer.Option(help="Task, with its expert and its sensor.")] = Domain.hopper,
    seeds: Annotated[int, typer.Option(min=1, help="Independent repetitions.")] = 1,
    sessions: Annotated[
        int | None, typer.Option(min=1, help="Sessions; by default the study's own number.")
    ] = None,
    noise: Annotated[
        float, typer.Option(min=0, help="Times the study's noise (covariance, shift or probability).")
    ] = 1.0,
    workers: Annotated[int, typer.Option(min=1, help="Processes that share the runs.")] = 1,
    kept: Annotated[
        Path | None, typer.Option(help="Folder where finished runs are kept and found again.")
    ] = None,
    report: Annotated[Path, typer.Option(help="Folder for the report.")] = Path("report-robust-airl"),
    as_json: Json = False,
) -> None:
    """Learn rewards as networks from noisy reports: AIRL, robust-AIRL and SSRR, judged by the true reward."""
    from . import adversarial_answer

    with _reported_errors(), _progress(as_json) as advance:
        results = adversarial_answer.answer(
            domain.value, seeds, sessions, noise, workers=workers, kept=kept, advance=advance
        )
        adversarial_answer.write(results, report)
    _tell(adversarial_answer, results, report, as_json)


NoisyRuns = Annotated[int, typer.Option(min=1, help="Independent repetitions.")]
NoisySessions = Annotated[int, typer.Option(min=1, help="Sessions, of two trajectories of three pairs each.")]
StartsOption = Annotated[
    NoisyStarts,
    typer.Option(help="Trajectories start in all states alike, or where the task naturally does."),
]


@run.command("noisy-sorting")
def run_noisy_sorting(
    runs: NoisyRuns = 50,
    sessions: NoisySessions = 20,
    starts: StartsOption = NoisyStarts.all,
    belts: Annotated[int, typer.Option(min=1, help="Simulated belts for each method.")] = 1000,
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
    from . import noisy_report, noisy_study

    with _reported_errors(), _progress(as_json) as advance:
        study = noisy_study.study(
            task, runs=runs, sessions=sessions, starts=starts.value, seed=seed, advance=advance, **options
        )
        noisy_report.write(study, report)
    _tell(noisy_report, study, report, as_json)


# -- simulate -----------------------------------------------------------------------------------------


@simulate.command("patrol")
def simulate_patrol(
    instance: Instance = 2,
    observability: Annotated[int, typer.Option(help="Percent of the patrol in view (100: everything).")] = 30,
    sessions: Annotated[int, typer.Option(min=1, help="Trajectories per patroller.")] = 60,
    steps: Annotated[int, typer.Option(min=1, help="Steps of a trajectory.")] = 5,
    seed: Seed = 0,
) -> None:
    """Write what a learner sees of the patrollers, one trajectory a line, to standard output."""
    import jax

    from ..domains.patrol import demonstrate
    from ..domains.patrol import instance as patrol_instance
    from ..models.demonstration import write_trajectories

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
        int | None, typer.Option(help="Percent in view, for the patrols; a file's in_view array otherwise.")
    ] = None,
    session_size: Annotated[int, typer.Option(min=1, help="Trajectories a session.")] = 1,
    agent: Annotated[int | None, typer.Option(help="Learn from this agent's lines only.")] = None,
    statistic: Annotated[
        str, typer.Option(help="What is kept of a session: seen, counts or features.")
    ] = "seen",
    solver: Annotated[str, typer.Option(help="newton, ipopt, cvxpy or 'exponentiated gradient'.")] = "newton",
    slack: Annotated[float | None, typer.Option(min=0, help="L1 slack, nats per trajectory.")] = None,
    ridge: Annotated[float, typer.Option(min=0, help="Precision of a Gaussian prior on the weights.")] = 0.0,
    follow: Annotated[bool, typer.Option("--follow", help="Keep waiting for new lines at the end.")] = False,
    seed: Annotated[int, typer.Option(help="Seed of the first weights; ignored when resuming.")] = 0,
    as_json: Json = False,
) -> None:
    """Learn online from a stream of trajectories; safe to interrupt, and to run again.

    Every session is on disk before the next begins. Run the same command again and it goes on where it
    stopped, to the bit.
    """
    import jax

    from ..inference.journal import Journal
    from ..inference.lme import DEFAULT_SLACK, lme_i2rl
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
        lines, source = open_lines(demos, follow)
        with Journal.open(journal, learner) as opened, _progress(as_json) as advance:
            before = opened.session

            def report_session(report: Any) -> None:
                if as_json:
                    print(json.dumps(_plain(report._asdict())), flush=True)
                advance(f"session {report.session}", None)

            try:
                done = learn_stream(
                    learner, lines, opened, jax.random.key(seed), size=session_size, agent=agent,
                    source=source, on_session=report_session,
                )  # fmt: skip
            except KeyboardInterrupt:
                _say(f"Interrupted; {opened.session} sessions are in {journal}. Run again to go on.")
                raise typer.Exit(130) from None
            if not as_json:
                _print_weights(process, opened.state)
                print(f"{done} sessions learned ({before} were in {journal} before).")


@app.command()
def show(
    journal: Annotated[Path, typer.Argument(help="A journal written by learn.")],
    export: Annotated[Path | None, typer.Option(help="Also write the history to this NetCDF file.")] = None,
    last: Annotated[int, typer.Option(min=1, help="Sessions to list.")] = 10,
    as_json: Json = False,
) -> None:
    """Show what a journal holds; works while a learner is writing it."""
    from ..inference.journal import Journal

    with _reported_errors(), Journal.read(journal) as view:
        records = list(view.reports())
        if export is not None:
            view.to_netcdf(export)
        if as_json:
            content = [
                {
                    "session": r.session,
                    "committed": r.committed,
                    "weights": r.weights.tolist(),
                    **_plain(r.report),
                }
                for r in records
            ]
            print(json.dumps({"origin": _plain(view.origin._asdict()), "sessions": content}))
            return
        _print_history(view, records, last)
        if export is not None:
            print(f"Exported to {export}")


# -- shared -------------------------------------------------------------------------------------------


def _tell(teller: Any, study: Any, folder: Path, as_json: bool) -> None:
    """Print a study's results: those of its page's ``results.json``, or its tables and where the page is."""
    from .text import printable

    if as_json:
        print(json.dumps(json.loads((folder / "results.json").read_text(encoding="utf-8"))))
        return
    teller.print_tables(study, _console())
    print(printable(f"Report: {folder / 'index.html'}"))


def _decision_process(name: str, observability: int | None) -> tuple[TabularMDP, Imperfection]:
    from ..models.evidence import Sensor, Visibility

    if name in ("patrol1", "patrol2", "patrol3"):
        from ..domains.patrol import instance

        patrol = instance(int(name[-1]))
        degree = (30, 30, 18)[int(name[-1]) - 1] if observability is None else observability
        return patrol.mdp, patrol.visibility(degree)
    if observability is not None:
        raise ValueError("--observability is for the patrols; give an MDP file an in_view array instead")
    if name == "labyrinth":
        from ..domains.labyrinth import labyrinth

        return labyrinth().mdp, Sensor()
    if not name.endswith(".npz"):
        raise ValueError(f"--mdp is patrol1, patrol2, patrol3, labyrinth or an .npz file, got {name!r}")
    from ..models.storage import load_mdp

    stored = load_mdp(name)
    return stored.mdp, Sensor() if stored.in_view is None else Visibility(stored.in_view)


@contextmanager
def _reported_errors() -> Iterator[None]:
    """Mistakes in what was given end with one clear line, not a traceback."""
    from ..inference.journal import JournalError
    from ..inference.maxent_constraints import ProgramNotSolved

    try:
        yield
        sys.stdout.flush()  # not left to the interpreter's exit, which would complain of a reader that left
    except BrokenPipeError:
        # The reader of our output (head, say) has had enough; Python must not complain at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(0) from None
    except (ValueError, OSError, JournalError, ProgramNotSolved) as error:
        if os.environ.get("I2RL_TRACEBACK"):
            raise
        message = str(error)
        if isinstance(error, OSError) and error.filename is not None:
            message = f"{error.filename}: {error.strerror}"
        _say(f"Error: {message}")
        raise typer.Exit(1) from None


@contextmanager
def _progress(quiet: bool) -> Iterator[Any]:
    """A progress bar on a terminal; ``advance(description, fraction)``, nothing elsewhere."""
    if quiet or not sys.stderr.isatty():
        yield lambda description, fraction: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    from .text import printable

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

    return Console(width=None if sys.stdout.isatty() else 120)


def _say(text: str) -> None:
    from .text import printable

    print(printable(text), file=sys.stderr)


def _plain(value: Any) -> Any:
    """Arrays and tuples as JSON takes them; what is no number becomes null."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(v) for v in value]
    return _plain(value.tolist()) if hasattr(value, "tolist") else value


def _print_weights(mdp: TabularMDP, state: Any) -> None:
    if state is None:
        return
    import numpy as np
    from rich.table import Table

    from .text import for_terminal

    weights = np.asarray(state.weights)
    table = Table(title=f"Reward after {int(state.session)} sessions")
    table.add_column("feature")
    table.add_column("weight", justify="right")
    table.add_column("L1-normalised", justify="right")
    scale = max(float(np.abs(weights).sum()), 1e-300)
    for name, weight in zip(mdp.feature_names, weights, strict=True):
        table.add_row(for_terminal(name), f"{weight:.3f}", f"{weight / scale:.3f}")
    _console().print(table)


def _print_history(view: Any, records: list[Any], last: int) -> None:
    from rich.table import Table

    from .text import for_terminal

    origin = view.origin
    console = _console()
    console.print(for_terminal(f"{origin.method} on an MDP of {origin.n_states} states and "
                               f"{origin.n_actions} actions; {len(records)} sessions"))  # fmt: skip
    if not records:
        return
    table = Table(title=f"Last {min(last, len(records))} sessions")
    for column in ("session", "log-likelihood (nats/trajectory)", "EM steps", "seconds"):
        table.add_column(column, justify="right")
    for r in records[-last:]:
        table.add_row(
            str(r.session), f"{float(r.report['log_likelihood']):.4f}", str(int(r.report["iterations"])),
            f"{float(r.report['seconds']):.4f}",
        )  # fmt: skip
    console.print(table)
    weights = records[-1].weights
    scale = max(float(abs(weights).sum()), 1e-300)
    reward = Table(title="Reward weights")
    for column in ("feature", "weight", "L1-normalised"):
        reward.add_column(column, justify="left" if column == "feature" else "right")
    for name, weight in zip(origin.feature_names, weights, strict=True):
        reward.add_row(for_terminal(name), f"{weight:.3f}", f"{weight / scale:.3f}")
    console.print(reward)
    if "agreement" in records[-1].report:
        sensor = Table(title="How often reports agree with the truth")
        sensor.add_column("predicate")
        sensor.add_column("agreement", justify="right")
        for j, agreement in enumerate(records[-1].report["agreement"]):
            sensor.add_row(str(j), f"{agreement:.3f}")
        console.print(sensor)


def main() -> None:
    """Entry point of the ``i2rl`` command."""
    sys.unraisablehook = _interrupt_again
    app()


if __name__ == "__main__":
    main()
