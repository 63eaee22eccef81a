"""The tests of what changed."""

import importlib.util
from pathlib import Path

import pytest

TOOL = Path(__file__).parents[2] / "tools" / "changed_tests.py"


@pytest.fixture
def tests_of(tmp_path, monkeypatch):
    specification = importlib.util.spec_from_file_location("changed_tests", TOOL)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    for name in (
        "models/room/a.py",
        "models/room/b.py",
        "tests/models/room/test_a.py",
        "tests/test_units.py",
    ):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    monkeypatch.chdir(tmp_path)
    return lambda *names: module.tests_of([Path(name) for name in names])


def test_a_module_has_the_test_file_of_its_name(tests_of):
    assert tests_of("models/room/a.py") == ([Path("tests/models/room/test_a.py")], [])


def test_a_changed_test_file_is_run_once(tests_of):
    changed = "models/room/a.py", "tests/models/room/test_a.py", "tests/test_units.py"
    assert tests_of(*changed) == ([Path("tests/models/room/test_a.py"), Path("tests/test_units.py")], [])


def test_a_module_without_a_test_file_is_named(tests_of):
    assert tests_of("models/room/b.py", "README.md") == ([], [Path("models/room/b.py")])
