"""First detections by match: scenes of a few lists, and the contract's sentences walked through plainly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from accuracy_oracle import looks_of, one_run, permuted
from copem_replay.fusion.object_list import Lists
from copem_replay.match import DUPLICATE, GHOST, MATCH, Matches
from copem_replay.matched import Steps, capture_instants, first_matches
from copem_replay.measure_keys import Confirm
from reports import entry, joined, lists_of


@dataclass(frozen=True)
class Item:
    """An entry in a fused list: of which object, captured when, how sure; places don't matter here."""

    object_ix: int
    captured_s: float
    existence: float = 1.0
    role: int = MATCH
    unit_ix: int = 0


def listed(runs: Sequence[Sequence[Sequence[Item]]]) -> tuple[Lists, Matches]:
    """Lists from [run][number] with what their entries are."""
    lists = lists_of(
        [
            [
                joined(*(entry(0, captured_s=e.captured_s, existence=e.existence, unit_ix=e.unit_ix) for e in one))
                for one in run
            ]
            for run in runs
        ]
    )
    flat = [e for run in runs for one in run for e in one]
    return lists, Matches(
        np.array([e.object_ix for e in flat], dtype=int), np.array([e.role for e in flat], dtype=np.int8)
    )


def found(
    run: Sequence[Sequence[Item]], issue_s: Sequence[float], *, look: tuple[float, float] = (1.0, 9.0),
    hits: int = 1, of: int = 1, captured_s: Sequence[float] | None = None, **more: Any,
) -> tuple[tuple[float, float, int] | None, list[tuple[float, float]]]:  # fmt: skip
    """Of object 7 in one run: detection, capture and unit, and the steps as existence and time."""
    lists, matches = listed([run])
    detections, steps = first_matches(
        lists, matches, np.array(issue_s, dtype=float), looks_of({7: look}),
        confirm=Confirm(hits=hits, of=of), count_earlier=more.pop("count_earlier", False),
        list_captured_s=np.array(issue_s if captured_s is None else captured_s, dtype=float), **more,
    )  # fmt: skip
    columns = (detections.detection_s, detections.captured_s, detections.first_unit_ix)
    at, captured, unit = (column[0, 0] for column in columns)
    assert np.isnan(at) == np.isnan(captured)
    rows = list(zip(steps.existence.tolist(), steps.detection_s.tolist(), strict=True))
    return (None if np.isnan(at) else (at, captured, int(unit))), rows


def test_known_when_the_first_list_with_a_match_is_available() -> None:
    lists = [[], [Item(7, 1.5, unit_ix=2)], [Item(7, 2.5, unit_ix=1)]]
    assert found(lists, [1.0, 2.0, 3.0])[0] == (2.0, 1.5, 2)


def test_duplicates_ghosts_and_matches_of_others_are_no_match() -> None:
    lists = [[Item(7, 1.0, role=DUPLICATE), Item(-1, 1.0, role=GHOST), Item(6, 1.0)], [Item(7, 2.0)]]
    assert found(lists, [1.0, 2.0])[0] == (2.0, 2.0, 0)


def test_what_was_captured_before_the_onset_does_not_count() -> None:
    lists = [[Item(7, 0.5)], [Item(7, 0.999)], [Item(7, 1.0 - 5e-7)], [Item(7, 1.5)]]
    assert found(lists, [1.0, 1.1, 1.2, 1.3])[0] == (1.2, 1.0 - 5e-7, 0)


def test_unless_earlier_captures_count() -> None:
    lists = [[Item(7, 0.2)], [Item(7, 1.0)]]
    assert found(lists, [0.3, 1.1], count_earlier=True)[0] == (0.3, 0.2, 0)


@pytest.mark.parametrize(("available_s", "in_time"), [(9.0, True), (9.0 + 5e-7, True), (9.00001, False)])
def test_a_list_after_the_end_is_too_late(available_s: float, in_time: bool) -> None:
    expected = (available_s, 8.0, 0) if in_time else None
    assert found([[Item(7, 8.0)]], [available_s])[0] == expected


def test_never() -> None:
    assert found([[], []], [1.0, 2.0]) == (None, [])


def test_confirmed_by_the_second_of_three_captures() -> None:
    here, gone = [Item(7, 5.0)], list[Item]()
    times = [1.0, 2.0, 3.0, 4.0, 5.0]
    assert found([here, gone, gone, here, here], times, hits=2, of=3)[0] == (5.0, 5.0, 0)
    assert found([here, gone, here, gone, here], times, hits=2, of=3)[0] == (3.0, 5.0, 0)
    assert found([here, gone, gone, here, gone], times, hits=2, of=3)[0] is None


def test_two_messages_of_one_capture_are_one_hit() -> None:
    lists = [[Item(7, 1.0)]] * 4
    assert found(lists, [1.0, 1.3, 2.0, 3.0], hits=2, of=2, captured_s=[1, 1, 2, 3])[0] == (2.0, 1.0, 0)


def test_either_list_of_a_capture_makes_the_hit() -> None:
    lists: list[list[Item]] = [[Item(7, 1.0)], [], [], [Item(7, 2.0)]]
    assert found(lists, [1.0, 1.3, 2.0, 2.3], hits=2, of=2, captured_s=[1, 1, 2, 2])[0] == (2.3, 2.0, 0)


def test_a_match_from_before_the_onset_is_no_hit() -> None:
    lists = [[Item(7, 0.9)], [Item(7, 1.1)], [Item(7, 2.0)]]
    assert found(lists, [1.0, 2.0, 3.0], hits=2, of=2)[0] == (3.0, 2.0, 0)
    assert found(lists, [1.0, 2.0, 3.0], hits=2, of=2, count_earlier=True)[0] == (2.0, 1.1, 0)


def test_captures_within_half_a_period_are_one_instant() -> None:
    assert capture_instants(np.array([0.0, 1.0, 2.0, 3.0])).tolist() == [0, 1, 2, 3]
    # Two units at 1 Hz, the second 0.3 s later; 0.6 s later it is an instant of its own.
    assert capture_instants(np.array([0.0, 0.3, 1.0, 1.3, 2.0, 2.3]), 1.0).tolist() == [0, 0, 1, 1, 2, 2]
    assert capture_instants(np.array([0.0, 0.6, 1.0, 1.6]), 1.0).tolist() == [0, 1, 1, 2]
    assert capture_instants(np.array([0.0, 0.5, 1.0]), 1.0).tolist() == [0, 0, 1]  # the bound is within


def test_a_list_without_news_belongs_to_the_capture_before() -> None:
    assert capture_instants(np.array([0.0, 1.0, 1.0, 0.2, 2.0])).tolist() == [0, 1, 1, 1, 2]
    assert capture_instants(np.array([-np.inf, -np.inf, 1.0, 2.0])).tolist() == [0, 0, 1, 2]
    assert capture_instants(np.array([3.0])).tolist() == [0]
    assert capture_instants(np.array([])).tolist() == []


def test_steps_rise_with_the_existence() -> None:
    existence = [0.4, 0.3, 0.6, 0.6, 0.9]
    lists = [[Item(7, 2.0, existence=e)] for e in existence]
    assert found(lists, [1.0, 2.0, 3.0, 4.0, 5.0]) == ((1.0, 2.0, 0), [(0.4, 1.0), (0.6, 3.0), (0.9, 5.0)])


def test_steps_of_a_confirmation_go_by_the_second_surest_of_the_last_three() -> None:
    existence = [0.9, 0.4, 0.6, 0.5, 0.8, 0.8]
    lists = [[Item(7, 2.0, existence=e)] for e in existence]
    # By windows: (.9, .4), (.9, .4, .6), (.4, .6, .5), (.6, .5, .8), (.5, .8, .8).
    expected = [(0.4, 2.0), (0.6, 3.0), (0.8, 6.0)]
    assert found(lists, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0], hits=2, of=3) == ((2.0, 2.0, 0), expected)


def test_no_looks_and_no_lists() -> None:
    lists, matches = listed([[[Item(3, 1.0)]], [[]]])
    once, one = np.array([1.0]), Confirm(hits=2, of=2)
    detections, steps = first_matches(
        lists, matches, once, looks_of({}), confirm=one, count_earlier=False, list_captured_s=once
    )
    assert detections.detection_s.shape == (2, 0)
    assert len(steps.run_ix) == len(steps.detection_s) == 0
    lists, matches = listed([[], []])
    none = np.array([])
    detections, steps = first_matches(
        lists, matches, none, looks_of({3: (0, 1)}), confirm=one, count_earlier=False, list_captured_s=none
    )
    assert np.isnan(detections.detection_s).all()
    assert detections.first_unit_ix.tolist() == [[-1], [-1]]
    assert len(steps.run_ix) == 0


def plainly(
    run: Sequence[Sequence[Item]], object_ix: int, look: tuple[float, float], captured: Sequence[int],
    confirm: Confirm, count_earlier: bool, at_least: float,
) -> tuple[float, float, int] | None:  # fmt: skip
    """One look of one run, list k available at k seconds, of entries of at least some existence."""
    held: set[int] = set()
    for k, one in enumerate(run):
        instant = max(captured[: k + 1])  # captures are whole seconds: each is an instant
        order = sorted(set(np.maximum.accumulate(captured).tolist()))
        for e in one:
            counts = e.role == MATCH and e.object_ix == object_ix and e.existence >= at_least and k <= look[1]
            if not counts or (e.captured_s < look[0] and not count_earlier):
                continue
            held.add(instant)
            last = [t for t in order if t <= instant][-confirm.of :]
            if len(held & set(last)) >= confirm.hits:
                return float(k), e.captured_s, e.unit_ix
    return None


def asked_for(steps: Steps, run: int, look: int, at_least: float) -> float | None:
    mine = (steps.run_ix == run) & (steps.look_ix == look)
    enough = steps.detection_s[mine][steps.existence[mine] >= at_least]
    return float(enough[0]) if len(enough) else None


EXISTENCE = [0.2, 0.5, 0.7, 0.9]
SEEN = st.none() | st.tuples(st.integers(0, 8), st.sampled_from(EXISTENCE), st.sampled_from([0, 0, 0, 1]), st.integers(-1, 2))  # fmt: skip # noqa: E501
RUN = st.lists(st.tuples(SEEN, SEEN), min_size=9, max_size=9)


@given(
    runs=st.lists(RUN, min_size=1, max_size=3),
    looks=st.lists(st.tuples(st.integers(0, 8), st.integers(0, 8)), min_size=2, max_size=2),
    captured=st.lists(st.integers(0, 8), min_size=9, max_size=9),
    confirm=st.sampled_from([(1, 1), (1, 3), (2, 2), (2, 3), (3, 5)]),
    count_earlier=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
)
def test_as_the_sentences_have_it(
    runs: list[Any], looks: list[tuple[int, int]], captured: list[int], confirm: tuple[int, int], count_earlier: bool,
    seed: int,
) -> None:  # fmt: skip
    objects = (4, 1)
    told = [
        [
            [Item(o, float(e[0]), e[1], e[2], e[3]) for o, e in zip(objects, pair, strict=True) if e is not None]
            for pair in run
        ]
        for run in runs
    ]
    lists, matches = listed(told)
    asked = Confirm(hits=confirm[0], of=confirm[1])
    issue_s, captured_s = np.arange(9.0), np.array(captured, dtype=float)
    look_at = dict(zip(objects, looks, strict=True))

    def first(lists: Lists, matches: Matches) -> Any:
        # Half a period is less than a second: every capture is an instant.
        return first_matches(
            lists, matches, issue_s, looks_of(look_at), confirm=asked, count_earlier=count_earlier,
            list_captured_s=captured_s, period_s=1.0,
        )  # fmt: skip

    detections, steps = first(lists, matches)
    for s, run in enumerate(told):
        for m, o in enumerate(objects):
            sure = plainly(run, o, look_at[o], captured, asked, count_earlier, 0.0)
            got = detections.detection_s[s, m], detections.captured_s[s, m], detections.first_unit_ix[s, m]
            assert got == sure if sure else np.isnan(got[0]) and np.isnan(got[1]) and got[2] == -1
            for e in EXISTENCE:
                expected = plainly(run, o, look_at[o], captured, asked, count_earlier, e)
                assert asked_for(steps, s, m, e) == (expected[0] if expected else None)
            mine = (steps.run_ix == s) & (steps.look_ix == m)
            assert (np.diff(steps.existence[mine]) > 0).all()
            assert (np.diff(steps.detection_s[mine]) > 0).all()
        alone, its = one_run(lists, s)
        by_itself, _ = first(alone, Matches(matches.object_ix[its], matches.role[its]))
        np.testing.assert_array_equal(by_itself.detection_s[0], detections.detection_s[s])
    assert (np.diff(steps.run_ix * len(objects) + steps.look_ix) >= 0).all()
    shuffled, moved, _ = permuted(lists, matches, np.random.default_rng(seed))
    assert moved is not None
    again, steps_again = first(shuffled, moved)
    np.testing.assert_array_equal(again.detection_s, detections.detection_s)
    np.testing.assert_array_equal(again.first_unit_ix, detections.first_unit_ix)
    np.testing.assert_array_equal(steps_again.existence, steps.existence)
