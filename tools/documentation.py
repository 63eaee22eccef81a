"""MkDocs hooks: a page for every room of the package, and mathematics as MathML.

Nothing is loaded from elsewhere when a page is read: TeX between dollars is translated while the pages are
built, by :mod:`latex2mathml`.
"""

import ast
import html
import logging
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert

log = logging.getLogger("mkdocs.hooks.documentation")

ROOT = Path(__file__).parent.parent
SOURCES = ROOT / "build" / "api" / "i2rl"
FOLDERS = ("models", "inference", "domains", "analysis")
# Programs that nothing imports.
WITHOUT_PAGES = ("analysis.benchmarks", "analysis.notebooks")
MATH = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.S)
# Bars are fences, which have no space inside.
BAR = re.compile(r"(?:\\left|\\right)?\\([lr])(vert|Vert)")
SIDES = {"l": "left", "r": "right"}
OPERATOR = re.compile(r"<mi>(log|ln|exp)</mi>")
CODE = re.compile(r"<(pre|code)\b.*?</\1>", re.S)


def on_startup(command: str, dirty: bool) -> None:
    """Gather the sources under the package's name, before mkdocstrings looks for them."""
    _link_sources()


def on_config(config: Any) -> Any:
    """Add the pages of the rooms to the navigation."""
    folders = [{folder: [f"api/{room}.md" for room in _rooms(folder)]} for folder in FOLDERS]
    config.nav = [*config.nav, {"API": folders}]
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add the pages of the rooms."""
    from mkdocs.structure.files import File

    for folder in FOLDERS:
        for room in _rooms(folder):
            files.append(File.generated(config, f"api/{room}.md", content=_page(room)))
    return files


def on_page_content(content: str, page: Any, **kwargs: Any) -> str:
    """Replace TeX by MathML."""

    def translated(match: re.Match[str]) -> str:
        tex = BAR.sub(lambda bar: f"\\{SIDES[bar[1]]}\\{bar[1]}{bar[2]}", html.unescape(match[2]).strip())
        display = "block" if match[1] == "div" else "inline"
        try:
            mathml = convert(tex, display=display)
        except Exception as error:
            log.warning("%s: cannot read the formula %r: %s", page.file.src_uri, tex, error)
            return match[0]
        if unknown := re.search(r"\\[A-Za-z]+", mathml):
            log.warning("%s: unknown command %s in the formula %r", page.file.src_uri, unknown[0], tex)
        mathml = mathml.replace("<mover>", '<mover accent="true">')  # a hat touches its letter
        mathml = OPERATOR.sub(r'<mo form="prefix" lspace=".17em" rspace=".17em">\1</mo>', mathml)
        return f'<{match[1]} class="math">{mathml}</{match[1]}>'

    content = MATH.sub(translated, content)
    if "$" in CODE.sub("", content) and not page.file.src_uri.startswith("api/"):
        log.warning("%s: a formula is left as it was written; is there a | in a table?", page.file.src_uri)
    return content


def _link_sources() -> None:
    """Link what is documented: the checkout as a whole holds environments and builds as well."""
    SOURCES.mkdir(parents=True, exist_ok=True)
    for name in (*FOLDERS, *(path.name for path in ROOT.glob("*.py"))):
        link = SOURCES / name
        link.unlink(missing_ok=True)
        if name != "setup.py":
            link.symlink_to(ROOT / name)


def _rooms(folder: str) -> Iterator[str]:
    """Yield the dotted names of a folder's packages, the folder first."""
    for path in sorted((ROOT / folder).rglob("__init__.py")):
        room = ".".join(path.parent.relative_to(ROOT).parts)
        if not room.startswith(WITHOUT_PAGES):
            yield room


def _page(room: str) -> str:
    """Return the page of a room: its docstring, then its modules."""
    directory = ROOT.joinpath(*room.split("."))
    options = "    options: {show_root_heading: false, members: false}\n"
    parts = [f"# {room} {{#i2rl.{room}}}\n", f"::: i2rl.{room}\n{options}"]
    if (face := directory / "__init__.pyi").exists():
        links = " · ".join(f"[`{name}`][i2rl.{room}.{name}]" for name in _public_names(face))
        parts.append(f"`from i2rl.{room} import ...` gives: {links}\n")
    for path in sorted(directory.glob("*.py")):
        if not path.name.startswith("_") and _is_documented(path):
            parts.append(f"::: i2rl.{room}.{path.stem}\n")
    return "\n".join(parts)


def _public_names(face: Path) -> list[str]:
    """Return the names that a typed face re-exports."""
    imports = [node for node in ast.parse(face.read_text()).body if isinstance(node, ast.ImportFrom)]
    return sorted((alias.asname or alias.name for node in imports for alias in node.names), key=str.lower)


def _is_documented(path: Path) -> bool:
    return ast.get_docstring(ast.parse(path.read_text())) is not None
