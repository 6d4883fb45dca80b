"""Walking through protobuf messages, compiled: a table made from the schema says which fields to take.

Wire format: protobuf.dev/programming-guides/encoding. The messages are in canonical form (`io/encodings/protobuf.py`
sees to that): every field as its schema has it, those that are not repeated once. The kernel takes the bits of a
number and the place of a text; it stays within the message whatever it says, and stops at what is none.
"""

from __future__ import annotations

import numpy as np
from numba import njit

VARINT, FIXED64, BYTES, GROUP, END_GROUP, FIXED32 = range(6)
"""Wire types."""
MESSAGE = 6
"""A field that is stepped into: bytes (or a group) that are a message."""
NUMBER, WHAT, COLUMN, LEVEL, INTO = range(5)
"""A row of the table of fields: its number, its wire type or MESSAGE, its column or −1, the level of a repeated one or
−1, the kind of message inside or −1."""
DEEPEST = 32
"""Messages within messages; no path leads deeper."""


@njit(cache=True)
def _varint(data, at, end):  # type: ignore[no-untyped-def]
    """A number, and where it ends; beyond `end` where it does not."""
    value, shift = np.uint64(0), 0
    while at < end and shift < 70:
        byte = data[at]
        value |= np.uint64(byte & 127) << np.uint64(shift)
        at += 1
        shift += 7
        if byte < 128:
            return value, at
    return value, end + 1


@njit(cache=True)
def _fixed(data, at, size):  # type: ignore[no-untyped-def]
    value = np.uint64(0)
    for k in range(size):
        value |= np.uint64(data[at + k]) << np.uint64(8 * k)
    return value


@njit(cache=True)
def _after(data, at, end, wire):  # type: ignore[no-untyped-def]
    """Where a value that begins at `at` ends; beyond `end` where it does not. Of a group: where its end is marked."""
    if wire == VARINT:
        return _varint(data, at, end)[1]
    if wire == FIXED64:
        return at + 8
    if wire == FIXED32:
        return at + 4
    if wire == BYTES:
        size, at = _varint(data, at, end)
        return end + 1 if at > end or size > np.uint64(end - at) else at + np.int64(size)
    depth = 1
    while at < end:
        mark = at
        tag, at = _varint(data, at, end)
        inner = np.int64(tag & np.uint64(7))
        if inner == GROUP:
            depth += 1
        elif inner == END_GROUP:
            depth -= 1
            if depth == 0:
                return mark
        elif inner > FIXED32:
            return end + 1
        else:
            at = _after_plain(data, at, end, inner)
    return end + 1


@njit(cache=True)
def _after_plain(data, at, end, wire):  # type: ignore[no-untyped-def]
    """The same of what is no group."""
    value, after = _varint(data, at, end)
    if wire == VARINT:
        return after
    if wire == BYTES:
        return end + 1 if after > end or value > np.uint64(end - after) else after + np.int64(value)
    return at + (8 if wire == FIXED64 else 4)


@njit(cache=True)
def walk(data, bounds, fields, node_first, node_level, blank, blank_first, first, room, bits, lengths, said, parent):  # type: ignore[no-untyped-def]
    """Rows of each level (L,). `room (L,)`: how many there is room for; what is beyond is counted and not kept.

    Message m is `data[bounds[m]:bounds[m + 1]]`. One of kind n has `fields[node_first[n]:node_first[n + 1]]`
    and is of level `node_level[n]`; where it is there, its columns `blank[blank_first[n]:blank_first[n + 1]]` are said,
    as 0 or empty. Column c of a level with row r goes to `bits[first[c] + r]`, `said` and, of texts, `lengths`. Level l
    has its rows' parents at `parent[l, r]`; level 0 is the message.
    """
    rows = np.zeros(len(room), dtype=np.int64)
    ends = np.zeros(DEEPEST, dtype=np.int64)
    nodes = np.zeros(DEEPEST, dtype=np.int64)
    for m in range(len(bounds) - 1):
        if rows[0] < room[0]:
            parent[0, rows[0]] = m
        rows[0] += 1
        at, depth, entered = bounds[m], 0, True
        ends[0], nodes[0] = bounds[m + 1], 0
        while depth >= 0:
            node, end = nodes[depth], ends[depth]
            if entered:
                entered = False
                row = rows[node_level[node]] - 1
                if row < room[node_level[node]]:
                    for k in range(blank_first[node], blank_first[node + 1]):
                        place = first[blank[k]] + row
                        bits[place], lengths[place], said[place] = 0, 0, True
            if at >= end:
                at, depth = end, depth - 1
                continue
            tag, at = _varint(data, at, end)
            wire, number = np.int64(tag & np.uint64(7)), np.int64(tag >> np.uint64(3))
            if at > end or wire > FIXED32:
                break
            if wire == END_GROUP:  # of the one that was stepped into
                continue
            after = _after(data, at, end, wire)
            if after > end:
                break
            found = -1
            for k in range(node_first[node], node_first[node + 1]):
                if fields[k, NUMBER] == number:
                    found = k
                    break
            if found < 0:
                at = after
                continue
            what, column, level, into = fields[found, 1], fields[found, 2], fields[found, 3], fields[found, 4]
            begin = _varint(data, at, end)[1] if wire == BYTES else at
            if what == MESSAGE:
                if (wire != BYTES and wire != GROUP) or depth + 1 == DEEPEST:
                    at = after
                    continue
                if level >= 0:
                    if rows[level] < room[level]:
                        parent[level, rows[level]] = rows[node_level[node]] - 1
                    rows[level] += 1
                depth += 1
                ends[depth], nodes[depth], at, entered = after, into, begin, True
                continue
            if what == wire or (wire == BYTES and level >= 0):  # one value, or many in one
                while True:
                    value, next_at = np.uint64(begin), after
                    if what == VARINT:
                        value, next_at = _varint(data, begin, after)
                    elif what != BYTES:
                        next_at = begin + (8 if what == FIXED64 else 4)
                    if next_at > after or (wire != what and begin == after):
                        break
                    if what in (FIXED64, FIXED32):
                        value = _fixed(data, begin, next_at - begin)
                    of = node_level[node]
                    if level >= 0:
                        of = level
                        if rows[level] < room[level]:
                            parent[level, rows[level]] = rows[node_level[node]] - 1
                        rows[level] += 1
                    if rows[of] - 1 < room[of]:
                        place = first[column] + rows[of] - 1
                        bits[place], lengths[place], said[place] = value, after - begin, True
                    begin = next_at
                    if begin >= after:
                        break
            at = after
    return rows
