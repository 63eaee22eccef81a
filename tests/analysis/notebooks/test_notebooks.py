"""Notebooks, executed at reduced sizes, and what is committed of them."""

from __future__ import annotations

import io
import re
from base64 import b64decode
from collections import Counter
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pytest
from nbclient.exceptions import CellExecutionError
from nbformat import NotebookNode
from PIL import Image

from i2rl.analysis.notebooks.execute import execute_notebook, main, notebooks, parameters_of, tidy

REDUCED: dict[str, dict[str, Any]] = {
    "1-first-session.ipynb": {"SESSIONS": 20, "RUNS": 2, "STRETCH": 30},
    "2-how-much-data.ipynb": {"RUNS": 20, "TRAJECTORIES": 40, "MOST": 200, "LENGTH": 100},
    "3-what-was-hidden.ipynb": {"SESSIONS": 3, "DRAWS": 20, "WARMUP": 20, "CHAINS": 2, "FRAGMENTS": 12},
    "4-online-against-batch.ipynb": {"SESSIONS": 24, "RUNS": 2, "STREAMS": 4, "LONG": 60},
}
each_notebook = pytest.mark.parametrize("path", notebooks(), ids=lambda path: path.stem)


def read(path: Path) -> NotebookNode:
    return nbformat.read(path, as_version=4)


def code_cells(notebook: NotebookNode) -> list[NotebookNode]:
    """Code cells as they are in the file, without one that was injected."""
    return [
        cell
        for cell in notebook.cells
        if cell.cell_type == "code" and "injected-parameters" not in cell.metadata.get("tags", [])
    ]


def outputs(notebook: NotebookNode) -> list[NotebookNode]:
    return [output for cell in code_cells(notebook) for output in cell.outputs]


def pictures(notebook: NotebookNode) -> list[str]:
    return [png for output in outputs(notebook) if (png := output.get("data", {}).get("image/png"))]


def made_notebook(tmp_path: Path, *sources: str, parameters: str = "SIZE = 3") -> Path:
    """Write a notebook file with a cell of parameters and a code cell for each source."""
    cells = [nbformat.v4.new_code_cell(parameters, metadata={"tags": ["parameters"]})]
    cells += [nbformat.v4.new_code_cell(source) for source in sources]
    path = tmp_path / "made.ipynb"
    nbformat.write(nbformat.v4.new_notebook(cells=cells), path)
    return path


# -- the package's notebooks ---------------------------------------------------------------------------


def test_there_are_notebooks_to_be_read_in_order_and_sizes_for_no_others():
    names = [path.name for path in notebooks()]
    assert [int(name.split("-")[0]) for name in names] == list(range(1, len(names) + 1))
    assert len(names) >= 3
    assert set(names) <= set(REDUCED)


@each_notebook
def test_notebook_executes_at_a_reduced_size_with_the_outputs_and_figures_it_has_in_full(path):
    committed = read(path)
    assert set(REDUCED[path.name]) <= set(parameters_of(committed)), f"{path.name} has other parameters"
    executed = execute_notebook(path, REDUCED[path.name], timeout=300)
    assert [o for o in outputs(executed) if o.output_type == "error" or o.get("name") == "stderr"] == []
    assert len(pictures(executed)) == len(pictures(committed)) > 0
    for before, now in zip(code_cells(committed), code_cells(executed), strict=True):
        kinds, new = (Counter(o.output_type for o in cell.outputs) for cell in (before, now))
        assert new == kinds, f"this cell's outputs were {dict(kinds)} and are {dict(new)}:\n{now.source}"


@each_notebook
def test_committed_notebook_has_outputs_of_one_run_from_a_clean_start(path):
    cells = code_cells(read(path))
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert len(outputs(read(path))) >= 5


@each_notebook
def test_committed_notebook_shows_no_machine_and_no_warnings(path):
    text = path.read_text()
    assert not re.search(r"site-packages|/tmp/|/home/|/Users/|\.venv|ipykernel_\d", text)
    assert {output.get("name", "stdout") for output in outputs(read(path))} <= {"stdout"}
    assert len(text) < 400_000


@each_notebook
def test_committed_notebook_opens_with_what_the_reader_can_do_at_its_end(path):
    first = read(path).cells[0]
    assert first.cell_type == "markdown"
    assert first.source.startswith(f"# {path.name[0]}. ")
    assert "At the end you can" in first.source


@each_notebook
def test_committed_figures_are_pictures_of_something(path):
    for png in pictures(read(path)):
        colours = np.asarray(Image.open(io.BytesIO(b64decode(png))).convert("L"))
        assert min(colours.shape) > 200
        assert len(np.unique(colours)) > 8


# -- what executes them --------------------------------------------------------------------------------


def test_parameters_replace_those_of_the_cell_and_reach_the_cells_after_it(tmp_path):
    path = made_notebook(tmp_path, "print(SIZE * 2, NAME)", parameters="SIZE = 3\nNAME = 'a'")
    assert parameters_of(read(path)) == {"SIZE": 3, "NAME": "a"}
    assert outputs(execute_notebook(path))[0].text == "6 a\n"
    assert outputs(execute_notebook(path, {"SIZE": 50}))[0].text == "100 a\n"
    assert outputs(read(path)) == []  # nothing is written


def test_unknown_parameter_is_refused_with_those_there_are(tmp_path):
    with pytest.raises(ValueError, match=r"made\.ipynb has no parameter SIZES; it has SIZE"):
        execute_notebook(made_notebook(tmp_path, "SIZE"), {"SIZES": 1})


def test_parameter_that_is_no_literal_is_refused(tmp_path):
    path = made_notebook(tmp_path, "SIZE", parameters="SIZE += 1")
    with pytest.raises(ValueError, match=r"a parameter is `NAME = literal`, got: SIZE \+= 1"):
        parameters_of(read(path))


def test_failing_cell_is_raised_and_its_file_stays(tmp_path):
    path = made_notebook(tmp_path, "1 / 0")
    before = path.read_bytes()
    with pytest.raises(CellExecutionError, match="ZeroDivisionError"):
        main([str(path)])
    assert path.read_bytes() == before


def test_execution_in_place_leaves_one_result_however_often(tmp_path):
    path = made_notebook(
        tmp_path,
        "import os\nprint(os.listdir())",
        "import matplotlib.pyplot as plt\n%matplotlib inline\nplt.imshow([[0, 1], [2, SIZE]])\nplt.show()",
    )
    main([str(path)])
    once = path.read_text()
    assert outputs(read(path))[0].text == "[]\n"  # an empty folder
    assert len(pictures(read(path))) == 1
    main([str(path)])
    assert path.read_text() == once


def test_tidying_is_idempotent_and_keeps_all_but_machine_metadata(tmp_path):
    notebook = execute_notebook(
        made_notebook(
            tmp_path, "import matplotlib.pyplot as plt\n%matplotlib inline\nplt.plot([1, 3, SIZE]);"
        )
    )
    picture = np.asarray(Image.open(io.BytesIO(b64decode(pictures(notebook)[0]))).convert("RGB"), int)
    notebook.cells[0].metadata["execution"] = {"iopub.status.busy": "2020-01-01"}
    notebook.metadata["machine"] = "mine"
    once = nbformat.writes(tidy(notebook))
    tidied = nbformat.reads(once, as_version=4)
    assert nbformat.writes(tidy(tidied)) == once
    assert "mine" not in once
    assert "2020-01-01" not in once
    assert tidied.cells[0].metadata == {"tags": ["parameters"]}
    reduced = np.asarray(Image.open(io.BytesIO(b64decode(pictures(tidied)[0]))).convert("RGB"), int)
    assert reduced.shape == picture.shape
    assert np.abs(reduced - picture).mean() < 2  # of 255
