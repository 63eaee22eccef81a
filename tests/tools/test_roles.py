"""Docstrings' roles as cross-references."""

from pathlib import Path

import pytest

griffe = pytest.importorskip("griffe")
TOOLS = Path(__file__).parents[2] / "tools"

MODULE = '''
"""A room, see :func:`double`."""

def double(x):
    """Double :math:`x`; :class:`numpy.ndarray` stays what it is.

    Parameters
    ----------
    x : float ``[n]``
        What to double.

    See Also
    --------
    halve : the inverse.
    """

def halve(x):
    """Halve; :func:`~i2rl.room.absent` leads nowhere.

    Raises ``ValueError`` for an
    odd number.
    """
'''


@pytest.fixture
def docstrings(tmp_path):
    package = tmp_path / "i2rl"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "room.py").write_text(MODULE)
    loader = griffe.GriffeLoader(
        search_paths=[tmp_path], extensions=griffe.load_extensions(str(TOOLS / "roles.py"))
    )
    room = loader.load("i2rl").members["room"]
    return {"room": room.docstring.value} | {name: room[name].docstring.value for name in ("double", "halve")}


def test_a_name_of_the_same_module_becomes_a_reference_to_its_path(docstrings):
    assert docstrings["room"] == "A room, see [`double`][i2rl.room.double]."
    assert "- [`halve`][i2rl.room.halve]: the inverse." in docstrings["double"]


def test_a_name_of_another_library_is_shown_as_code(docstrings):
    assert "Double $x$; `numpy.ndarray` stays" in docstrings["double"]


def test_a_reference_that_leads_nowhere_stays_one_for_the_strict_build(docstrings):
    assert "[`absent`][i2rl.room.absent]" in docstrings["halve"]


def test_types_lose_their_markup(docstrings):
    assert "\nx : float [n]\n" in docstrings["double"]


def test_a_closing_sentence_of_what_is_raised_becomes_a_section(docstrings):
    assert docstrings["halve"].endswith("Raises\n------\nValueError\n    For an odd number.")
