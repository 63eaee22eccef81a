"""Every public function shows its use in an example that runs."""

from __future__ import annotations

import doctest
import importlib
import inspect

import pytest

FACES = ("models", "inference", "domains", "analysis")


def public() -> list[tuple[str, str]]:
    return [
        (folder, name)
        for folder in FACES
        for name in importlib.import_module(f"i2rl.{folder}").__all__
        if inspect.isfunction(inspect.unwrap(getattr(importlib.import_module(f"i2rl.{folder}"), name)))
    ]


@pytest.mark.parametrize(("folder", "name"), public())
def test_the_example_of_a_public_function_runs(folder, name):
    function = inspect.unwrap(getattr(importlib.import_module(f"i2rl.{folder}"), name))
    finder, runner = (
        doctest.DocTestFinder(recurse=False),
        doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE),
    )
    tests = finder.find(function, name, globs={})
    assert sum(len(test.examples) for test in tests) > 0, f"{name} shows no example"
    for test in tests:
        result = runner.run(test)
        assert result.failed == 0
