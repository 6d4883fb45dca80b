"""How long things are there that messages name once, and need not repeat: counted, and said.

States are those that a message says, no others: what is still in force from an earlier one is no new state of something
that moves. A thing that is deleted, or over its lifetime, is absent, as one that a full list no longer holds.
"""

from __future__ import annotations

import numpy as np

from copem_replay.core.text import counted
from copem_replay.core.tracks import Bool, Int
from copem_replay.io.encodings.columns import Shredded, Texts, level_of, rows_above
from copem_replay.io.schemas.description import Life
from copem_replay.io.schemas.timestamps import nanoseconds


def life_notes(found: Shredded, life: Life, stamp_ns: Int, stamped: Bool) -> tuple[str, ...]:
    """How many things were in force unsaid, deleted, or over, in messages stamped `stamp_ns (F,)`, in their order."""
    level = level_of(life.id)
    ids = found.levels[level].texts[life.id]
    messages = found.levels[""].parent
    number = len(messages)
    at = rows_above(found, level, "")
    by_thing = np.lexsort((at, ids.code))
    at, code = at[by_thing], ids.code[by_thing]
    following = np.full(len(at), number)
    again = code[1:] == code[:-1]
    following[:-1][again] = at[1:][again]
    row = np.flatnonzero((following > at + 1) & (code >= 0))  # not in the next message
    at, code, following = at[row], code[row], following[row]
    deleted = _deleted(found, life, number, ids, at, code)
    # a message that holds nothing may have no stamp of its own
    now_ns = np.maximum.accumulate(np.where(stamped, stamp_ns, np.iinfo(np.int64).min)[messages])
    over = _over(found, life, by_thing[row], now_ns, at)
    gone = np.minimum(deleted, over)
    held = int((np.minimum(gone, following) - at - 1).clip(0).sum())
    by_hand = int(((deleted < following) & (deleted <= over)).sum())
    by_time = int(((over < following) & (over < deleted)).sum())
    notes = []
    if held:
        notes.append(
            f"{counted(held, 'state')} in force from earlier messages and not said again: not taken, "
            "a list holds what its message says"
        )
    if by_hand:
        notes.append(f"{counted(by_hand, 'entity', 'entities')} deleted")
    if by_time:
        notes.append(f"{counted(by_time, 'entity', 'entities')} over their lifetime")
    return tuple(notes)


def _deleted(found: Shredded, life: Life, never: int, ids: Texts, at: Int, code: Int) -> Int:
    """(K,) the first message after `at` that deletes what has this code; beyond all: none does."""
    if life.deletion is None:
        return np.full(len(at), never)
    level = level_of(life.deletion)
    kinds = found.levels[level].texts[life.deletion]
    when = rows_above(found, level, "")
    whole = np.array([word in life.all for word in kinds.words] + [False])[kinds.code]
    ends = np.append(np.unique(when[whole]), never)
    first: Int = ends[np.searchsorted(ends[:-1], at, side="right")]
    if life.deleted_id is None:
        return first
    named = found.levels[level].texts[life.deleted_id]
    number = {word: k for k, word in enumerate(ids.words)}
    of = np.array([number.get(word, -1) for word in named.words] + [-1], dtype=np.int64)[named.code]
    keys = np.unique((of * (never + 1) + when)[~whole & (of >= 0)])
    found_at = np.searchsorted(keys, code * (never + 1) + at, side="right")
    key = np.append(keys, -1)[found_at]
    by_id = np.where(key // (never + 1) == code, key % (never + 1), never)
    earlier: Int = np.minimum(first, by_id)
    return earlier


def _over(found: Shredded, life: Life, row: Int, times_ns: Int, at: Int) -> Int:
    """(K,) the first message after the lifetime of the things in these rows; beyond all: they have none."""
    never = np.full(len(row), len(times_ns))
    if not life.lifetime:
        return never
    columns = found.levels[level_of(life.id)].texts
    lasts_ns, said, _ = nanoseconds([_rows(columns[p], row) for p in life.lifetime], "s")
    from_ns = times_ns[at]
    if life.stamp:
        own_ns, stamped, _ = nanoseconds([_rows(columns[p], row) for p in life.stamp], "s")
        from_ns = np.where(stamped, own_ns, from_ns)
    ends: Int = np.searchsorted(times_ns, from_ns + lasts_ns, side="left")
    limited: Int = np.where(said & (lasts_ns > 0), np.maximum(ends, at + 1), never)
    return limited


def _rows(texts: Texts, row: Int) -> Texts:
    return Texts(texts.code[row], texts.words)
