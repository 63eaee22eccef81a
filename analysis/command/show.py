"""``i2rl show``: the history in a journal."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..drawing.results import plain
from .console import output_console, print_message, print_rewards, reported_errors
from .options import Json, count_option

if TYPE_CHECKING:
    from ...inference.journal.journal import JournalView, SessionRecord


def show_journal(
    journal: Annotated[Path, typer.Argument(help="A journal written by learn.")],
    export: Annotated[Path | None, typer.Option(help="Also write the history to this NetCDF file.")] = None,
    last: Annotated[
        int | None, count_option("Sessions to show; 10, or all with --json, unless given.")
    ] = None,
    verify: Annotated[
        bool, typer.Option("--verify", help="Check the whole file against its digests first.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Show a journal's content, also while a learner writes it.

    Only the sessions shown are read; each is checked against its digest.
    """
    from ...inference.journal.journal import Journal

    with reported_errors(), Journal.read(journal) as view:
        if view.lacks_log:
            print_message(
                f"Sessions may be missing: {journal} was moved or copied without its {journal}-wal while a "
                "learner had it open, or after a kill."
            )
        if verify:
            print_message(f"All {view.verify()} sessions are as they were committed.")
        if export is not None:
            view.to_netcdf(export)
        if as_json:
            _print_sessions(view, last)
            return
        _print_history(view, list(view.records(10 if last is None else last)))
        if export is not None:
            print(f"Exported to {export}")


def _print_sessions(view: JournalView, last: int | None) -> None:
    """Print one JSON object, a session a line, so that memory does not grow with the history."""
    print(f'{{"origin": {json.dumps(plain(view.origin._asdict()))}, "sessions": [', end="")
    for i, r in enumerate(view.records(last)):
        fields = {
            "session": r.session,
            "committed": r.committed,
            "weights": r.weights.tolist(),
            **plain(r.info),
        }
        print(f"{',' if i else ''}\n{json.dumps(fields)}", end="")
    print("\n]}")


def _print_history(view: JournalView, records: list[SessionRecord]) -> None:
    from rich.table import Table

    from ..drawing.text import for_terminal

    origin = view.origin
    console = output_console()
    console.print(
        for_terminal(
            f"{origin.method} on an MDP of {origin.n_states} states and "
            f"{origin.n_actions} actions; {view.sessions} sessions"
        )
    )
    if not records:
        return
    table = Table(title=f"Last {len(records)} sessions")
    formats = {"log_likelihood": ".4f", "iterations": ".0f", "seconds": ".4f"}
    titles = {"log_likelihood": "log-likelihood (nats/trajectory)", "iterations": "steps"}
    shown = [name for name in formats if name in records[-1].info]
    for column in ("session", *(titles.get(name, name) for name in shown)):
        table.add_column(column, justify="right")
    for r in records:
        table.add_row(str(r.session), *(f"{float(r.info[name]):{formats[name]}}" for name in shown))
    console.print(table)
    weights = records[-1].weights
    if weights.shape[-1:] == (len(origin.feature_names),) and weights.ndim <= 2:
        print_rewards(console, origin.feature_names, weights, "Reward weights")
    if "agreement" in records[-1].info:
        sensor = Table(title="Agreement of observations with the truth")
        sensor.add_column("predicate")
        sensor.add_column("agreement", justify="right")
        for j, agreement in enumerate(records[-1].info["agreement"]):
            sensor.add_row(str(j), f"{agreement:.3f}")
        console.print(sensor)
