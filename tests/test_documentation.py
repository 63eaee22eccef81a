"""The code of the README and of every page runs as it stands."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import jax
import matplotlib
import numpy as np
import pytest
from typer.testing import CliRunner

import i2rl
from i2rl.analysis.command.app import app
from i2rl.analysis.studies.adversarial import cases
from i2rl.analysis.studies.noisy import study as noisy_study
from i2rl.domains import mouse_labyrinth, simulate_bouts

ROOT = Path(i2rl.__file__).resolve().parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
WITH_CODE = [page for page in PAGES if "```python" in page.read_text()]


def blocks(page: Path, language: str) -> list[str]:
    """Code blocks of a page in a language, none for blocks without one."""
    found: list[str] = []
    inside: str | None = None
    for line in page.read_text().splitlines():
        if line.startswith("```"):
            inside = line[3:].strip() if inside is None else None
            if inside == language:
                found.append("")
        elif inside == language:
            found[-1] += line + "\n"
    return found


def run_code(page: Path) -> None:
    """Run the Python code of a page, in the current folder."""
    namespace: dict[str, object] = {"__name__": "page"}
    for code in blocks(page, "python"):
        exec(compile(code, page.name, "exec"), namespace)


@pytest.mark.parametrize("page", WITH_CODE, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_the_code_of_a_page_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    run_code(page)


def commands() -> list[str]:
    """Every command line that begins with ``i2rl``, on the README and the pages."""
    lines = [line for page in PAGES for block in blocks(page, "") for line in block.splitlines()]
    starts = [re.split(r"\s{3,}|\s[#|<>]", line)[0].strip() for line in lines]
    return sorted({line for line in starts if line.startswith("i2rl ")})


# What makes a command small enough for a test: options beside those that the pages show.
SMALLER = {
    "i2rl run label-bias": "--worlds 2 --trajectories 8",
    "i2rl run labyrinth": "",
    "i2rl run methods": "--sessions 8 --replications 1",
    "i2rl run noisy-patrol": "--replications 1 --sessions 1 --draws 4",
    "i2rl run noisy-sorting": "--replications 1 --sessions 1 --belts 8 --draws 4",
    "i2rl run patrol": "--sessions 3 --trials 4 --replications 1",
    "i2rl run robust-airl": "--sessions 1",
    "i2rl run sorting": "--trajectories 3 --replications 1 --steps 20 --belts 8",
    "i2rl simulate patrol": "--sessions 3",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with the files that the pages' commands read."""
    folder = tmp_path_factory.mktemp("pages")
    maze = mouse_labyrinth()
    bouts = simulate_bouts(jax.random.key(0), maze, np.zeros(maze.mdp.n_features), 8, max_steps=32)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        run_code(ROOT / "docs" / "how-to" / "recording.md")
    (folder / "bouts.jsonl").write_text("\n".join(json.dumps({"nodes": bout.nodes}) for bout in bouts))
    return folder


@pytest.mark.usefixtures("small_pictures")
@pytest.mark.parametrize("line", commands())
def test_a_command_of_the_pages_runs(line, folder, monkeypatch):
    """Run it as shown, with fewer sessions and the like; learning comes before showing what was learned."""
    monkeypatch.chdir(folder)
    # Few methods, and a few steps of networks: the studies' own tests run the others.
    monkeypatch.setattr(noisy_study, "METHODS", (noisy_study.PLAIN, noisy_study.FAIR))
    plan = cases.PLANS["hopper"]
    small = {"n_envs": 10, "n_steps": 32, "hidden": (8, 8)}
    monkeypatch.setitem(
        cases.PLANS,
        "hopper",
        plan._replace(
            iterations=1, updates=1, episodes=1, settings=tuple({**dict(plan.settings), **small}.items())
        ),
    )
    smaller = next((options for start, options in SMALLER.items() if line.startswith(start)), "")
    result = CliRunner().invoke(app, shlex.split(f"{line} {smaller}")[1:])
    assert result.exit_code == 0, (result.output, result.exception)
    assert result.stdout


def test_a_newcomer_needs_at_most_eight_lines_for_each_step():
    page = ROOT / "docs" / "index.md"
    counted = [[line for line in code.splitlines() if line.strip()] for code in blocks(page, "python")]
    made, recorded, *steps = counted  # the process, the recording, and then what is done with them
    assert len(made) <= 12
    assert len(recorded) <= 10
    assert [len(step) for step in steps if len(step) > 8] == []
