"""Names of others are shown as they are, in a terminal, a figure and a page; numbers and counts are plain."""

from __future__ import annotations

import io
import unicodedata
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from i2rl.analysis.drawing.text import for_figure, for_page, for_terminal, listed, number, printable
from i2rl.models.inputs.text import counted

NAMES = [
    "speed [m/s]",
    "turn rate [/s]",
    "[bold]x[/]",
    ":car:",
    "a$b$c",
    "$\\frac$",
    "_hidden",
    "a\\",
    "<b>&amp;",
]


def shown_in_terminal(renderable: object) -> str:
    stream = io.StringIO()
    Console(file=stream, width=300, color_system=None).print(renderable)
    return stream.getvalue()


@pytest.mark.parametrize("name", NAMES)
def test_a_terminal_shows_names_as_they_are(name):
    table = Table()
    table.add_column("name")
    table.add_row(for_terminal(name))
    assert name in shown_in_terminal(table)
    assert shown_in_terminal(for_terminal(name)) == f"{name}\n"


@given(st.text(alphabet=st.characters(exclude_characters="\n"), max_size=12))
def test_no_control_character_reaches_a_terminal(name):
    shown = printable(name)
    assert not {unicodedata.category(c) for c in shown} & {"Cc", "Cs", "Zl", "Zp"}
    shown.encode("utf-8")
    assert printable(shown) == shown


def test_control_characters_are_shown_as_python_writes_them():
    assert printable("\x1b[31mred\x9b\u202e\ud800\n") == "\\x1b[31mred\\x9b\\u202e\\ud800\\n"


@pytest.mark.parametrize("name", NAMES)
def test_a_figure_shows_names_as_they_are(name):
    figure = Figure()
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.plot([0, 1], label=for_figure(name))
    legend = axes.legend()
    (drawn,) = legend.get_texts()
    told, formula = drawn._preprocess_math(drawn.get_text())
    assert formula is False
    assert told.removeprefix("\u2060") == name
    assert for_figure(for_figure(name)) == for_figure(name)
    figure.canvas.draw()


class Reader(HTMLParser):
    """Collects text, and remembers tags that the text may not have made."""

    def __init__(self) -> None:
        super().__init__()
        self.text, self.tags = "", []

    def handle_data(self, data: str) -> None:
        self.text += data

    def handle_starttag(self, tag: str, attrs: list) -> None:
        self.tags.append(tag)


@pytest.mark.parametrize("name", NAMES)
def test_a_page_shows_names_as_they_are(name):
    reader = Reader()
    reader.feed(f"<td>{for_page(name)}</td>")
    reader.close()
    assert (reader.text, reader.tags) == (name, ["td"])


@pytest.mark.parametrize(
    ("value", "told"),
    [
        (2214.0, "2,214"),
        (0.5, "0.5"),
        (0.99996, "1"),
        (999.7, "1,000"),
        (-0.01234, "-0.0123"),
        (0.0, "0"),
        (float("nan"), "-"),
        (None, "-"),
        (float("inf"), "infinite"),
        (np.int64(12345), "12,345"),
        (np.float64(3.14159), "3.14"),
        (1e-5, "1 × 10⁻⁵"),
        (2.5e12, "2.5 × 10¹²"),
        (999_000_000.0, "999,000,000"),
    ],
)
def test_numbers_are_written_out(value, told):
    assert number(value) == told


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_a_number_keeps_its_value_to_the_digits_asked_for(x):
    told = number(x, 4)
    assert "e" not in told
    mantissa, _, power = told.replace(",", "").partition(" × 10")
    superscripts = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
    read = float(f"{mantissa}e{power.translate(superscripts) or 0}") if abs(x) < 1e300 else x
    assert read == pytest.approx(x, rel=5.1e-4, abs=0)


@pytest.mark.parametrize(
    ("n", "noun", "told"),
    [
        (1, "seed", "1 seed"),
        (0, "run", "0 runs"),
        (3, "trajectory", "3 trajectories"),
        (2, "breach", "2 breaches"),
        (2, "day", "2 days"),
        (2, "process", "2 processes"),
        (1, "independent seed", "1 independent seed"),
    ],
)
def test_nouns_follow_their_count(n, noun, told):
    assert counted(n, noun) == told


def test_lists_read_as_sentences():
    assert [listed(list("abc")[:n]) for n in (0, 1, 2, 3)] == ["", "a", "a and b", "a, b and c"]
