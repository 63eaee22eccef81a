"""The page that a study writes: one file of text, tables and pictures, readable offline and in either theme.

Every page has the same first screen: a sentence on the result, one on its reliability, the weights with
intervals. :func:`write_page` asks for it, spells acronyms out where they first stand, and writes every number
given as a number with :func:`~i2rl.analysis.drawing.text.number`.
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable, Mapping, Sequence
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from .results import plain
from .style import Theme, save_themes
from .text import for_page, for_terminal, number

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.console import Console

GLOSSARY = {
    "AIRL": "adversarial inverse reinforcement learning",
    "BIRL": "Bayesian inverse reinforcement learning",
    "DARKO": "Discovering Agent Rewards for K-futures Online",
    "DPM-BIRL": "Bayesian inverse reinforcement learning with a Dirichlet process mixture",
    "EM-MLIRL": "maximum-likelihood inverse reinforcement learning by expectation-maximisation",
    "ESS": "effective sample size",
    "EVD": "expected value difference: value lost by acting as was learned",
    "GAIL": "generative adversarial imitation learning",
    "I2RL": "incremental inverse reinforcement learning",
    "ILE": "inverse learning error: value lost by acting as was learned",
    "IRL": "inverse reinforcement learning",
    "LBA": "learned behaviour accuracy: share of states in which the learned policy acts as the expert",
    "LME": "latent maximum entropy",
    "LME-I2RL": "incremental inverse reinforcement learning by latent maximum entropy",
    "MaxEnt": "maximum-entropy inverse reinforcement learning",
    "ME-I2RL": "incremental inverse reinforcement learning by maximum entropy",
    "MLIRL": "maximum-likelihood inverse reinforcement learning",
    "MME-MTIRL": "multi-task inverse reinforcement learning by minimax entropy",
    "NUTS": "no-U-turn sampler",
    "PCA": "principal component analysis",
    "RIFOM": "robust incremental inverse reinforcement learning with a frequentist observation model",
    "RIMEO": "robust incremental inverse reinforcement learning with a maximum-entropy observation model",
    "SSRR": "self-supervised reward regression",
    "robust-AIRL": "adversarial inverse reinforcement learning that reckons with noise",
}
"""What acronyms mean; a page says it where one first stands."""
_ACRONYM = re.compile(
    rf"(?<![\w-])({'|'.join(sorted(map(re.escape, GLOSSARY), key=len, reverse=True))})(?![\w-])"
)


class Picture(NamedTuple):
    """A picture for each theme (PNG files), a caption, and a description for those who cannot see it."""

    light: Path | str
    dark: Path | str
    caption: str
    description: str


def drawn(
    folder: Path | str, name: str, draw: Callable[[Theme], Figure], caption: str, description: str
) -> Picture:
    """Draw a picture in both themes into a folder (``name-light.png``, ``name-dark.png``)."""
    light, dark = save_themes(draw, folder, name)
    return Picture(light, dark, caption, description)


class Table(NamedTuple):
    """Rows under headings, and a caption of full sentences.

    Cells are text, shown as it is, or numbers, written by :func:`~i2rl.analysis.drawing.text.number`.
    """

    headings: Sequence[str]
    rows: Sequence[Sequence[str | float | Real]]
    caption: str = ""


class Section(NamedTuple):
    """A heading, paragraphs (separated by empty lines), then tables, then pictures."""

    title: str
    text: str = ""
    tables: Sequence[Table] = ()
    pictures: Sequence[Picture] = ()


class Lead(NamedTuple):
    """First screen of a page.

    Fields
    ------
    learned : str
        A sentence on the result.
    trust : str
        A sentence on whether to trust it, and why.
    weights : sequence of Table
        Weights with intervals, or the numbers that stand in their place where rewards have no weights.
    """

    learned: str
    trust: str
    weights: Sequence[Table] = ()


_CSS = """
:root { color-scheme: light dark; --page: #ffffff; --ink: #1b1f24; --muted: #57606a; --rule: #d8dee4; }
@media (prefers-color-scheme: dark) {
  :root { --page: #0d1117; --ink: #e6edf3; --muted: #9aa5b1; --rule: #30363d; }
}
body { margin: 2rem auto; max-width: 60rem; padding: 0 1rem; background: var(--page); color: var(--ink);
  font: 16px/1.55 system-ui, sans-serif; }
h1 { font-size: 1.7rem; } h2 { font-size: 1.25rem; margin-top: 2.5rem; } .lead { font-size: 1.15rem; }
figure { margin: 1.5rem 0; } img { max-width: 100%; height: auto; }
figcaption, caption, footer { color: var(--muted); font-size: .9rem; text-align: left; padding: .3rem 0; }
.table { overflow-x: auto; margin: 1rem 0 2rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
caption { caption-side: bottom; } footer { margin-top: 3rem; border-top: 1px solid var(--rule); }
th, td { padding: .3rem .9rem .3rem 0; border-bottom: 1px solid var(--rule); text-align: left;
  vertical-align: top; }
.number { text-align: right; }
"""


def write_page(
    folder: Path | str, title: str, lead: Lead, sections: Sequence[Section], results: Mapping[str, Any]
) -> Path:
    """Write ``folder/index.html``, pictures included, and ``folder/results.json``; return the page's path.

    Parameters
    ----------
    folder : path
        Made if it is missing.
    title : str
    lead : Lead
    sections : sequence of Section
    results : mapping
        The study as plain data, ``provenance`` among it
        (:func:`~i2rl.analysis.drawing.results.study_provenance`).

    Raises
    ------
    ValueError
        For a table whose rows do not fit its headings, a sentence or caption without a full stop, or results
        without provenance. Nothing is written then.
    FileNotFoundError
        For a picture that is not there. Nothing is written then.
    """
    if "provenance" not in results:
        raise ValueError(f"`results` must hold the key 'provenance'; got {', '.join(results)}")
    for field in ("learned", "trust"):
        _require_sentence(getattr(lead, field), f"`lead.{field}`")
    prose = _Prose()
    first = [f"<h1>{for_page(title)}</h1>", f'<p class="lead">{prose(f"{lead.learned} {lead.trust}")}</p>']
    first += [_table(table, "lead", prose) for table in lead.weights]
    body = "\n".join([*first, *(_section(section, prose) for section in sections), _footer(results)])
    page = (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{for_page(title)}</title>\n<style>{_CSS}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )
    data = json.dumps(plain(results), indent=2, allow_nan=False)
    path = Path(folder) / "index.html"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(page, encoding="utf-8")
    path.with_name("results.json").write_text(data + "\n", encoding="utf-8")
    return path


def print_tables(tables: Sequence[Table], console: Console, title: str = "") -> None:
    """Print a study's tables to a terminal, names and numbers as on its page."""
    from rich.table import Table as RichTable

    if title:
        console.print(for_terminal(title))
    for table in tables:
        shown = RichTable(
            caption=for_terminal(table.caption) if table.caption else None, caption_justify="left"
        )
        for i, heading in enumerate(table.headings):
            shown.add_column(for_terminal(heading), justify="left" if i == 0 else "right")
        for i, row in enumerate(table.rows):
            if i and row[0] and any(not above[0] for above in table.rows):
                shown.add_section()  # rows without a name belong to the one above
            shown.add_row(*(for_terminal(_cell(cell)) for cell in row))
        console.print(shown)


class _Prose:
    """Text of one page in HTML; remembers which acronyms were spelled out."""

    def __init__(self) -> None:
        self._told: set[str] = set()

    def __call__(self, text: str) -> str:
        """Escape text, spell acronyms out where they first stand, set what stands in backticks as code."""
        return self.code(_ACRONYM.sub(self._spelled, text))

    @staticmethod
    def code(text: str) -> str:
        """Escape text, and set what stands in backticks as code."""
        return re.sub(r"`([^`\n]+)`", r"<code>\1</code>", for_page(text))

    def meanings(self, text: str) -> str:
        """Write sentences on the acronyms in a table's cells that were not spelled out yet."""
        new = [name for name in dict.fromkeys(_ACRONYM.findall(text)) if name not in self._told]
        self._told |= set(new)
        return " ".join(f"{name}: {GLOSSARY[name]}." for name in new)

    def _spelled(self, found: re.Match[str]) -> str:
        name = found[1]
        if name in self._told:
            return name
        self._told.add(name)
        in_brackets = found.string[: found.start()].endswith("(")
        return f"{name}: {GLOSSARY[name]}" if in_brackets else f"{name} ({GLOSSARY[name]})"


def _require_sentence(text: str, what: str) -> None:
    if not text.strip().endswith((".", "?")):
        raise ValueError(f"{what} must be a sentence that ends with a full stop; got {text!r}")


def _section(section: Section, prose: _Prose) -> str:
    paragraphs = [f"<p>{prose(part.strip())}</p>" for part in section.text.split("\n\n") if part.strip()]
    tables = [_table(table, section.title, prose) for table in section.tables]
    pictures = [_picture(picture, prose) for picture in section.pictures]
    parts = [f"<h2>{for_page(section.title)}</h2>", *paragraphs, *tables, *pictures]
    return "<section>\n" + "\n".join(parts) + "\n</section>"


def _cell(cell: str | float | Real) -> str:
    return number(cell) if isinstance(cell, Real) else str(cell)


def _table(table: Table, section: str, prose: _Prose) -> str:
    for i, row in enumerate(table.rows):
        if len(row) != len(table.headings):
            raise ValueError(
                f"section {section!r}: row {i} has {len(row)} cells under {len(table.headings)} headings"
            )
    if table.caption:
        _require_sentence(table.caption, f"section {section!r}: a table's caption")
    # A column is aligned as numbers if all of it is.
    numeric = [all(isinstance(row[c], Real) for row in table.rows) for c in range(len(table.headings))]
    marks = [' class="number"' if number else "" for number in numeric]
    head = "".join(f"<th{mark}>{prose.code(h)}</th>" for mark, h in zip(marks, table.headings, strict=True))
    rows = [
        "<tr>"
        + "".join(f"<td{m}>{prose.code(_cell(cell))}</td>" for m, cell in zip(marks, row, strict=True))
        + "</tr>"
        for row in table.rows
    ]
    cells = " ".join([*table.headings, *(_cell(cell) for row in table.rows for cell in row)])
    text = " ".join(filter(None, [table.caption, prose.meanings(cells)]))
    caption = f"<caption>{prose(text)}</caption>" if text else ""
    return (
        f'<div class="table"><table>{caption}<thead><tr>{head}</tr></thead>\n<tbody>\n'
        + "\n".join(rows)
        + "\n</tbody></table></div>"
    )


def _picture(picture: Picture, prose: _Prose) -> str:
    _require_sentence(picture.caption, "a picture's caption")
    return (
        "<figure><picture>"
        f'<source media="(prefers-color-scheme: dark)" srcset="{_embedded(picture.dark)}">'
        f'<img src="{_embedded(picture.light)}" alt="{for_page(picture.description)}">'
        f"</picture><figcaption>{prose(picture.caption)}</figcaption></figure>"
    )


def _footer(results: Mapping[str, Any]) -> str:
    made = results["provenance"]
    versions = ", ".join(f"{package} {release}" for package, release in made["versions"].items())
    return (
        f"<footer>Made by i2rl {for_page(made['i2rl'])} with Python {for_page(made['python'])}, "
        f"{for_page(versions)}; seed {for_page(made['seed'])}. "
        f"Command: <code>{for_page(made['command'])}</code></footer>"
    )


def _embedded(path: Path | str) -> str:
    return "data:image/png;base64," + base64.b64encode(Path(path).read_bytes()).decode("ascii")
