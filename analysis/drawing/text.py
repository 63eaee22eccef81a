"""Text for readers: names of others made safe for each medium, numbers, and counted nouns.

Names of states, actions, features and methods come from files and callers. A terminal would obey their
control characters and Rich their brackets, a figure their dollar signs, and a page their angle brackets. Each
medium has one function here: :func:`for_terminal`, :func:`for_figure`, :func:`for_page`.
"""

from __future__ import annotations

import html
import math
import re
import unicodedata
from numbers import Integral, Real
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.text import Text

# Marks that reorder what follows them: a name could show the reader another name.
_REORDERING = set("\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")
_UNPRINTABLE = {"Cc", "Cs", "Co", "Cn", "Zl", "Zp"}
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
NOTHING = "-"
"""What a table shows where there is no number."""


def printable(text: object, *, lines: bool = False) -> str:
    r"""Show control characters as Python writes them, so that terminals ignore them.

    ``lines`` leaves line ends alone.

    >>> print(printable("north\x1b[31m"))
    north\x1b[31m

    See also :func:`for_terminal`, :func:`for_figure` and :func:`for_page`.
    """
    return "".join(
        character
        if (lines and character == "\n")
        or (unicodedata.category(character) not in _UNPRINTABLE and character not in _REORDERING)
        else character.encode("unicode_escape").decode("ascii")
        for character in str(text)
    )


def for_terminal(text: object) -> Text:
    """Make text that Rich prints as it is: no markup, no emoji codes, no control characters.

    >>> for_terminal("speed [m/s]").plain
    'speed [m/s]'
    """
    from rich.text import Text

    return Text(printable(text, lines=True))


def for_figure(text: object) -> str:
    r"""Make text that matplotlib draws as it is: no formulas, no label that a legend leaves out.

    Applying it twice is applying it once.

    >>> print(for_figure("cost [$/h], gain [$/h]"))
    cost [\$/h], gain [\$/h]
    """
    escaped = re.sub(r"(?<!\\)\$", r"\\$", printable(text, lines=True))
    # Legends leave out labels that begin with an underscore; a word joiner has no width.
    return f"\u2060{escaped}" if escaped.startswith("_") else escaped


def for_page(text: object) -> str:
    """Make text that a browser shows as it is, in elements and in attributes.

    >>> for_page("a < b")
    'a &lt; b'
    """
    return html.escape(printable(text, lines=True))


def number(value: Real | float | None, digits: int = 3) -> str:
    """Write a number with so many significant digits, never as ``2.2e+03``.

    Whole parts are written out with separators. Magnitudes below 0.0001 or from a thousand million on are
    multiples of a power of ten.

    >>> number(2214.3), number(0.012345), number(2.2e-16), number(7)
    ('2,214', '0.0123', '2.2 × 10⁻¹⁶', '7')
    """
    if value is None or math.isnan(value):
        return NOTHING
    if isinstance(value, Integral):
        return f"{int(value):,}"
    value = float(value)
    if math.isinf(value):
        return "infinite" if value > 0 else "minus infinity"
    if value == 0:
        return "0"
    # The exponent after rounding: 0.9996 has the digits of one.
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    power = int(exponent)
    if -4 <= power < 9:
        return _without_zeros(f"{value:,.{max(digits - 1 - power, 0)}f}")
    return f"{_without_zeros(mantissa)} × 10{str(power).translate(_SUPERSCRIPTS)}"


def _without_zeros(decimal: str) -> str:
    return decimal.rstrip("0").rstrip(".") if "." in decimal else decimal


def listed(names: list[str] | tuple[str, ...], conjunction: str = "and") -> str:
    """Join names as a sentence does.

    >>> listed(["a", "b", "c"])
    'a, b and c'
    """
    if len(names) < 2:
        return "".join(names)
    return f"{', '.join(names[:-1])} {conjunction} {names[-1]}"
