"""Text from outside: safe parsing of JSON, and values in messages, cut to a readable length."""

from __future__ import annotations

import json
import re
import reprlib
import sys
from collections import Counter
from typing import Any


class _Short(reprlib.Repr):
    """Representations that stay short, also of integers of any length."""

    def __init__(self, limit: int) -> None:
        super().__init__()
        self.maxlevel, self.maxdict, self.maxlist, self.maxtuple, self.maxset = 3, 4, 6, 6, 6
        self.maxstring = self.maxother = self.maxlong = limit

    def repr_int(self, x: int, level: int) -> str:
        # Python refuses to write integers of more than 4,300 digits.
        return super().repr_int(x, level) if x.bit_length() < 4000 else f"an integer of {x.bit_length()} bits"


def shortened(value: Any, limit: int = 80) -> str:
    """Represent ``value`` for a message in at most ``limit`` characters, its middle replaced by ``...``.

    Control characters and lone surrogates are escaped.

    >>> shortened("eye of the storm", 12)
    "'eye...torm'"
    """
    text = _Short(limit).repr(value)
    return text if len(text) <= limit else f"{text[: limit - 4]}...{text[-1]}"


def listed(names: Any, most: int = 4, limit: int = 40) -> str:
    """List the first few names for a message, each at most ``limit`` characters long.

    >>> listed(["bin", "table", "eye"], 2)
    "'bin', 'table', ..."
    """
    first = [shortened(name, limit) for _, name in zip(range(most), names, strict=False)]
    return ", ".join([*first, "..."] if len(names) > most else first)


def counted(n: int, noun: str, plural: str | None = None) -> str:
    """Write a count and its noun, in the plural unless the count is one.

    >>> counted(1, "independent seed"), counted(1200, "trajectory"), counted(2, "breach")
    ('1 independent seed', '1,200 trajectories', '2 breaches')
    """
    return f"{n:,} {noun if n == 1 else plural or _plural(noun)}"


def _plural(noun: str) -> str:
    if re.search("[^aeiou]y$", noun):
        return f"{noun[:-1]}ies"
    return f"{noun}es" if re.search("(s|x|ch|sh)$", noun) else f"{noun}s"


class JSONError(ValueError):
    """Text that is not JSON, or ambiguous JSON; the message says why."""


class JSONSyntaxError(JSONError):
    """Text that is not JSON; the message says where and why."""


def parsed_json(text: str) -> Any:
    """Parse JSON text. Raises :class:`JSONError` for text that cannot be read.

    Beside errors of syntax it refuses nesting deeper than Python's stack, integers of more digits than
    Python converts (4,300), and objects that have a field twice. ``NaN`` and ``Infinity`` are read as floats.
    """
    try:
        return json.loads(text, object_pairs_hook=_distinct)
    except JSONError:
        raise
    except json.JSONDecodeError as error:
        raise JSONSyntaxError(f"not valid JSON at character {error.pos + 1}: {error.msg}") from None
    except RecursionError:
        raise JSONError("its lists and objects are nested too deeply") from None
    except ValueError:
        digits = sys.get_int_max_str_digits()
        raise JSONError(f"it has an integer of more than {digits} digits") from None


def _distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    fields = dict(pairs)
    if len(fields) < len(pairs):
        twice = Counter(name for name, _ in pairs).most_common(1)[0][0]
        raise JSONError(f"the field {shortened(twice)} stands twice in one object")
    return fields
