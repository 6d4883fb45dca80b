"""Numbers and times from text, and ids that OSI can hold. Errors say where."""

from __future__ import annotations

import math
from collections.abc import Iterable
from decimal import Decimal
from typing import Final

from copem_replay.core.errors import InputError

LAST_SECOND: Final = 4_000_000_000  # Unix time of 2096; the reader takes no later stamp
_LARGEST_ID: Final = 2**63 - 1  # chosen: OSI ids have 64 bits, many readers keep them signed


def number(text: object, where: str) -> float:
    """Return a finite number. Raises InputError, `where: expected a number, found …`."""
    try:
        value = float(text) if isinstance(text, str | int | float) and not isinstance(text, bool) else math.nan
    except (ValueError, OverflowError):
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{where}: expected a number, found {shown(text)}")
    return value


def positive(text: object, where: str) -> float:
    """Do the same with one above 0."""
    if (value := number(text, where)) <= 0.0:
        raise InputError(f"{where}: expected a number above 0, found {shown(text)}")
    return value


def seconds_as_ns(text: object, where: str, *, times: Decimal = Decimal(1)) -> int:
    """Return nanoseconds of seconds, exactly as they are written; `times` is what they count. Raises InputError."""
    try:
        seconds = Decimal(str(text)) * times if not isinstance(text, bool) else Decimal("nan")
    except ArithmeticError:  # no number, or one whose exponent no decimal has
        seconds = Decimal("nan")
    if not seconds.is_finite() or not 0 <= seconds <= LAST_SECOND:
        raise InputError(f"{where}: expected a time of 0 to {LAST_SECOND} s, found {shown(text)}")
    return round(seconds * 1_000_000_000)


def shown(value: object) -> str:
    """Return it as an error quotes it: on one line, and not for ever."""
    text = "nothing" if value is None else repr(value)
    text = " ".join(text.split())
    return text if len(text) <= 60 else text[:57] + "…"


def numbered(names: Iterable[str]) -> dict[str, int]:
    """Return the OSI id of each name: the name itself where all are whole numbers, else 1, 2, … as they come."""
    unique = list(dict.fromkeys(names))
    if all(name.isascii() and name.isdecimal() and len(name) < 20 and str(int(name)) == name for name in unique):
        kept = {name: int(name) for name in unique}
        if all(ident <= _LARGEST_ID for ident in kept.values()):
            return kept
    return {name: k for k, name in enumerate(unique, start=1)}
