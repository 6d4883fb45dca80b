"""Time stamps as messages write them: one number, seconds and nanoseconds, or text after ISO 8601."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from datetime import UTC, datetime, timedelta
from decimal import Decimal

import numpy as np

from copem_replay.core.tracks import Bool, Int
from copem_replay.io.encodings.columns import Texts, any_item

UNIT_NS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
_PAIRS = (("sec", "nanosec"), ("seconds", "nanos"), ("sec", "nsec"), ("secs", "nsecs"))
_LAST_SECOND = 4_000_000_000  # chosen: Unix time of 2096; differences of stamps still fit 64 bits
_ISO = re.compile(
    r"(\d{4})-(\d\d)-(\d\d)[Tt ](\d\d):(\d\d):(\d\d)(?:[.,](\d{1,30}))?\s?(?:[Zz]|(?:UTC)|([+-])(\d\d)(?::?(\d\d))?)?",
    re.ASCII,
)
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def stamps_in(offers: Collection[str], path: str) -> list[str]:
    """Paths of the time stamp at `path`: of one value, or of seconds and nanoseconds; none: there is none."""
    if any_item(path) in offers:
        return [path]
    pairs = ([f"{path}.{name}" for name in pair] for pair in _PAIRS)
    return next((both for both in pairs if all(any_item(p) in offers for p in both)), [])


def nanoseconds(texts: Sequence[Texts], unit: str) -> tuple[Int, Bool, int]:
    """(R,) time in ns of one column, or of seconds and nanoseconds, and whether it is one; how many cannot be.

    Decimal numbers are exact. A date without a zone is in UTC.
    """
    parts = [_of_words(t, unit if len(texts) == 1 else u) for t, u in zip(texts, ("s", "ns"), strict=False)]
    stamp_ns, said, impossible = parts[0]
    if len(parts) == 2:
        stamp_ns, said = stamp_ns + parts[1][0], said & parts[1][1]
        impossible += parts[1][2]
    return stamp_ns, said, impossible


def _of_words(texts: Texts, unit: str) -> tuple[Int, Bool, int]:
    of_word, good = np.zeros(len(texts.words) + 1, dtype=np.int64), np.zeros(len(texts.words) + 1, dtype=bool)
    impossible = np.zeros(len(texts.words) + 1, dtype=bool)
    for k, word in enumerate(texts.words):
        try:
            value, scale = Decimal(word), UNIT_NS[unit]
        except ArithmeticError:  # no number
            instant_ns = _of_date(word)
            if instant_ns is None:
                continue
            value, scale = Decimal(instant_ns), 1
        if value.is_finite() and value.copy_abs() <= _LAST_SECOND * 1_000_000_000 // scale:
            of_word[k], good[k] = round(value * scale), True
        else:
            impossible[k] = True
    return of_word[texts.code], good[texts.code], int(impossible[texts.code].sum())


def _of_date(word: str) -> int | None:
    """`2024-05-01T12:00:00.25+02:00` in ns of Unix time; None: it is none."""
    found = _ISO.fullmatch(word.strip())
    if found is None:
        return None
    *parts, fraction, sign, hours, minutes = found.groups()
    try:
        whole = datetime(*map(int, parts), tzinfo=UTC) - _EPOCH  # type: ignore[misc,arg-type]
    except ValueError:  # the 30th of February
        return None
    ahead = timedelta(hours=int(hours or 0), minutes=int(minutes or 0))
    whole += ahead if sign == "-" else -ahead
    nanos = round(Decimal(f"0.{fraction or 0}") * 10**9)
    return (whole.days * 86_400 + whole.seconds) * 10**9 + nanos
