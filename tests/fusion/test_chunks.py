"""Instants handed over in time chunks: every fusion gives the lists of one go, to the last bit."""

from __future__ import annotations

import functools
from dataclasses import replace
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from copem_replay.core.errors import InputError
from copem_replay.core.object_list import Entries, Inputs, ObjectLists, entries_of
from copem_replay.fusion.gnn import Gnn
from copem_replay.fusion.interface import Inbox, ListFusion, StepFusion, ask_fusion, ask_resumed_fusion
from copem_replay.fusion.nms import Nms
from copem_replay.fusion.testing import cut_chunk, join_chunks, needed_lists
from copem_replay.fusion.tracker import Tracker
from copem_replay.fusion.union import Union
from tests.fusion.test_tracker import street
from tests.helpers.reports import chunks, entry, inputs_of


class Walk(StepFusion):
    """As many entries as lists have arrived since the run began, modulo seven, each named by the last that did."""

    kind: str = "tests.fusion.test_chunks:Walk"

    def step(self, now_s: float, inbox: Inbox, memory: Any) -> tuple[Entries, Any]:
        count = (memory or 0) + len(inbox.arrived)
        entries = entries_of(count % 7)
        entries["cov_ee_m2"] = entries["cov_nn_m2"] = 1.0
        entries["captured_s"] = inbox.arrived[-1].captured_s
        entries["x_m"] = [one.entries["x_m"].sum() for one in inbox.arrived][-1] + np.arange(len(entries))
        return entries, count


FUSIONS: list[ListFusion] = [
    Union(),
    Nms(by="centre"),
    Nms(),
    Gnn(),
    Gnn(combine="covariance_intersection"),
    Gnn(combine="fast_covariance_intersection"),
    Gnn(combine="split_covariance_intersection"),
    Gnn(combine="covariance_union"),
    Tracker(late="stale", publish=0.2),
    Tracker(late="predict", publish=0.2),
    Tracker(late="replay", publish=0.2),
    Tracker(late="replay", buffer_s=0.2),
    Tracker(late="replay", buffer_s=10.0),
    Tracker(late="predict", publish=0.2, errors_last_s=0.5),
    Tracker(late="replay", publish=0.2, errors_last_s=0.5, common_share=0.3),
    Walk(),
]

WORLDS: list[dict[str, Any]] = [
    {"seed": 1, "runs": 1},
    {"seed": 2, "runs": 3, "together": False},
    {"seed": 3, "runs": 2, "delay_s": 3.0, "steps": 16},  # later than a second, and than most buffers
    {"seed": 4, "runs": 1, "delay_s": 0.0, "units": 1},
    {"seed": 5, "runs": 2, "steps": 0},
]


@functools.cache
def world(number: int) -> Inputs:
    return street(**WORLDS[number])


@functools.cache
def at_once(which: int, number: int) -> ObjectLists:
    return ask_fusion(FUSIONS[which], world(number), "fusion")


def in_chunks(fusion: ListFusion, told: Inputs, places: list[tuple[int, int]], looks_back_s: float) -> ObjectLists:
    memory: Any = None
    parts = []
    for a, b in places:
        found, memory = ask_resumed_fusion(fusion, cut_chunk(told, a, b, looks_back_s), memory, "fusion")
        parts.append(found)
    return join_chunks(parts)


@given(st.integers(0, len(FUSIONS) - 1), st.integers(0, len(WORLDS) - 1), st.lists(st.floats(0, 1), max_size=8))
def test_chunks_give_the_lists_of_one_go_to_the_last_bit(which: int, number: int, cuts: list[float]) -> None:
    fusion, told, expected = FUSIONS[which], world(number), at_once(which, number)
    found = in_chunks(fusion, told, chunks(cuts, len(told.issue_s)), fusion.looks_back_s)
    assert np.array_equal(found.start, expected.start)
    assert found.entries.tobytes() == expected.entries.tobytes()


@pytest.mark.parametrize("which", range(len(FUSIONS)))
def test_so_do_chunks_of_one_instant_each(which: int) -> None:
    fusion, told, expected = FUSIONS[which], world(2), at_once(which, 2)
    assert len(expected.entries) > 20
    found = in_chunks(fusion, told, list(pairwise(range(len(told.issue_s) + 1))), fusion.looks_back_s)
    assert np.array_equal(found.start, expected.start)
    assert found.entries.tobytes() == expected.entries.tobytes()


@pytest.mark.parametrize("late", ["stale", "predict", "replay"])
def test_a_track_goes_on_over_a_cut(late: str) -> None:
    times = [0.0, 0.25, 0.5, 0.75]
    told = inputs_of([[entry(t, vx_mps=1.0) for t in times]], ["a"] * 4, times, times)
    fusion = Tracker(late=late)
    memory = None
    for a, b in ((0, 2), (2, 2), (2, 3), (3, 4)):
        found, memory = ask_resumed_fusion(fusion, cut_chunk(told, a, b, fusion.looks_back_s), memory, "fusion")
    assert found.entries["track_id"].tolist() == [0]
    # Four entries at one variance: of a filter begun anew it would be the entry's own, and not yet confirmed.
    assert found.entries["cov_ee_m2"][0] < 0.8


@pytest.mark.parametrize("late", ["stale", "predict", "replay"])
def test_a_memory_is_left_as_it_was(late: str) -> None:
    """Going on from it twice gives the same lists twice."""
    fusion, told = Tracker(late=late), world(0)
    half = len(told.issue_s) // 2
    _, memory = ask_resumed_fusion(fusion, cut_chunk(told, 0, half, fusion.looks_back_s), None, "fusion")
    rest = cut_chunk(told, half, len(told.issue_s), fusion.looks_back_s)
    first, again = (ask_resumed_fusion(fusion, rest, memory, "fusion")[0] for _ in range(2))
    assert len(first.entries) > 20
    assert again.start.tolist() == first.start.tolist()
    assert again.entries.tobytes() == first.entries.tobytes()


def test_whoever_hears_again_needs_what_was_heard_of_late() -> None:
    fusion, told = Tracker(late="replay"), world(2)
    each = list(pairwise(range(len(told.issue_s) + 1)))
    found, expected = in_chunks(fusion, told, each, 0.0), ask_fusion(fusion, told, "fusion")
    assert not np.array_equal(found.start, expected.start) or found.entries.tobytes() != expected.entries.tobytes()


LISTS = st.lists(
    st.tuples(st.integers(0, 2), st.integers(0, 20), st.integers(0, 12) | st.none()),
    max_size=12,
    unique_by=lambda one: one[:2],
)


@given(LISTS, st.tuples(st.floats(0, 1), st.floats(0, 1)), st.sampled_from([0.0, 0.25, 1.0]))
def test_the_lists_a_chunk_needs(
    lists: list[tuple[int, int, int | None]], cuts: tuple[float, float], looks_back_s: float
) -> None:
    """Captures and ways in eighths of a second; a way of None: lost."""
    captured = [c / 8 for _, c, _ in lists]
    arrives = [np.inf if way is None else (c + way) / 8 for _, c, way in lists]
    said = [entry(float(f)) for f in range(len(lists))]
    told = inputs_of([said, said], [f"u{u}" for u, _, _ in lists], captured, arrives, names=["u0", "u1", "u2"])
    a, b = chunks(cuts, len(told.issue_s))[1]
    now_s = told.issue_s[a:b].tolist()
    expected = set()
    if now_s:
        expected = {f for f in range(len(lists)) if arrives[f] in now_s}
        expected |= {int(f) for f in told.newest[a:b].ravel() if f >= 0}
        earlier = [f for f in range(len(lists)) if arrives[f] < now_s[0]]
        if looks_back_s > 0:
            expected |= {f for f in earlier if captured[f] >= max(captured[g] for g in earlier) - looks_back_s}
    assert set(np.flatnonzero(needed_lists(told.captured_s, told, a, b, looks_back_s)).tolist()) == expected
    one = cut_chunk(told, a, b, looks_back_s)
    for s in (0, 1):
        assert [len(one.lists.of(s, f)) for f in range(len(lists))] == [f in expected for f in range(len(lists))]
        assert all(one.lists.of(s, f)["x_m"] == [f] for f in expected)
    assert one.issue_s.tolist() == now_s
    came = [one.arrived[i:j].tolist() for i, j in pairwise(one.arrived_start)]
    assert [sorted(these) for these in came] == [[f for f in range(len(lists)) if arrives[f] == t] for t in now_s]


# ----------------------------------------------------------------------------------------------------- own fusions


def test_whoever_overrides_fuse_has_to_say_anew_that_it_can_be_resumed() -> None:
    class Quiet(Union):
        min_existence: float = 0.5

    class Other(Tracker):
        def fuse(self, inputs: Inputs) -> ObjectLists:
            return super().fuse(inputs)

    class Sure(Other):
        resumable: ClassVar[bool] = True

        def fuse(self, inputs: Inputs) -> ObjectLists:
            return super().fuse(inputs)

    assert (Quiet().resumable, Other().resumable, Sure().resumable, Walk().resumable) == (True, False, True, True)
    assert "resumable" not in Sure().model_dump()


class NoMemory(Union):
    kind: str = "tests.fusion.test_chunks:NoMemory"

    def resume(self, inputs: Inputs, memory: Any) -> Any:
        return self.fuse(inputs)


class TooSure(Union):
    kind: str = "tests.fusion.test_chunks:TooSure"

    def resume(self, inputs: Inputs, memory: Any) -> tuple[ObjectLists, Any]:
        found = self.fuse(inputs)
        found.entries["existence"] = 2.0
        return found, None


class Crashes(Union):
    kind: str = "tests.fusion.test_chunks:Crashes"

    def resume(self, inputs: Inputs, memory: Any) -> tuple[ObjectLists, Any]:
        raise KeyError("gone")


class AllOfThem(Union):
    kind: str = "tests.fusion.test_chunks:AllOfThem"

    def resume(self, inputs: Inputs, memory: Any) -> tuple[ObjectLists, Any]:
        return inputs.lists, memory


HERE = r" \(.*test_chunks.py:\d+\)$"


@pytest.mark.parametrize(
    ("fusion", "said"),
    [
        (NoMemory, rf"NoMemory: resume: expected ObjectLists and a memory, found ObjectLists{HERE}"),
        (TooSure, rf"TooSure: existence: expected probabilities, found 2 … 2{HERE}"),
        (Crashes, rf"Crashes: KeyError: 'gone'{HERE}"),
        (AllOfThem, rf"AllOfThem: fuse: expected lists of ENTRY with start \(1, 3\), .* with start \(1, 37\){HERE}"),
    ],
)
def test_a_wrong_answer_is_named_by_its_place(fusion: type[ListFusion], said: str) -> None:
    with pytest.raises(InputError, match=rf"^configurations.mine.fusion: tests.fusion.test_chunks:{said}"):
        ask_resumed_fusion(fusion(), cut_chunk(world(0), 0, 2, 0.0), None, "configurations.mine.fusion")


def test_nothing_but_the_chunk_is_changed() -> None:
    told = world(1)
    one = cut_chunk(told, 2, 5, 0.5)
    same = ("units", "unit_ix", "captured_s", "arrives_s")
    assert all(getattr(one, name) is getattr(told, name) for name in same)
    whole = cut_chunk(replace(told), 0, len(told.issue_s), 0.0)
    assert whole.lists.entries.tobytes() == told.lists.entries.tobytes()  # all arrive
