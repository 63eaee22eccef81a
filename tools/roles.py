"""Griffe extension: read the docstrings' Sphinx roles and sections as Markdown with cross-references.

``:func:`~i2rl.models.soft_plan``` becomes a reference to the page of the function, wherever its module lies.
A reference that leads nowhere stays one, so that a strict build fails. ``:math:`` and ``.. math::`` become
TeX between dollars, ``Fields`` a table of attributes, ``See Also`` a list of references.
"""

import re
from collections import defaultdict
from collections.abc import Iterator
from typing import Any, cast

import griffe

ROLE = re.compile(r":(?P<role>func|class|mod|meth|attr|data|obj|exc):`(?P<short>[~!]?)(?P<target>[^`]+)`")
MATH_ROLE = re.compile(r":math:`([^`]+)`")
MATH_BLOCK = re.compile(
    r"^(?P<indent> *)\.\. math::[ ]*(?P<first>[^\n]*)\n(?P<rest>(?:[ \t]*\n|(?P=indent) +[^\n]*\n?)*)", re.M
)
# A closing sentence of the docstring, which a parser would take for one more parameter.
RAISES = re.compile(r"^Raises ``(?P<error>\w+)`` (?P<when>.+(?:\n.+)*)", re.M)
SECTION = re.compile(r"^(?:Parameters|Attributes|Returns|Yields|Raises)\n-+\n(?:(?!.+\n-+$).*\n?)+", re.M)
SEE_ALSO = re.compile(r"^See Also\n-+\n(?P<items>(?:[^\n]+\n?)+)", re.M)
PACKAGE = "i2rl"
WITHOUT_PAGES = ("i2rl.analysis.benchmarks", "i2rl.analysis.notebooks")


class Roles(griffe.Extension):
    """Translate every docstring of the package once it is loaded."""

    def on_package(self, *, pkg: griffe.Module, loader: griffe.GriffeLoader, **kwargs: Any) -> None:
        """Index the package's objects, then rewrite their docstrings."""
        objects = {found.path: found for found in walk(pkg)}
        index = Index(objects)
        _add_public_names(pkg, index)
        for found in objects.values():
            if found.is_class and "__new__" in found.members and "__init__" not in found.members:
                found.set_member("__init__", _initialiser(found.members["__new__"]))
            if found.is_function and not found.is_alias:
                _spell_out_options(cast(griffe.Function, found), index)
            if found.docstring is not None:
                found.docstring.value = as_markdown(found.docstring.value, index, found)


class Index:
    """Find the documented object that a reference in a docstring means."""

    def __init__(self, objects: dict[str, griffe.Object]) -> None:
        self.objects = objects
        self.by_name: dict[str, list[str]] = defaultdict(list)
        for path in objects:
            self.by_name[path.rpartition(".")[2]].append(path)

    def find(self, target: str, scope: griffe.Object) -> str | None:
        """Return the path of the nearest documented object; None for names of other libraries."""
        path = self._path(target, scope)
        while path is not None and path in self.objects and self.objects[path].docstring is None:
            path = path.rpartition(".")[0]
        return None if path is None or path.startswith(WITHOUT_PAGES) else path

    def _path(self, target: str, scope: griffe.Object) -> str | None:
        around: griffe.Object | None = scope
        while around is not None:
            if f"{around.path}.{target}" in self.objects:
                return f"{around.path}.{target}"
            if (member := around.members.get(target)) is not None and member.is_alias:
                return member.target_path  # type: ignore[union-attr]
            if isinstance(around, griffe.Class) and target in around.inherited_members:
                return around.inherited_members[target].canonical_path
            around = around.parent
        if target in self.objects:
            return target
        head, _, name = target.rpartition(".")
        within = head if head.startswith(PACKAGE) else PACKAGE
        suffix = name if head.startswith(PACKAGE) else target
        found = [
            path
            for path in self.by_name[name]
            if path.startswith(f"{within}.") and path.endswith(f".{suffix}")
        ]
        if len(found) == 1:
            return found[0]
        if not found and target.isupper() and target in "\n".join(scope.module.lines):
            return None  # a constant assigned together with others, which griffe does not see
        foreign = "." in target and not target.startswith(PACKAGE) and not found and not head[:1].isupper()
        return None if foreign else target


def walk(found: griffe.Object) -> Iterator[griffe.Object]:
    """Yield an object and everything defined in it; imported names are left out."""
    yield found
    for member in found.members.values():
        if not member.is_alias:
            yield from walk(member)  # type: ignore[arg-type]


def as_markdown(text: str, index: Index, scope: griffe.Object) -> str:
    """Translate roles, mathematics and sections of a docstring."""
    text = MATH_BLOCK.sub(_display, text)
    text = MATH_ROLE.sub(r"$\1$", text)
    text = re.sub(r"^Fields\n------$", "Attributes\n----------", text, flags=re.M)
    text = RAISES.sub(_raises, text)
    text = SEE_ALSO.sub(lambda match: _see_also(match["items"], index, scope), text)
    text = SECTION.sub(_plain_types, text)
    return ROLE.sub(lambda match: reference(match["target"], index, scope, short=match["short"] == "~"), text)


def reference(target: str, index: Index, scope: griffe.Object, *, short: bool = True) -> str:
    """Return a Markdown cross-reference to what ``target`` names."""
    shown = target.rpartition(".")[2] if short else target
    if shown.startswith("_"):
        return f"`{shown}`"
    path = index.find(target, scope)
    return f"`{shown}`" if path is None else f"[`{shown}`][{path}]"


def _add_public_names(pkg: griffe.Module, index: Index) -> None:
    """Give the namespaces the names that they load when they are used, which griffe does not see."""
    for namespace in pkg.modules.values():
        quoted = set(re.findall(r'"(\w+)"', "\n".join(namespace.lines)))
        for name in sorted(quoted - set(namespace.members)):
            found = [path for path in index.by_name[name] if path.startswith(f"{namespace.path}.")]
            if len(found) == 1:
                namespace.set_member(name, griffe.Alias(name, target=index.objects[found[0]]))


def _initialiser(new: Any) -> griffe.Function:
    """Return the parameters of a named tuple's ``__new__`` as those of its class."""
    return griffe.Function("__init__", parameters=new.parameters, lineno=new.lineno)


def _spell_out_options(function: griffe.Function, index: Index) -> None:
    """Replace ``**options: Unpack[Options]`` by the keywords of ``Options``, with the defaults of its tuple.

    The defaults are those of the named tuple beside it: ``Sampling`` for ``SamplingOptions``.
    """
    variadic = next((p for p in function.parameters if p.kind is griffe.ParameterKind.var_keyword), None)
    unpacked = re.fullmatch(r"(?:typing\.)?Unpack\[(\w+)\]", str(variadic.annotation)) if variadic else None
    found = index.by_name.get(unpacked[1], []) if unpacked else []
    if variadic is None or not found:
        return
    options = index.objects[found[0]]
    chosen = index.objects.get(found[0].removesuffix("Options"))
    del function.parameters[variadic.name]
    for name, attribute in options.attributes.items():
        default = chosen.attributes[name].value if chosen and name in chosen.attributes else "..."
        function.parameters.add(
            griffe.Parameter(
                name,
                annotation=attribute.annotation,
                kind=griffe.ParameterKind.keyword_only,
                default=default,
            )
        )


def _raises(match: re.Match[str]) -> str:
    when = " ".join(match["when"].split())
    return f"Raises\n------\n{match['error']}\n    {when[:1].upper()}{when[1:]}"


def _plain_types(match: re.Match[str]) -> str:
    """Strip the names and types of a section of markup: they are shown as code."""
    lines = (
        line if line[:1].isspace() else ROLE.sub(r"\g<target>", line).replace("``", "")
        for line in match[0].splitlines(keepends=True)
    )
    return "".join(lines)


def _display(match: re.Match[str]) -> str:
    lines = [match["first"], *match["rest"].splitlines()]
    body = " ".join(line.strip() for line in lines if line.strip())
    return f"{match['indent']}$$\n{match['indent']}{body}\n{match['indent']}$$\n\n"


def _see_also(items: str, index: Index, scope: griffe.Object) -> str:
    lines = []
    for line in items.splitlines():
        names, colon, told = line.partition(" : ")
        if line[:1].isspace():
            lines.append(line)
            continue
        links = ", ".join(reference(name.strip(), index, scope, short=False) for name in names.split(","))
        lines.append(f"- {links}{': ' + told if colon else ''}")
    return "**See also**\n\n" + "\n".join(lines) + "\n"
