"""Style of figures: two themes, one colour-blind safe palette, the style of every method, and saving.

Every two of the eight colours of a theme are at least 0.1 apart in OKLab, also as seen without red, green or
blue cones (Machado, Oliveira and Fernandes 2009); markers and dashes say the same once more.

Figures are made without pyplot and without touching ``rcParams``: they are values, drawn in either theme, and
a caller's own style stays unchanged.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any, Literal, NamedTuple

from jaxtyping import Float
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import CenteredNorm, LinearSegmentedColormap
from matplotlib.figure import Figure
from numpy import ndarray

from .text import for_figure

DPI = 140
TEXT, SMALL, TITLE = 10.0, 8.5, 11.5


class Theme(NamedTuple):
    """Colours of a figure.

    ``surface`` is the page, ``ink`` text and lines, ``muted`` secondary text, ``grid`` rules. ``cell`` and
    ``view`` fill a floor map's cells, out of and in the learner's view; ``match`` and ``mismatch`` say
    whether something agrees with the expert. ``series`` colours methods, which differ in marker and dashes
    too; ``heat`` runs from the page to the colour of certainty, ``signed`` from the negative over zero to the
    positive.
    """

    name: str
    surface: str
    ink: str
    muted: str
    grid: str
    cell: str
    view: str
    match: str
    mismatch: str
    goal: str
    series: tuple[str, ...]
    heat: tuple[str, ...]
    signed: tuple[str, ...]

    @property
    def colormap(self) -> LinearSegmentedColormap:
        """Sequential colours for probabilities, from the page's colour up."""
        return LinearSegmentedColormap.from_list(f"{self.name} heat", self.heat)

    def signed_shades(self, values: Float[ndarray, "..."]) -> ScalarMappable:
        """Colour values of either sign: zero is the colour in the middle, both sides have one scale."""
        largest = max((abs(float(v)) for v in values.ravel() if v == v), default=0.0)
        colours = LinearSegmentedColormap.from_list(f"{self.name} signed", self.signed)
        return ScalarMappable(CenteredNorm(0.0, largest or 1.0), colours)


LIGHT = Theme(
    name="light",
    surface="#ffffff",
    ink="#1b1f24",
    muted="#57606a",
    grid="#d8dee4",
    cell="#eceff2",
    view="#fff1bf",
    match="#0072b2",
    mismatch="#e8894a",
    goal="#00805d",
    series=("#153c7b", "#df6d15", "#0c736c", "#b279b0", "#835701", "#3a88fe", "#1b1f24", "#63310b"),
    heat=("#ffffff", "#cfe5f3", "#6fb1d8", "#0072b2", "#08304f"),
    signed=("#6b2c00", "#d2741f", "#e6e9ec", "#4f97cc", "#08304f"),
)
DARK = Theme(
    name="dark",
    surface="#0d1117",
    ink="#e6edf3",
    muted="#9aa5b1",
    grid="#30363d",
    cell="#1d242d",
    view="#4a431f",
    match="#6cbcf0",
    mismatch="#b4531a",
    goal="#2fc99b",
    series=("#708bfd", "#f76b10", "#82cda9", "#b17fa4", "#fecb2b", "#2164bd", "#e6edf3", "#ac4915"),
    heat=("#0d1117", "#11304a", "#17588a", "#2484c6", "#63b8f0"),
    signed=("#ffc08a", "#b9611a", "#262d36", "#2b78b8", "#9ad6ff"),
)
THEMES = (LIGHT, DARK)

MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
DASHES: tuple[Any, ...] = (
    "solid",
    (0, (5, 2)),
    (0, (1.5, 1.5)),
    (0, (6, 2, 1.5, 2)),
    (0, (3, 1, 1, 1)),
    (0, (8, 3)),
    (0, (8, 2, 1.5, 2, 1.5, 2)),
    (0, (3, 3)),
)


def series_style(theme: Theme, i: int) -> dict[str, Any]:
    """Colour, marker and dashes of the ``i``-th chain, bound or rule; repeats after eight.

    Methods have their own style in every figure: see :func:`method_styles`.
    """
    return _look(theme, i, i, i)


def _look(theme: Theme, colour: int, dashes: int, marker: int) -> dict[str, Any]:
    return {
        "color": theme.series[colour % len(theme.series)],
        "marker": MARKERS[marker % len(MARKERS)],
        "linestyle": DASHES[dashes % len(DASHES)],
    }


class _Family(NamedTuple):
    """Methods drawn together, with their colours; dashes and markers are so many places further on."""

    dashes: int
    markers: int
    colours: dict[str, int]


_FAMILIES = (
    _Family(
        0,
        0,
        {
            "LME-I2RL": 0,
            "LME-I2RL with random weights": 1,
            "batch LME": 2,
            "batch LME, again after every session": 3,
            "random weights": 5,
            "true policy": 6,
        },
    ),
    _Family(
        2,
        0,
        {
            "Jin et al., table over states": 4,
            "Jin et al., features": 3,
            "DARKO, goals": 7,
            "DARKO, windows of 5": 5,
            "ME-I2RL, features": 2,
        },
    ),
    _Family(
        0,
        5,
        {
            "MME-MTIRL": 0,
            "online MME-MTIRL": 1,
            "DPM-BIRL": 2,
            "EM-MLIRL": 3,
            "EM-MLIRL, number unknown": 4,
        },
    ),
    _Family(
        0,
        2,
        {
            "RIMEO, no scores": 0,
            "RIMEO, scores averaged": 1,
            "RIMEO, scores stepwise": 2,
            "true sensor": 3,
            "Robust IRL, batch": 4,
            "no noise": 5,
            "MLIRL, batch": 6,
            "RIFOM": 7,
        },
    ),
    _Family(4, 5, {"RIMEO, predicates alone": 3}),
    _Family(5, 2, {"oracle": 4, "observed": 5, "RIFOM, as coded": 3, "all, as printed": 1}),
    _Family(1, 0, {"hidden": 1, "hidden and noisy": 0}),
    _Family(
        6,
        2,
        {
            "AIRL, clean input": 5,
            "AIRL, noisy input": 1,
            "robust-AIRL, noisy input": 3,
            "SSRR + noisy-AIRL, noisy input": 2,
            "robust-AIRL, sensor learned": 4,
            "AIRL, noisy input, memory": 7,
        },
    ),
    _Family(1, 2, {"robust-AIRL": 3, "robust-AIRL, memory": 2}),
    _Family(
        0,
        1,
        {
            "i2rl": 0,
            "i2rl, by level": 5,
            "uniform": 6,
            "frequencies": 4,
            "frequencies of choices": 7,
            "given entry": 3,
            "level and entry": 2,
            "Markov": 1,
        },
    ),
    _Family(0, 6, {"MaxEnt": 0, "BIRL": 1, "BIRL, only open moves are actions": 4}),
)
METHOD_LOOKS = {
    name: (colour, (colour + family.dashes) % 8, (colour + family.markers) % 8)
    for family in _FAMILIES
    for name, colour in family.colours.items()
}
"""Palette by method: places of its colour in ``Theme.series``, of its dashes and of its marker."""
_SAME = {
    "LME-I2RL, seen": "LME-I2RL",
    "batch LME, once": "batch LME",
    "BIRL, blocked moves stay put": "BIRL",
}


def method_styles(theme: Theme, names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Colour, marker and dashes of every method of a figure, by its name.

    A method of this library has the same style in every figure. Others take the remaining styles, in their
    order.
    """
    names = list(dict.fromkeys(names))
    looks = {
        name: METHOD_LOOKS[_SAME.get(name, name)] for name in names if _SAME.get(name, name) in METHOD_LOOKS
    }
    taken = {colour for colour, _, _ in looks.values()}
    free = cycle([i for i in range(len(MARKERS)) if i not in taken] or range(len(MARKERS)))
    for name in names:
        if name not in looks:
            colour = next(free)
            looks[name] = (colour, colour, colour)
    return {name: _look(theme, *looks[name]) for name in names}


def new_figure(theme: Theme, width: float, height: float) -> Figure:
    """Make an empty figure of so many inches that arranges its axes without overlap."""
    return Figure(figsize=(width, height), dpi=DPI, facecolor=theme.surface, layout="constrained")


def dress(
    axes: Axes,
    theme: Theme,
    *,
    title: str = "",
    x: str = "",
    y: str = "",
    grid: Literal["both", "x", "y"] | None = "both",
) -> None:
    """Give axes the theme's colours, text sizes and labels, and rules along the axes named by ``grid``."""
    axes.set_facecolor(theme.surface)
    axes.set_title(for_figure(title), color=theme.ink, fontsize=TITLE, loc="left")
    axes.set_xlabel(for_figure(x), color=theme.ink, fontsize=TEXT)
    axes.set_ylabel(for_figure(y), color=theme.ink, fontsize=TEXT)
    axes.tick_params(which="both", colors=theme.muted, labelcolor=theme.ink, labelsize=SMALL)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(theme.muted)
    if grid is not None:
        axes.grid(axis=grid, color=theme.grid, linewidth=0.7)
        axes.set_axisbelow(True)


def name_ticks(
    axes: Axes, which: Literal["x", "y"], at: Sequence[float] | ndarray, names: Iterable[object], **text: Any
) -> None:
    """Label an axis with names, which may hold anything; ``text`` goes to ``set_xticks``."""
    (axes.set_xticks if which == "x" else axes.set_yticks)(at, [for_figure(name) for name in names], **text)


def headline(figure: Figure, theme: Theme, title: str, size: float = TITLE + 0.5) -> None:
    """Set the title above all axes of a figure without a legend there."""
    figure.suptitle(for_figure(title), color=theme.ink, fontsize=size, x=0.01, ha="left")


def head(
    figure: Figure, theme: Theme, handles: Sequence[Artist], *, title: str = "", columns: int = 3
) -> None:
    """Set the title and legend above all axes; one block, so that neither can cover the other."""
    named: dict[str, Any] = (
        {"labels": [for_figure(handle.get_label()) for handle in handles]} if handles else {}
    )
    legend = figure.legend(
        handles=list(handles),
        **named,
        title=for_figure(title) or None,
        loc="outside upper left",
        ncols=columns,
        frameon=False,
        fontsize=TEXT,
        title_fontsize=TITLE + 0.5,
        alignment="left",
        labelcolor=theme.ink,
        borderaxespad=0.3,
    )
    legend.get_title().set_color(theme.ink)


def foot(figure: Figure, theme: Theme, note: str) -> None:
    """Set the small print below all axes."""
    figure.supxlabel(for_figure(note), color=theme.muted, fontsize=TEXT - 1, x=0.99, ha="right")


def dress_bar(bar: Colorbar, theme: Theme, label: str) -> None:
    """Give a bar of colours the theme's text and lines."""
    bar.set_label(for_figure(label), color=theme.ink, fontsize=TEXT)
    bar.ax.tick_params(colors=theme.muted, labelcolor=theme.ink, labelsize=SMALL)
    bar.outline.set_edgecolor(theme.muted)


def save(figure: Figure, folder: Path | str, name: str) -> Path:
    """Write ``folder/name.png``; the folder is made if it is missing."""
    path = Path(folder) / f"{name}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=DPI, facecolor=figure.get_facecolor(), pil_kwargs={"optimize": True})
    return path


def save_themes(draw: Callable[[Theme], Figure], folder: Path | str, name: str) -> tuple[Path, Path]:
    """Draw in both themes: ``name-light.png`` and ``name-dark.png``, in this order."""
    light, dark = (save(draw(theme), folder, f"{name}-{theme.name}") for theme in THEMES)
    return light, dark
