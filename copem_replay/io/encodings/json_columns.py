"""JSON made of columns, many records at once, as orjson writes it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from copem_replay.core.tracks import Int
from copem_replay.io.encodings.column_bytes import Each, Part, Pieces, Texts, constant

_COMMA = Texts.of([b",", b""])


def texts(values: Sequence[str]) -> Texts:
    """Texts to choose from, in quotes."""
    return Texts.of([orjson.dumps(value) for value in values])


def numbers(values: NDArray[Any] | None, rows: int) -> Pieces:
    """Numbers (N,); null where not finite, and everywhere where there are none."""
    if values is None:
        return constant(b"null", rows)
    text = orjson.dumps(np.ascontiguousarray(values), option=orjson.OPT_SERIALIZE_NUMPY)
    commas = np.flatnonzero(np.frombuffer(text, dtype=np.uint8) == ord(","))
    first = np.concatenate([[1], commas + 1])[:rows]
    return Texts(text, first, np.append(commas, len(text) - 1)[:rows] - first).at(np.arange(rows))


def array(start: Int, parts: Sequence[Part]) -> list[Part]:
    """Arrays of what the parts make of each of their rows; array n has the rows `start[n]:start[n + 1]`."""
    rows, first = len(start) - 1, np.zeros(start[-1] + 1, dtype=bool)
    first[start[:-1]] = True
    return [constant(b"[", rows), Each(start, [_COMMA.at(first[:-1]), *parts]), constant(b"]", rows)]
