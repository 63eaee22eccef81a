"""Execute the notebooks from a clean start, and save them without machine and time.

``python -m i2rl.analysis.notebooks.execute`` executes all of them in place, at the sizes they are published
with; paths as arguments choose some. The cell tagged ``parameters`` (papermill's convention) holds a
notebook's sizes: an execution may set others, as the tests do; they are injected after it.
"""

from __future__ import annotations

import ast
import io
import os
import sys
import time
from base64 import b64decode, b64encode
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import nbformat
from jupyter_client.kernelspec import KernelSpecManager
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient
from nbformat import NotebookNode
from PIL import Image

from ...compilation import compile_quickly, keep_programs

FOLDER = Path(__file__).parent
_METADATA = {
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {"name": "python"},
}


def notebooks() -> list[Path]:
    """List the package's notebooks in reading order."""
    return sorted(FOLDER.glob("*.ipynb"))


def execute_notebook(
    path: Path | str, parameters: Mapping[str, Any] | None = None, *, timeout: int = 600
) -> NotebookNode:
    """Execute the notebook by this interpreter in an empty folder, and return it with its outputs; write no
    file.

    ``parameters`` replace values set in the cell tagged ``parameters``; ``timeout`` is in seconds, of one
    cell. The user's Jupyter and IPython settings play no part. Raises ``ValueError`` for a parameter that
    the notebook does not have, and ``nbclient.exceptions.CellExecutionError`` for a cell that fails.
    """
    notebook = nbformat.read(path, as_version=4)
    _inject(notebook, dict(parameters or {}), Path(path).name)
    with TemporaryDirectory() as folder:
        # Without folders to search, the kernel named python3 is the one of this interpreter.
        manager = AsyncKernelManager(
            kernel_name="python3",
            kernel_spec_manager=KernelSpecManager(kernel_dirs=[]),
            connection_file=os.path.join(folder, "connection.json"),
            # A socket in a private folder: other users cannot listen, which the kernel would warn of.
            transport="tcp" if sys.platform == "win32" else "ipc",
        )
        work = Path(folder, "work")
        work.mkdir()
        client = NotebookClient(
            notebook,
            km=manager,
            timeout=timeout,
            record_timing=False,
            coalesce_streams=True,
            resources={"metadata": {"path": str(work)}},
        )
        environment = os.environ | {
            "IPYTHONDIR": os.path.join(folder, "ipython"),
            "COLUMNS": "100",
            # NumPyro's progress bars ask for widgets, which a saved notebook cannot show.
            "PYTHONWARNINGS": "ignore:IProgress not found",
        }
        client.execute(cleanup_kc=True, env=environment)
    return notebook


def parameters_of(notebook: NotebookNode) -> dict[str, Any]:
    """Read the names and values in the cell tagged ``parameters``; empty if there is none.

    Raises ``ValueError`` if the cell does anything but name literal values.
    """
    values: dict[str, Any] = {}
    for cell in notebook.cells:
        if "parameters" in cell.metadata.get("tags", []):
            for statement in ast.parse(cell.source).body:
                match statement:
                    case ast.Assign(targets=[ast.Name(id=name)], value=value):
                        values[name] = ast.literal_eval(value)
                    case _:
                        raise ValueError(f"a parameter is `NAME = literal`, got: {ast.unparse(statement)}")
    return values


def _inject(notebook: NotebookNode, parameters: Mapping[str, Any], name: str) -> None:
    known = parameters_of(notebook)
    unknown = [parameter for parameter in parameters if parameter not in known]
    if unknown:
        raise ValueError(f"{name} has no parameter {unknown[0]}; it has {', '.join(known) or 'none'}")
    if not parameters:
        return
    at = next(i for i, cell in enumerate(notebook.cells) if "parameters" in cell.metadata.get("tags", []))
    source = "\n".join(f"{parameter} = {value!r}" for parameter, value in parameters.items())
    cell = nbformat.v4.new_code_cell(
        source, id="injected-parameters", metadata={"tags": ["injected-parameters"]}
    )
    notebook.cells.insert(at + 1, cell)


def tidy(notebook: NotebookNode) -> NotebookNode:
    """Return the notebook without machine metadata, and with pictures of at most 256 colours (a third the
    size).
    """
    notebook.metadata = nbformat.from_dict(_METADATA)
    for cell in notebook.cells:
        cell.metadata = nbformat.from_dict({k: v for k, v in cell.metadata.items() if k == "tags"})
        for output in cell.get("outputs", []):
            if "metadata" in output:
                output.metadata = NotebookNode()
            if picture := output.get("data", {}).get("image/png"):
                output.data["image/png"] = _reduced(picture)
    return notebook


def _reduced(picture: str) -> str:
    file = io.BytesIO()
    image = Image.open(io.BytesIO(b64decode(picture)))
    if image.mode == "P":  # reduced before
        return picture
    image.convert("RGB").quantize(256, dither=Image.Dither.NONE).save(file, "PNG", optimize=True)
    return b64encode(file.getvalue()).decode()


def main(paths: Sequence[str] = ()) -> None:
    """Execute notebooks in place (all of the package's by default) and say how long each took."""
    compile_quickly()
    keep_programs()
    for path in map(Path, paths or notebooks()):
        began = time.perf_counter()
        notebook = tidy(execute_notebook(path))
        seconds = time.perf_counter() - began
        nbformat.write(notebook, path)
        print(f"{path.name}: {seconds:.0f} s, {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
