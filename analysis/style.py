"""How figures look: two themes, one colour-blind safe palette (Okabe and Ito 2008), and saving.

Figures are made without pyplot and without touching ``rcParams``: they are values, drawn in either theme,
and a caller's own style stays what it was.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

DPI = 140
TEXT, SMALL, TITLE = 10.0, 8.5, 11.5


class Theme(NamedTuple):
    """Colours of a figure.

    ``surface`` is the page, ``ink`` text and lines, ``muted`` secondary text, ``grid`` rules. ``cell`` and
    ``view`` fill a floor map's cells, out of and in the learner's view; ``match`` and ``mismatch`` say
    whether something agrees with the expert. ``series`` colours methods, told apart by marker and dashes
    too; ``heat`` runs from the page to the colour of certainty.
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

    @property
    def colormap(self) -> LinearSegmentedColormap:
        """Sequential colours for probabilities, from the page's colour up."""
        return LinearSegmentedColormap.from_list(f"{self.name} heat", self.heat)


LIGHT = Theme(
    name="light", surface="#ffffff", ink="#1b1f24", muted="#57606a", grid="#d8dee4",
    cell="#eceff2", view="#fff1bf", match="#0072b2", mismatch="#e8894a", goal="#00805d",
    series=("#0072b2", "#d55e00", "#00805d", "#a8527f", "#8a6d00", "#3d8fc0"),
    heat=("#ffffff", "#cfe5f3", "#6fb1d8", "#0072b2", "#08304f"),
)  # fmt: skip
DARK = Theme(
    name="dark", surface="#0d1117", ink="#e6edf3", muted="#9aa5b1", grid="#30363d",
    cell="#1d242d", view="#4a431f", match="#6cbcf0", mismatch="#b4531a", goal="#2fc99b",
    series=("#56b4e9", "#f0883e", "#2fc99b", "#dd95bd", "#f0e442", "#9ec9ff"),
    heat=("#0d1117", "#11304a", "#17588a", "#2484c6", "#63b8f0"),
)  # fmt: skip
THEMES = (LIGHT, DARK)

MARKERS = ("o", "s", "^", "D", "v", "P")
DASHES: tuple[Any, ...] = (
    "solid",
    (0, (5, 2)),
    (0, (1.5, 1.5)),
    (0, (6, 2, 1.5, 2)),
    (0, (3, 1, 1, 1)),
    (0, (8, 3)),
)


def series_style(theme: Theme, i: int) -> dict[str, Any]:
    """Colour, marker and dashes of the ``i``-th method; repeats after six."""
    return {
        "color": theme.series[i % len(theme.series)],
        "marker": MARKERS[i % len(MARKERS)],
        "linestyle": DASHES[i % len(DASHES)],
    }


def new_figure(theme: Theme, width: float, height: float) -> Figure:
    """An empty figure of so many inches that arranges its axes without overlap."""
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
    axes.set_title(title, color=theme.ink, fontsize=TITLE, loc="left")
    axes.set_xlabel(x, color=theme.ink, fontsize=TEXT)
    axes.set_ylabel(y, color=theme.ink, fontsize=TEXT)
    axes.tick_params(which="both", colors=theme.muted, labelcolor=theme.ink, labelsize=SMALL)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(theme.muted)
    if grid is not None:
        axes.grid(axis=grid, color=theme.grid, linewidth=0.7)
        axes.set_axisbelow(True)


def head(
    figure: Figure, theme: Theme, handles: Sequence[Artist], *, title: str = "", columns: int = 3
) -> None:
    """Title and legend above all axes; one block, so that neither can cover the other."""
    legend = figure.legend(
        handles=list(handles), title=title or None, loc="outside upper left", ncols=columns, frameon=False,
        fontsize=TEXT, title_fontsize=TITLE + 0.5, alignment="left", labelcolor=theme.ink, borderaxespad=0.3,
    )  # fmt: skip
    legend.get_title().set_color(theme.ink)


def foot(figure: Figure, theme: Theme, note: str) -> None:
    """Small print below all axes."""
    figure.supxlabel(note, color=theme.muted, fontsize=TEXT - 1, x=0.99, ha="right")


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
