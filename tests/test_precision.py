"""64-bit floats, whichever module is imported first."""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import i2rl

ROOT = Path(i2rl.__file__).parent


def path_of(module):
    file = ROOT.joinpath(*module)
    return file / "__init__.py" if file.is_dir() else file.with_suffix(".py")


@cache
def imported(module):
    """Modules of the package, as tuples of names, that running a module's top level imports; and JAX."""
    inside = path_of(module)
    package = module if inside.name == "__init__.py" else module[:-1]
    names, uses_jax = [], False
    for node in ast.parse(inside.read_text()).body:
        if isinstance(node, ast.Import):
            uses_jax |= any(alias.name.split(".")[0] == "jax" for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            uses_jax |= node.module.split(".")[0] == "jax"
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] + tuple((node.module or "").split(".")) * bool(
                node.module
            )
            names += [base] if node.module else [(*base, alias.name) for alias in node.names]
    # Python runs the packages around a module first.
    around = [module[:i] for i in range(1, len(module))]
    return [name for name in [*around, *names] if path_of(name).exists()], uses_jax


def reaches_precision(module, met):
    if module in met:
        return False
    met.add(module)
    return module == ("precision",) or any(reaches_precision(name, met) for name in imported(module)[0])


def test_every_module_that_imports_jax_switches_64_bits_on_before():
    modules = [p.relative_to(ROOT).with_suffix("").parts for p in ROOT.rglob("*.py")]
    modules = [m for m in modules if m[0] in ("models", "inference", "domains", "analysis")]
    entrances = [m for m in modules if m[-1] != "__init__" and imported(m)[1]]
    assert len(entrances) > 80
    assert [m for m in entrances if not reaches_precision(m, set())] == []


def test_a_name_alone_computes_in_64_bits():
    script = """
import jax.numpy as jnp
from i2rl.inference import lme_i2rl
from i2rl.inference.completion.kalman import AffineGaussian
assert lme_i2rl and AffineGaussian and jnp.ones(1).dtype == jnp.float64
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
