"""Names that packages give out when they are first asked for."""

from __future__ import annotations

import importlib
import pkgutil

import pytest


@pytest.mark.parametrize("package", ["i2rl.inference", "i2rl.analysis"])
def test_no_name_is_hidden_by_a_module_of_that_name(package):
    # Once imported, a module becomes an attribute of its package, and no lazy name is looked up any more.
    public = importlib.import_module(package)
    assert not {module.name for module in pkgutil.iter_modules(public.__path__)} & set(public.__all__)


@pytest.mark.parametrize("package", ["i2rl.models", "i2rl.inference", "i2rl.domains", "i2rl.analysis"])
def test_every_public_name_is_there(package):
    public = importlib.import_module(package)
    for name in public.__all__:
        assert getattr(public, name) is not None
