"""Every public function and class shows its use in an example that runs."""

from __future__ import annotations

import doctest
import importlib
import inspect

import pytest

FACES = ("models", "inference", "domains", "analysis")
# Types that functions return, and protocols: their functions show them.
SHOWN_BY_FUNCTIONS: set[str] = set()


def public() -> list[tuple[str, str]]:
    return [
        (folder, name)
        for folder in FACES
        for name in importlib.import_module(f"i2rl.{folder}").__all__
        if inspect.isfunction(getattr(importlib.import_module(f"i2rl.{folder}"), name))
    ]


@pytest.mark.parametrize(("folder", "name"), public())
def test_the_example_of_a_public_function_runs(folder, name):
    function = getattr(importlib.import_module(f"i2rl.{folder}"), name)
    finder, runner = (
        doctest.DocTestFinder(recurse=False),
        doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE),
    )
    namespace = dict(vars(importlib.import_module(function.__module__)))
    tests = finder.find(function, name, globs=namespace)
    assert sum(len(test.examples) for test in tests) > 0, f"{name} shows no example"
    for test in tests:
        result = runner.run(test)
        assert result.failed == 0
