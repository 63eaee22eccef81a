"""The package's structure: rooms, names and their homes."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

import i2rl

ROOT = Path(i2rl.__file__).resolve().parent
FOLDERS = ("models", "inference", "domains", "analysis")
MODULES = sorted(p for folder in FOLDERS for p in (ROOT / folder).rglob("*.py"))


def imported_names(path: Path) -> list[tuple[str, str]]:
    """Modules of this package that a file imports from, with the names it takes."""
    tree = ast.parse(path.read_text())
    ours = [n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)]
    return [
        (node.module or "", alias.name)
        for node in ours
        if node.level or (node.module or "").split(".")[0] == "i2rl"
        for alias in node.names
    ]


def test_no_room_holds_more_than_twelve_modules():
    rooms = Counter(p.parent.relative_to(ROOT) for p in MODULES if p.name != "__init__.py")
    assert {str(room): n for room, n in rooms.items() if n > 12} == {}


def test_every_room_says_what_is_in_it():
    rooms = {p.parent for p in MODULES}
    assert [r for r in rooms if not ast.get_docstring(ast.parse((r / "__init__.py").read_text()))] == []


@pytest.mark.parametrize("folder", [*FOLDERS, "tests"])
def test_no_private_name_is_imported_from_another_module(folder):
    private = [
        (str(path.relative_to(ROOT)), module, name)
        for path in (ROOT / folder).rglob("*.py")
        for module, name in imported_names(path)
        if name.startswith("_") and not name.startswith("__")
    ]
    assert private == []


def test_no_module_has_the_name_of_a_function_that_it_defines():
    defined = {
        path: {n.name for n in ast.parse(path.read_text()).body if isinstance(n, ast.FunctionDef)}
        for path in MODULES
    }
    assert [str(p.relative_to(ROOT)) for p, names in defined.items() if p.stem in names] == []


def test_tests_lie_in_the_tree_of_what_they_test():
    folders = {p.parent.relative_to(ROOT / "tests") for p in (ROOT / "tests").rglob("test_*.py")}
    assert [str(folder) for folder in folders if not (ROOT / folder).is_dir()] == []


OPENINGS = {"what", "whether", "how", "who", "of", "as", "nothing", "itself", "where", "under", "does"}
OTHER_WORDS = {
    *("clusters", "decided", "demos", "eta", "imperfection", "jumble", "l1", "look", "memory", "n_clusters"),
    *("n_ways", "price", "rate", "reading", "readings", "report", "reports", "rounds", "runs", "samplings"),
    *("seeds", "shown", "sweeps", "told", "view", "ways"),
}
# A word of the field that the glossary replaces in another sense.
IN_ITS_OWN_SENSE = {
    ("rounds", "domains/patrol/breach.py:BreachSettings"): "rounds of a patrol's loop",
    ("view", "analysis/drawing/style.py:Theme"): "colour of the cells in view",
    ("view", "analysis/studies/labyrinth/study.py:ViewStudy"): "name of a part of the maze",
    ("sweeps", "analysis/bounds/stopping.py:stopping_plot"): "sweeps over a parameter",
    ("sweeps", "analysis/studies/methods/study.py:MethodsStudy"): "sweeps over a parameter",
    ("sweeps", "inference/completion/gibbs.py:GibbsChain"): "sweeps of a Gibbs sampler",
    ("sweeps", "inference/posteriors/gibbs.py:gibbs_chain"): "sweeps of a Gibbs sampler",
    ("sweeps", "inference/completion/gibbs.py:GaussianGibbs"): "sweeps of a Gibbs sampler",
}


def docstrings(path: Path) -> list[str]:
    """Docstrings of a file, of its types and of its functions."""
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    nodes = [n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, kinds)]
    return [text for text in map(ast.get_docstring, nodes) if text]


def public_names(path: Path) -> list[tuple[str, str]]:
    """Parameters and fields of a file's public functions and types, with the function or type."""

    def below(node: ast.AST) -> list[tuple[str, str]]:
        found = []
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef) and not child.name.startswith("_"):
                a = child.args
                found += [(x.arg, child.name) for x in (*a.posonlyargs, *a.args, *a.kwonlyargs)]
            if isinstance(child, ast.ClassDef) and not child.name.startswith("_"):
                fields = [x.target for x in child.body if isinstance(x, ast.AnnAssign)]
                found += [(x.id, child.name) for x in fields if isinstance(x, ast.Name)]
                found += below(child)
        return found

    return below(ast.parse(path.read_text()))


@pytest.mark.parametrize("folder", [*FOLDERS, "tests"])
def test_docstrings_open_with_a_verb_or_a_noun(folder):
    opened = [
        (str(path.relative_to(ROOT)), text.splitlines()[0])
        for path in sorted((ROOT / folder).rglob("*.py"))
        for text in docstrings(path)
        if text.split()[0].strip(",.:;").lower() in OPENINGS
    ]
    assert opened == []


@pytest.mark.parametrize("folder", FOLDERS)
def test_public_names_are_the_glossarys(folder):
    others = [
        (name, where)
        for path in sorted((ROOT / folder).rglob("*.py"))
        if "benchmarks" not in path.parts
        for name, owner in public_names(path)
        for where in [f"{path.relative_to(ROOT)}:{owner}"]
        if name in OTHER_WORDS and (name, where) not in IN_ITS_OWN_SENSE
    ]
    assert others == []


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_face_lists_its_names_completely_and_loads_each(folder):
    face = importlib.import_module(f"i2rl.{folder}")
    assert len(face.__all__) <= 55
    assert set(face.__all__) <= set(dir(face))
    for name in face.__all__:
        home = getattr(face, name)
        assert getattr(home, "__name__", name) == name


def test_importing_the_faces_loads_no_solver():
    heavy = ["casadi", "cvxpy", "pymc", "arviz", "matplotlib", "numpyro", "equinox", "mujoco"]
    script = f"""
import sys
import i2rl.models, i2rl.inference, i2rl.analysis
assert not [name for name in {heavy} if name in sys.modules], [n for n in {heavy} if n in sys.modules]
"""
    subprocess.run([sys.executable, "-c", script], check=True, timeout=120)


def test_without_the_extra_star_imports_work_and_the_use_says_what_to_install():
    script = """
import sys
for name in ("equinox", "optax", "mujoco"):
    sys.modules[name] = None
from i2rl.domains import *
from i2rl.inference import *
from i2rl.models import *
import i2rl.inference, pydoc
assert "lme_i2rl" in pydoc.render_doc(i2rl.inference)
for use in (lambda: airl(), lambda: ppo(), lambda: noisy_airl(), lambda: ssrr()):
    try:
        use()
    except ModuleNotFoundError as missing:
        assert "pip install 'i2rl[adversarial]'" in str(missing), missing
    else:
        raise AssertionError("it ran without the extra")
"""
    subprocess.run([sys.executable, "-c", script], check=True, timeout=300)


def parameters(node: ast.FunctionDef) -> list[str]:
    """Named parameters of a function; options that travel together in ``**options`` are none."""
    names = node.args.posonlyargs + node.args.args + node.args.kwonlyargs
    return [name.arg for name in names if name.arg not in ("self", "cls")]


def test_at_most_six_functions_take_more_than_eight_parameters():
    # Typer needs an argument for each option of a command.
    many = [
        f"{path.relative_to(ROOT)}: {node.name}"
        for path in MODULES
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef) and len(parameters(node)) > 8
    ]
    assert len(many) <= 6, many
