"""A report that is one file: text, tables and pictures, readable without a network and in either theme."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape
from numbers import Real
from pathlib import Path
from typing import NamedTuple


class Picture(NamedTuple):
    """A picture for each theme (PNG files), a caption, and a description for those who cannot see it."""

    light: Path | str
    dark: Path | str
    caption: str
    description: str


class Table(NamedTuple):
    """Rows under headings; cells are text or numbers, which are shown as ``str`` gives them."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str | Real]]
    caption: str = ""


class Section(NamedTuple):
    """A heading, paragraphs (separated by empty lines), then tables, then pictures."""

    title: str
    text: str = ""
    tables: Sequence[Table] = ()
    pictures: Sequence[Picture] = ()


_CSS = """
:root { color-scheme: light dark; --page: #ffffff; --ink: #1b1f24; --muted: #57606a; --rule: #d8dee4; }
@media (prefers-color-scheme: dark) {
  :root { --page: #0d1117; --ink: #e6edf3; --muted: #9aa5b1; --rule: #30363d; }
}
body { margin: 2rem auto; max-width: 60rem; padding: 0 1rem; background: var(--page); color: var(--ink);
  font: 16px/1.55 system-ui, sans-serif; }
h1 { font-size: 1.7rem; } h2 { font-size: 1.25rem; margin-top: 2.5rem; }
figure { margin: 1.5rem 0; } img { max-width: 100%; height: auto; }
figcaption, caption { color: var(--muted); font-size: .9rem; text-align: left; padding: .3rem 0; }
.table { overflow-x: auto; } table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
caption { caption-side: bottom; }
th, td { padding: .3rem .9rem .3rem 0; border-bottom: 1px solid var(--rule); text-align: left; }
.number { text-align: right; }
"""


def write_report(folder: Path | str, sections: Sequence[Section], title: str = "Report") -> Path:
    """Write ``folder/index.html`` with everything in it, pictures included; the folder is made if missing.

    Raises ``ValueError`` for a table whose rows do not fit its headings, and ``FileNotFoundError`` for a
    picture that is not there; nothing is written then.
    """
    body = "\n".join(_section(section) for section in sections)
    page = (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{_CSS}</style>\n</head>\n"
        f"<body>\n<h1>{escape(title)}</h1>\n{body}\n</body>\n</html>\n"
    )
    path = Path(folder) / "index.html"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(page, encoding="utf-8")
    return path


def _section(section: Section) -> str:
    paragraphs = [f"<p>{escape(part.strip())}</p>" for part in section.text.split("\n\n") if part.strip()]
    tables = [_table(table, section.title) for table in section.tables]
    parts = [f"<h2>{escape(section.title)}</h2>", *paragraphs, *tables, *map(_picture, section.pictures)]
    return "<section>\n" + "\n".join(parts) + "\n</section>"


def _table(table: Table, section: str) -> str:
    for i, row in enumerate(table.rows):
        if len(row) != len(table.headings):
            raise ValueError(
                f"section {section!r}: row {i} has {len(row)} cells under {len(table.headings)} headings"
            )
    # A column is aligned as numbers if all of it is.
    numeric = [all(isinstance(row[c], Real) for row in table.rows) for c in range(len(table.headings))]
    marks = [' class="number"' if number else "" for number in numeric]
    head = "".join(f"<th{mark}>{escape(h)}</th>" for mark, h in zip(marks, table.headings, strict=True))
    rows = [
        "<tr>"
        + "".join(f"<td{m}>{escape(str(cell))}</td>" for m, cell in zip(marks, row, strict=True))
        + "</tr>"
        for row in table.rows
    ]
    caption = f"<caption>{escape(table.caption)}</caption>" if table.caption else ""
    return (
        f'<div class="table"><table>{caption}<thead><tr>{head}</tr></thead>\n<tbody>\n'
        + "\n".join(rows)
        + "\n</tbody></table></div>"
    )


def _picture(picture: Picture) -> str:
    return (
        "<figure><picture>"
        f'<source media="(prefers-color-scheme: dark)" srcset="{_embedded(picture.dark)}">'
        f'<img src="{_embedded(picture.light)}" alt="{escape(picture.description)}">'
        f"</picture><figcaption>{escape(picture.caption)}</figcaption></figure>"
    )


def _embedded(path: Path | str) -> str:
    return "data:image/png;base64," + base64.b64encode(Path(path).read_bytes()).decode("ascii")
