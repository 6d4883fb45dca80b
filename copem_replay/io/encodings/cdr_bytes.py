"""Messages of ROS 2 (CDR) encoded from columns, many at once, by the definitions in `ros2_types.py`.

A definition becomes a program, which the kernel runs for each message: numbers and texts one after the other, each
aligned to its own size. Little-endian (DDS-XTypes 1.3, 7.4.3). Content is as in `column_bytes.py`; what it leaves out
is 0 or empty.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.compiled import kernel
from copem_replay.core.tracks import Int
from copem_replay.io.encodings.cdr import BASES, DEEPEST, STRING_TYPE
from copem_replay.io.encodings.column_bytes import Content, Instants, RepeatedMessages, RowTexts
from copem_replay.io.encodings.ros2_types import list_fields

HEAD = b"\0\1\0\0"
"""The begin of every message; alignment counts from its end."""

END, NUMBERS, TEXT, LIST, NEXT = range(5)
"""Instructions, one in each row of a program, with up to three numbers:

NUMBERS column, size, how many · TEXT column · LIST column, where it ends · NEXT (the end of an item) · END."""
_FIRST_S, _LAST_S = -(2**31), 2**31 - 1


@kernel
def put_cdr(
    out: NDArray[np.uint8], sizes: Int, program: Int, first: Int, step: Int, cells: NDArray[np.uint64],
    pool: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Sizes of messages (N,); and their bytes, one after the other in the zeroed `out`, unless it is empty.

    In row r column c has the cells from `first[c] + step[c] * r` on: its numbers' bits; of a text its place in `pool`
    and its length; of a list its first row and how many it has.
    """
    loop_start = np.zeros(DEEPEST, dtype=np.int64)  # of each list that is open: instruction after its head
    items_left = np.zeros(DEEPEST, dtype=np.int64)  # its items still to come
    row = np.zeros(DEEPEST + 1, dtype=np.int64)  # where it is; the first is the message
    puts, offset = len(out) > 0, 0
    for m in range(len(sizes)):
        if puts:
            out[offset + 1] = 1
        begin, pc, depth, going = offset + 4, 0, 0, True
        offset = begin
        row[0] = m
        while going:
            op, column, size, number = program[pc, 0], program[pc, 1], program[pc, 2], program[pc, 3]
            pc += 1
            place = first[column] + step[column] * row[depth]
            if op == NUMBERS:
                offset += (begin - offset) & (size - 1)  # sizes are powers of two
                if puts and size == 8:  # a loop of known length is one instruction
                    for k in range(number):
                        for i in range(8):
                            out[offset + 8 * k + i] = np.uint8(cells[place + k] >> np.uint64(8 * i))
                elif puts:
                    for k in range(number):
                        for i in range(size):
                            out[offset + size * k + i] = np.uint8(cells[place + k] >> np.uint64(8 * i))
                offset += size * number
            elif op == NEXT:
                items_left[depth - 1] -= 1
                if items_left[depth - 1] > 0:
                    row[depth] += 1
                    pc = loop_start[depth - 1]
                else:
                    depth -= 1
            elif op == END:
                going = False
            else:
                offset += (begin - offset) & 3
                length: Any = np.int64(cells[place + 1])
                stated = np.uint64(length + (op == TEXT))  # with the zero at its end
                if puts:
                    for i in range(4):
                        out[offset + i] = np.uint8(stated >> np.uint64(8 * i))
                offset += 4
                if op == TEXT:
                    if puts:
                        for i in range(length):
                            out[offset + i] = pool[np.int64(cells[place]) + i]
                    offset += length + 1
                elif length == 0:
                    pc = size
                else:
                    loop_start[depth], items_left[depth] = pc, length
                    depth += 1
                    row[depth] = np.int64(cells[place])
        sizes[m] = offset - begin + 4


class _Program:
    """The program for messages of a type with some content, and its columns."""

    def __init__(self) -> None:
        self.rows: list[list[int]] = []
        self.cells: list[NDArray[np.uint64]] = []
        self.step: list[int] = []
        self.pool: list[NDArray[np.uint8]] = []
        self._pooled = 0

    def add_type(self, name: str, content: Content | Instants) -> None:
        """Add the steps that write all fields of a type, in their order. Raises KeyError: content of no field."""
        if isinstance(content, Instants):
            seconds, nanoseconds = np.divmod(content.time_ns, 1_000_000_000)
            content = {"sec": np.clip(seconds, _FIRST_S, _LAST_S), "nanosec": nanoseconds}
        fields = list_fields(name)
        if unknown := content.keys() - {field for _, field in fields}:
            raise KeyError(f"{name} has no {', '.join(sorted(unknown))}")
        for kind, field in fields:
            base, _, length = kind.partition("[")
            value: Any = content.get(field)
            if length == "]":
                self._add_list(base, value)
            elif base == STRING_TYPE:
                self._add(TEXT, self._text_cells(value))
            elif base in BASES:
                self._add_numbers(base, value, int(length[:-1] or 1))
            else:
                self.add_type(base, value or {})

    def _add(self, op: int, cells: NDArray[np.uint64], *more: int) -> list[int]:
        """Add an instruction with a column, (N, K) or (1, K) cells."""
        self.rows.append([op, len(self.cells), *more, *[0] * (2 - len(more))])
        self.cells.append(cells.ravel())
        self.step.append(cells.shape[1] if len(cells) > 1 else 0)
        return self.rows[-1]

    def _add_numbers(self, base: str, value: Any, number: int) -> None:
        size, kind = BASES[base]
        values = np.zeros(number) if value is None else np.asarray(value)
        bits = np.ascontiguousarray(values, dtype=kind).view(f"u{size}").astype(np.uint64)
        self._add(NUMBERS, bits.reshape(-1, number), size, number)

    def _text_cells(self, value: RowTexts | None) -> NDArray[np.uint64]:
        if value is None:
            return np.zeros((1, 2), dtype=np.uint64)
        cells = np.stack([value.first + self._pooled, value.sizes], axis=1).astype(np.uint64)
        self.pool.append(value.source.pool)
        self._pooled += len(value.source.pool)
        return cells

    def _add_list(self, base: str, value: RepeatedMessages | None) -> None:
        if value is None or not value.start[-1]:
            self._add(NUMBERS, np.zeros((1, 1), dtype=np.uint64), 4, 1)
            return
        which = np.arange(len(value.start) - 1) if value.which is None else value.which
        first = value.start[which]
        head = self._add(LIST, np.stack([first, value.start[which + 1] - first], axis=1).astype(np.uint64))
        self.add_type(base, value.content)
        self.rows.append([NEXT, 0, 0, 0])
        head[2] = len(self.rows)


def encode_cdr(name: str, content: Content, rows: int) -> list[bytes]:
    """One encoded message for each row; `name`: of the type, `package/msg/Type`."""
    built = _Program()
    built.add_type(name.replace("/msg/", "/"), content)
    program = np.array([*built.rows, [END, 0, 0, 0]], dtype=np.int64)
    cells, step = np.concatenate(built.cells), np.array(built.step, dtype=np.int64)
    first = np.cumsum([0, *map(len, built.cells)], dtype=np.int64)
    pool = np.concatenate([np.zeros(0, dtype=np.uint8), *built.pool])
    sizes = np.zeros(rows, dtype=np.int64)
    put_cdr(np.zeros(0, dtype=np.uint8), sizes, program, first, step, cells, pool)
    out = np.zeros(sizes.sum(), dtype=np.uint8)
    put_cdr(out, sizes, program, first, step, cells, pool)
    whole = out.tobytes()
    return [whole[begin:end] for begin, end in pairwise([0, *np.cumsum(sizes).tolist()])]
