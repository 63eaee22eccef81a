"""``i2rl learn``: online learning from a stream of trajectories into a journal."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..drawing.results import plain
from .console import output_console, print_message, print_rewards, progress, reported_errors
from .options import Json, count_option, real_option, seed_option

if TYPE_CHECKING:
    from ...models.observation.evidence import AnySensor
    from ...models.process.mdp import TabularMDP


def learn_online(
    mdp: Annotated[str, typer.Option(help="patrol1, patrol2, patrol3, labyrinth, or an MDP.npz file.")],
    demonstrations: Annotated[
        str, typer.Option(help="JSON Lines file of trajectories, or - for standard input.")
    ],
    journal: Annotated[Path, typer.Option(help="SQLite file of every session; resumed if it exists.")],
    observability: Annotated[
        int | None,
        count_option("Percent in view, for the patrols; a file's in_view array otherwise.", 0, 100),
    ] = None,
    session_size: Annotated[int, count_option("Trajectories a session.")] = 1,
    agent: Annotated[int | None, typer.Option(help="Learn from this agent's lines only.")] = None,
    statistic: Annotated[
        str, typer.Option(help="Statistic of a session in the state: seen, counts or features.")
    ] = "seen",
    solver: Annotated[str, typer.Option(help="newton, ipopt, cvxpy or 'exponentiated gradient'.")] = "newton",
    slack: Annotated[float | None, real_option("L1 slack, nats per trajectory.", 0)] = None,
    ridge: Annotated[float, real_option("Precision of a Gaussian prior on the weights.", 0)] = 0.0,
    follow: Annotated[
        bool, typer.Option("--follow", help="Wait for new lines, also after the file is rotated.")
    ] = False,
    quarantine: Annotated[
        Path | None, typer.Option(help="Move bad lines to this file, with reasons, and continue.")
    ] = None,
    line_bytes: Annotated[int, count_option("Most bytes of a line; a longer one is bad.", most=2**40)] = 4
    * 2**20,
    line_steps: Annotated[int, count_option("Most steps of a trajectory; a longer one is bad.")] = 10_000,
    seed: Annotated[int, seed_option("Seed of the first weights; ignored when resuming.")] = 0,
    as_json: Json = False,
) -> None:
    """Learn online from a stream of trajectories; interrupt and resume at any time.

    Every session is on disk before the next begins. Run the same command again to resume, identical to the
    bit. The command checks that the input begins with the lines that it learned from: give all parts of a
    rotated file, one after the other, on standard input.
    """
    import jax

    from ...inference.journal.journal import Journal, journal_files, require_apart
    from ...inference.learners.lme import DEFAULT_SLACK, lme_i2rl
    from ...models.observation.demonstration import LineLimits
    from .quarantine import Quarantine
    from .stream import learn_stream, open_lines

    with reported_errors():
        process, sensor = _decision_process(mdp, observability)
        learner = lme_i2rl(
            process,
            sensor,
            statistic=statistic,
            solver=solver,
            ridge=ridge,
            slack=DEFAULT_SLACK if slack is None else slack,
        )
        # Another agent is another expert, and other sessions are another history: a journal of one must
        # not go on with the other.
        stream = ({} if agent is None else {"agent": agent}) | (
            {} if session_size == 1 else {"session_size": session_size}
        )
        learner = learner._replace(configuration={**learner.configuration, **stream})
        limits = LineLimits(line_bytes, line_steps)
        if quarantine is not None:
            require_apart("--quarantine", quarantine, demonstrations, *journal_files(journal))
        lines, source = open_lines(
            demonstrations, follow, limits, skip=quarantine is not None, say=print_message
        )
        with Journal.open(journal, learner) as opened, progress(as_json) as advance:
            before = opened.session
            aside = None if quarantine is None else Quarantine(quarantine)

            def report_session(report: Any) -> None:
                if as_json:
                    print(json.dumps(plain(report._asdict())), flush=True)
                advance(f"session {report.session}", None)

            try:
                done = learn_stream(
                    learner,
                    lines,
                    opened,
                    jax.random.key(seed),
                    size=session_size,
                    agent=agent,
                    source=source,
                    on_session=report_session,
                    limits=limits,
                    quarantine=aside,
                )
            except KeyboardInterrupt:
                print_message(f"Interrupted; {opened.session} sessions are in {journal}. Run again to go on.")
                raise typer.Exit(130) from None
            except BrokenPipeError:
                print_message(
                    f"The output's reader went away; {opened.session} sessions are in {journal}. "
                    "Run again to go on."
                )
                raise
            if aside is not None:
                counts = f"{aside.added} new, {aside.lines} in all"
                print_message(f"Lines set aside in {quarantine}: {counts}.")
            if not as_json:
                _print_weights(process, opened.state)
                print(f"{done} sessions learned ({before} were in {journal} before).")


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


def _print_weights(mdp: TabularMDP, state: Any) -> None:
    if state is None:
        return
    title = f"Reward after {int(state.session)} sessions"
    print_rewards(output_console(), mdp.feature_names, state.weights, title)
