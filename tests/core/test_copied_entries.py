"""Entries copied as words of memory are what NumPy copies field by field, to the last bit."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from copem_replay.core.object_list import ENTRY, Entries, entries_of, join_entries, take_entries


def drawn(seed: int, count: int) -> Entries:
    """Any bits, not-a-number among them."""
    size = count * ENTRY.itemsize
    return np.frombuffer(np.random.default_rng(seed).bytes(size), dtype=ENTRY).copy() if size else entries_of(0)


@given(st.integers(0, 99), st.integers(0, 9), st.lists(st.integers(0, 8), max_size=20))
def test_taken(seed: int, count: int, rows: list[int]) -> None:
    entries, picked = drawn(seed, count), np.array([r for r in rows if r < count], dtype=np.int64)
    found = take_entries(entries, picked)
    assert found.dtype == ENTRY
    assert found.tobytes() == entries[picked].tobytes()
    assert take_entries(entries[::2], picked[:0]).shape == (0,)
    found["x_m"] = 1.0  # its own memory
    assert entries.tobytes() == drawn(seed, count).tobytes()


@given(st.lists(st.integers(0, 5), max_size=4))
def test_joined(counts: list[int]) -> None:
    parts = [drawn(seed, count) for seed, count in enumerate(counts)]
    found = join_entries(parts)
    assert found.dtype == ENTRY
    assert found.flags.c_contiguous
    assert found.tobytes() == b"".join(one.tobytes() for one in parts)
    assert join_entries([drawn(1, 6)[::2]]).tobytes() == drawn(1, 6)[::2].tobytes()
