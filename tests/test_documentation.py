"""The code of the README and of every page runs as it stands."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import matplotlib
import pytest
from typer.testing import CliRunner

import i2rl
from i2rl.analysis.command.app import app

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


@pytest.mark.parametrize("page", WITH_CODE, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_the_code_of_a_page_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    namespace: dict[str, object] = {"__name__": "page"}
    for code in blocks(page, "python"):
        exec(compile(code, f"{page.name}", "exec"), namespace)


def commands() -> list[str]:
    """Every command line that begins with ``i2rl``, on the README and the pages."""
    lines = [line for page in PAGES for block in blocks(page, "") for line in block.splitlines()]
    starts = [re.split(r"\s{3,}|\s[#|<>]", line)[0].strip() for line in lines]
    return sorted({line for line in starts if line.startswith("i2rl ")})


@pytest.mark.parametrize("line", commands())
def test_the_command_line_has_every_command_and_option_that_a_page_shows(line):
    arguments = shlex.split(line)[1:]
    names = [word for word in arguments if re.fullmatch(r"[a-z-]+", word) and not word.startswith("-")]
    for depth in (2, 1):
        shown = CliRunner().invoke(app, [*names[:depth], "--help"], env={"COLUMNS": "200"})
        if shown.exit_code == 0:
            break
    assert shown.exit_code == 0, line
    for option in (word for word in arguments if word.startswith("--") and word != "--help"):
        assert option in shown.output, f"{line}: {option}"


def test_a_newcomer_needs_at_most_eight_lines_for_each_step():
    page = ROOT / "docs" / "index.md"
    counted = [[line for line in code.splitlines() if line.strip()] for code in blocks(page, "python")]
    made, recorded, *steps = counted  # the process, the recording, and then what is done with them
    assert len(made) <= 12
    assert len(recorded) <= 10
    assert [len(step) for step in steps if len(step) > 8] == []
