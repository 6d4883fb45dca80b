"""Values as they lie in messages, the bits of numbers and the bytes of texts, made into columns.

What compiled walks through CDR and protobuf take; they know no types.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.io.encodings.columns import Level, Shredded, Texts, as_text, level_of


class DefinitionError(ValueError):
    """A definition that cannot be used: what is wrong with it, in words."""


@dataclass(frozen=True)
class Kind:
    """What the values of a column are.

    `how`: how NumPy reads the bits of a number (`f8`), or `bool`, `zigzag` (a signed number as protobuf's sint has it),
    `text`, `ended` (a text up to the zeros at its end), `bytes`. `names`: of the numbers of an enumeration.
    """

    how: str
    names: Mapping[int, str] = field(default_factory=dict)

    @property
    def is_number(self) -> bool:
        """Whether its bits are a number."""
        return self.how not in ("text", "ended", "bytes")


class RawColumn:
    """The values of one path, gathered batch by batch. `said (R,)` is False where a message says nothing."""

    def __init__(self, kind: Kind) -> None:
        self._kind = kind
        self._values: list[Any] = []
        self._codes: list[Int] = []
        self._said: list[Bool] = []
        self._code_of: dict[bytes, int] = {}

    def add(self, data: bytes, bits: Any, lengths: Int, said: Bool | None = None) -> None:
        """Values of a batch: their bits, or where in `data` they lie, and how long they are."""
        if said is not None:
            self._said.append(said)
        if self._kind.is_number:
            self._values.append(_numbers_in(bits, self._kind.how))
            return
        known = self._code_of
        parts = [data[b : b + n] for b, n in zip(bits.tolist(), lengths.tolist(), strict=True)]
        self._codes.append(np.array([known.setdefault(p, len(known)) for p in parts], dtype=np.int64))

    def numbers(self) -> Float:
        """All of them, as numbers; NaN: not said, or no number."""
        if self._kind.is_number:
            with np.errstate(invalid="ignore"):  # some NaN of float32
                found: Float = joined(self._values, np.float64).astype(np.float64)
        else:
            of_code = np.array([_number_in(p, self._kind.how) for p in self._code_of], dtype=np.float64)
            found = of_code[joined(self._codes, np.int64)]
        if self._said:
            found[~joined(self._said, bool)] = np.nan
        return found

    def texts(self) -> Texts:
        """All of them, as texts; code −1: not said."""
        code: Int
        if self._kind.is_number:
            values, code = np.unique(joined(self._values, np.float64), return_inverse=True)
            words = [self._word_of_number(v) for v in values.tolist()]
        else:
            code = joined(self._codes, np.int64)
            words = [_word(p, self._kind.how) for p in self._code_of]
        distinct = dict.fromkeys(words)  # what differs in bytes may be the same text
        number = {word: k for k, word in enumerate(distinct)}
        code = np.array([number[w] for w in words], dtype=np.int64)[code]
        if self._said:
            code[~joined(self._said, bool)] = -1
        return Texts(code, tuple(distinct))

    def _word_of_number(self, value: Any) -> str:
        if self._kind.how == "bool":
            return "true" if value else "false"
        return self._kind.names.get(value) or as_text(value)


def shredded(
    parents: Mapping[str, Int],
    columns: Mapping[str, RawColumn],
    numbers: Collection[str],
    texts: Collection[str],
    decoded: Bool,
) -> Shredded:
    """Columns by path, put into the levels they are of, by whose names `parents` are."""
    made = {name: Level(parent, {}, {}) for name, parent in parents.items()}
    for path, column in columns.items():
        if path in numbers:
            made[level_of(path)].numbers[path] = column.numbers()
        if path in texts:
            made[level_of(path)].texts[path] = column.texts()
    return Shredded(made, decoded)


def joined(parts: Sequence[Any], kind: Any) -> Any:
    """Arrays one after the other."""
    return np.concatenate(parts) if parts else np.zeros(0, dtype=kind)


def _numbers_in(bits: Any, how: str) -> Any:
    if how == "bool":
        return bits.astype(np.uint8)
    if how == "zigzag":
        return (bits >> np.uint64(1)).view(np.int64) ^ -(bits & np.uint64(1)).view(np.int64)
    return bits.astype(f"u{how[1]}", copy=False).view(how)


def _number_in(text: bytes, how: str) -> float:
    try:
        return float(_decoded(text, how))
    except ValueError:
        return np.nan


def _word(text: bytes, how: str) -> str:
    return text.hex() if how == "bytes" else _decoded(text, how)


def _decoded(text: bytes, how: str) -> str:
    return (text if how == "text" else text.rstrip(b"\0")).decode(errors="replace")
