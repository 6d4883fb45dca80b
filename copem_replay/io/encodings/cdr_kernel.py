"""Walking through CDR messages, compiled: a program made from the schema says what to pass over and what to take.

CDR has no lengths to jump by (OMG, Common Object Request Broker Architecture part 2, 9.3; DDS-XTypes 1.3, 7.4.3): to
get at a field, everything before it is walked through. The kernel knows no types: it takes the bytes of a number as
they are, and of a text where it lies; `io/encodings/cdr.py` makes numbers and texts of them, column by column.
"""

from __future__ import annotations

import numpy as np
from numba import njit

END, SKIP, TAKE, TEXT, BYTES, NUMBERS, LIST, ARRAY, NEXT, MARK, BACK, SIZE = range(12)
"""What an instruction does, a row of the program each, with three numbers:

SKIP alignment, bytes · TAKE size, column · TEXT column or −1, unit of its length · BYTES length, column · NUMBERS size
(a list of numbers, passed over) · LIST where it ends, level or −1 · ARRAY length, where it ends, level or −1 · NEXT
(the end of an item) · MARK, BACK: go back to where the mark is · SIZE (of what follows, which XCDR2 alone has) · END.
"""

DEEPEST = 32
"""Lists within lists; a program has no more."""
_HEADER = 4  # of the encapsulation; positions are aligned to what comes after it
_SPARE = 8  # so many bytes may be left over: padding


@njit(cache=True)
def _number(data, at, size, swapped):  # type: ignore[no-untyped-def]
    """The bits of a number."""
    bits = np.uint64(0)
    for k in range(size):
        byte = data[at + k] if swapped else data[at + size - 1 - k]
        bits = (bits << np.uint64(8)) | np.uint64(byte)
    return bits


@njit(cache=True)
def walk(data, bounds, program, first, room, bits, lengths, parent, decoded):  # type: ignore[no-untyped-def]
    """Rows of each level (L,). `room (L,)`: how many there is room for; what is beyond is counted and not kept.

    Message m is `data[bounds[m]:bounds[m + 1]]`. Column c of a level with row r goes to `bits[first[c] + r]`; of texts
    that is where they begin, and `lengths` how long they are. Level l has its rows' parents at `parent[l, r]`; level 0
    is the message. A message that does not fit its schema is not `decoded`, and leaves no rows.
    """
    rows = np.zeros(len(room), dtype=np.int64)
    before = np.zeros(len(room), dtype=np.int64)
    back = np.zeros(DEEPEST, dtype=np.int64)  # instruction after the head of each list that is open
    left = np.zeros(DEEPEST, dtype=np.int64)  # its items still to come
    owner = np.zeros(DEEPEST, dtype=np.int64)  # its level
    for m in range(len(bounds) - 1):
        begin, end = bounds[m] + _HEADER, bounds[m + 1]
        before[:] = rows
        if rows[0] < room[0]:
            parent[0, rows[0]] = m
        rows[0] += 1
        good = end >= begin and data[bounds[m]] == 0 and data[bounds[m] + 1] in (0, 1, 6, 7)
        swapped = good and data[bounds[m] + 1] in (0, 6)
        most = 4 if good and data[bounds[m] + 1] >= 6 else 8  # XCDR2 aligns to four bytes at most
        at, pc, depth, mark = begin, 0, 0, begin
        while good:
            op, a, b, c = program[pc, 0], program[pc, 1], program[pc, 2], program[pc, 3]
            pc += 1
            if op in (SKIP, TAKE, BYTES):
                step = a if op != BYTES else 1
                step = min(step, most)
                at += -(at - begin) % step
                size = b if op == SKIP else a
                if size > end - at:
                    good = False
                    break
                if op != SKIP:
                    slot = b
                    level = program[pc - 1, 3]
                    row = rows[level] - 1
                    if row < room[level]:
                        if op == TAKE:
                            bits[first[slot] + row] = _number(data, at, a, swapped)
                        else:
                            bits[first[slot] + row] = np.uint64(at)
                            lengths[first[slot] + row] = a
                at += size
            elif op == NEXT:
                left[depth - 1] -= 1
                if left[depth - 1] > 0:
                    level = owner[depth - 1]
                    pc = back[depth - 1]
                    if level >= 0:
                        rows[level] += 1
                        if rows[level] <= room[level]:
                            parent[level, rows[level] - 1] = parent[level, rows[level] - 2]
                else:
                    depth -= 1
            elif op == MARK:
                mark = at
            elif op == BACK:
                at = mark
            elif op == SIZE:
                if most == 4:
                    at += -(at - begin) % 4 + 4
                    if at > end:
                        good = False
                        break
            elif op == END:
                good = end - at <= _SPARE
                break
            else:
                if op == ARRAY:
                    number, stop, level = a, b, c
                else:
                    at += -(at - begin) % 4
                    if end - at < 4:
                        good = False
                        break
                    number, stop, level = np.int64(_number(data, at, 4, swapped)), a, b
                    at += 4
                if op == TEXT:
                    size = number * b
                    if size > end - at:
                        good = False
                        break
                    if a >= 0:
                        row = rows[c] - 1
                        if row < room[c]:
                            bits[first[a] + row] = np.uint64(at)
                            lengths[first[a] + row] = size
                    at += size
                elif op == NUMBERS:
                    if number > 0:
                        at += -(at - begin) % min(a, most)
                    if number > (end - at) // a:
                        good = False
                        break
                    at += number * a
                elif number == 0:
                    pc = stop
                else:
                    if number > end - at:  # an item is a byte at least
                        good = False
                        break
                    back[depth], left[depth], owner[depth] = pc, number, level
                    if level >= 0:
                        rows[level] += 1
                        if rows[level] <= room[level]:
                            inner = 0  # the nearest level around it
                            for d in range(depth - 1, -1, -1):
                                if owner[d] >= 0:
                                    inner = owner[d]
                                    break
                            parent[level, rows[level] - 1] = rows[inner] - 1
                    depth += 1
        decoded[m] = good
        if not good:
            rows[:] = before
    return rows
