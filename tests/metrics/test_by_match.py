"""First detections by match: scenes of a few lists, and the contract's sentences walked through plainly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from copem_replay.core.object_list import ObjectLists
from copem_replay.metrics.config import Confirm
from copem_replay.metrics.detection.by_match import CaptureInstants, DetectionSteps, FirstMatches, collect_captures
from copem_replay.metrics.matching import DUPLICATE, GHOST, MATCH, Matches
from tests.helpers.at_once import first_matches
from tests.helpers.reports import between, chunks, entry, joined, lists_of
from tests.metrics.test_by_truth_id import Unit, World, holds, tracks
from tests.oracles.accuracy import episodes_of, matches_of, one_run, permuted, taken


@dataclass(frozen=True)
class Item:
    """An entry in a fused list: of which object, captured when, how sure; places don't matter here."""

    object_ix: int
    captured_s: float
    existence: float = 1.0
    role: int = MATCH
    unit_ix: int = 0


def listed(runs: Sequence[Sequence[Sequence[Item]]]) -> tuple[ObjectLists, Matches]:
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
    return lists, matches_of([e.object_ix for e in flat], [e.role for e in flat])


def of_one_unit(captured_s: Sequence[float]) -> CaptureInstants:
    """Each capture an instant of its own."""
    times = np.array(captured_s, dtype=float)
    return CaptureInstants(times, np.zeros(len(times), dtype=int), np.arange(len(times)))


def found(
    run: Sequence[Sequence[Item]], issue_s: Sequence[float], *, episode: tuple[float, float] = (1.0, 9.0),
    hits: int = 1, of: int = 1, captured_s: Sequence[float] | None = None, count_earlier: bool = False,
) -> tuple[tuple[float, float, int] | None, list[tuple[float, float]]]:  # fmt: skip
    """Of object 7 in one run: detection, capture and unit, and the steps as existence and time."""
    lists, matches = listed([run])
    detections, steps = first_matches(
        lists, matches, np.array(issue_s, dtype=float), episodes_of({7: episode}),
        confirm=Confirm(hits=hits, of=of), count_earlier=count_earlier,
        captures=of_one_unit(issue_s if captured_s is None else captured_s),
    )  # fmt: skip
    columns = (detections.detection_s, detections.captured_s, detections.first_unit_ix)
    at, captured, unit = (column[0, 0] for column in columns)
    assert np.isnan(at) == np.isnan(captured)
    rows = list(zip(steps.existence.tolist(), steps.detection_s.tolist(), strict=True))
    return (None if np.isnan(at) else (at, captured, int(unit))), rows


def test_known_when_the_first_list_with_a_match_is_available() -> None:
    lists = [[], [Item(7, 1.5, unit_ix=2)], [Item(7, 2.5, unit_ix=1)]]
    assert found(lists, [1.0, 2.0, 3.0])[0] == (2.0, 1.5, 2)


def test_ghosts_and_matches_of_others_say_nothing_of_it() -> None:
    lists = [[Item(-1, 1.0, role=GHOST), Item(6, 1.0)], [Item(7, 2.0)]]
    assert found(lists, [1.0, 2.0])[0] == (2.0, 2.0, 0)


def test_a_newer_entry_beside_a_match_from_before_the_onset_makes_it_known() -> None:
    """The first unit's entry is the match, however old it is; what the second one lists since the onset counts."""
    lists = [[Item(7, 0.9, unit_ix=0), Item(7, 1.05, role=DUPLICATE, unit_ix=1)], [Item(7, 1.9, unit_ix=0)]]
    assert found(lists, [1.1, 2.0])[0] == (1.1, 1.05, 1)


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
    times, gone = [1.0, 2.0, 3.0, 4.0, 5.0], list[Item]()

    def run(*held: int) -> list[list[Item]]:
        return [[Item(7, t)] if t in held else gone for t in times]

    assert found(run(1, 4, 5), times, hits=2, of=3)[0] == (5.0, 5.0, 0)
    assert found(run(1, 3, 5), times, hits=2, of=3)[0] == (3.0, 3.0, 0)
    assert found(run(1, 4), times, hits=2, of=3)[0] is None


def test_however_often_a_capture_is_issued_it_is_one_hit() -> None:
    lists = [[Item(7, 1.0)], [Item(7, 1.0)], [Item(7, 1.0)], [Item(7, 2.0)]]
    assert found(lists, [1.0, 1.3, 2.0, 3.0], hits=2, of=2, captured_s=[1, 2])[0] == (3.0, 2.0, 0)
    assert found(lists[:3], [1.0, 1.3, 2.0], hits=2, of=2, captured_s=[1, 2])[0] is None


def test_what_arrives_late_confirms_by_its_capture() -> None:
    lists = [[Item(7, 3.0)], [], [Item(7, 2.0)]]
    assert found(lists, [3.0, 4.0, 5.0], hits=2, of=2, captured_s=[2, 3, 4, 5])[0] == (5.0, 2.0, 0)


def test_a_duplicate_says_that_its_capture_holds_the_object() -> None:
    lists = [[Item(7, 1.0)], [Item(7, 1.0), Item(7, 2.0, role=DUPLICATE)]]
    assert found(lists, [1.0, 2.0], hits=2, of=2)[0] == (2.0, 1.0, 0)  # the match stands for the list


def test_a_match_from_before_the_onset_is_no_hit() -> None:
    lists = [[Item(7, 0.9)], [Item(7, 1.1)], [Item(7, 2.0)]]
    times = [0.9, 1.1, 2.0]
    assert found(lists, times, hits=2, of=2)[0] == (2.0, 2.0, 0)
    assert found(lists, times, hits=2, of=2, count_earlier=True)[0] == (1.1, 1.1, 0)


def of_two_units(lists: Sequence[Sequence[Item]], issue_s: Sequence[float], captures: CaptureInstants) -> float | None:
    """When object 7 is confirmed by two of three."""
    found_lists, matches = listed([lists])
    detections, _ = first_matches(
        found_lists, matches, np.array(issue_s, dtype=float), episodes_of({7: (0.0, 9.0)}),
        confirm=Confirm(hits=2, of=3), count_earlier=False, captures=captures,
    )  # fmt: skip
    at = float(detections.detection_s[0, 0])
    return None if np.isnan(at) else at


def test_a_blind_unit_confirms_nothing_and_takes_nothing_away() -> None:
    """A mast lists every 0.8 s, a blind ego every 0.1 s: the mast's own two of three, and not before."""
    ego_s, mast_s = np.arange(20) / 10, np.array([0.0, 0.8, 1.6])
    captures = CaptureInstants(
        np.append(ego_s, mast_s), np.repeat([0, 1], [20, 3]), np.append(np.arange(20), [0, 8, 16])
    )
    lists = [[Item(7, mast_s[np.searchsorted(mast_s, t + 1e-9) - 1], unit_ix=1)] for t in ego_s]
    assert of_two_units(lists, ego_s.tolist(), captures) == 0.8


def test_captures_of_two_units_within_half_a_period_are_one_hit() -> None:
    captures = CaptureInstants(np.array([1.0, 2.0, 1.3, 2.3]), np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1]))
    lists = [[Item(7, 1.0)], [Item(7, 1.3, unit_ix=1)], [Item(7, 2.3, unit_ix=1)]]
    assert of_two_units(lists[:2], [1.0, 1.3], captures) is None
    assert of_two_units(lists, [1.0, 1.3, 2.3], captures) == 2.3


def test_one_capture_is_one_hit_though_it_is_its_units_first_and_another_unit_was_earlier() -> None:
    captures = CaptureInstants(np.array([2.0, 3.0, 1.0]), np.array([0, 0, 1]), np.array([1, 2, 0]))
    lists = [[], [Item(7, 2.0)], [Item(7, 3.0)]]
    assert of_two_units(lists[:2], [1.0, 2.0], captures) is None
    assert of_two_units(lists, [1.0, 2.0, 3.0], captures) == 3.0


def test_a_capture_nobody_made_goes_back_to_the_instant_before() -> None:
    lists = [[Item(7, 1.5)], [Item(7, 1.7)], [Item(7, 2.5)]]
    assert found(lists, [1.6, 1.8, 2.6], hits=2, of=2, captured_s=[1, 2])[0] == (2.6, 2.5, 0)
    assert found(lists, [1.6, 1.8, 2.6], hits=2, of=2, captured_s=[2])[0] is None  # before all captures: of none


def test_captures_are_those_that_were_heard() -> None:
    """By the same clusters as with truth ids; what never arrives is none."""
    b = Unit(0, ((0, holds()), (1000, holds()), (2000, holds())))
    a = Unit(100, ((300, holds()), (1300, holds())))
    received = tracks(World({"b": b, "a": a, "lost": Unit(0, ((900, holds()),))}, {}))
    arrives_s = np.where(received.captured_s == 0.9, np.inf, received.arrives_s)
    captures = collect_captures(replace(received, arrives_s=arrives_s))
    assert captures.captured_s.tolist() == [0.0, 1.0, 2.0, 0.3, 1.3]
    assert captures.unit_ix.tolist() == [0, 0, 0, 1, 1]
    assert captures.instant.tolist() == [0, 1, 2, 0, 1]


def test_steps_rise_with_the_existence() -> None:
    existence = [0.4, 0.3, 0.6, 0.6, 0.9]
    lists = [[Item(7, 2.0, existence=e)] for e in existence]
    assert found(lists, [1.0, 2.0, 3.0, 4.0, 5.0]) == ((1.0, 2.0, 0), [(0.4, 1.0), (0.6, 3.0), (0.9, 5.0)])


def test_steps_of_a_confirmation_go_by_the_second_surest_of_the_last_three() -> None:
    existence = [0.9, 0.4, 0.6, 0.5, 0.8, 0.8]
    lists = [[Item(7, 1.0 + k, existence=e)] for k, e in enumerate(existence)]
    # By windows: (.9, .4), (.9, .4, .6), (.4, .6, .5), (.6, .5, .8), (.5, .8, .8).
    expected = [(0.4, 2.0), (0.6, 3.0), (0.8, 6.0)]
    assert found(lists, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0], hits=2, of=3) == ((2.0, 2.0, 0), expected)


def test_no_looks_and_no_lists() -> None:
    lists, matches = listed([[[Item(3, 1.0)]], [[]]])
    once, one = np.array([1.0]), Confirm(hits=2, of=2)
    detections, steps = first_matches(
        lists, matches, once, episodes_of({}), confirm=one, count_earlier=False, captures=of_one_unit([1.0])
    )
    assert detections.detection_s.shape == (2, 0)
    assert len(steps.run_ix) == len(steps.detection_s) == 0
    lists, matches = listed([[], []])
    none = np.array([])
    detections, steps = first_matches(
        lists, matches, none, episodes_of({3: (0, 1)}), confirm=one, count_earlier=False, captures=of_one_unit([])
    )
    assert np.isnan(detections.detection_s).all()
    assert detections.first_unit_ix.tolist() == [[-1], [-1]]
    assert len(steps.run_ix) == 0


def plainly(
    run: Sequence[Sequence[Item]], object_ix: int, episode: tuple[float, float], captures: CaptureInstants,
    confirm: Confirm, count_earlier: bool, at_least: float,
) -> float | None:  # fmt: skip
    """One look of one run, list k available at k seconds, of entries of at least some existence."""
    instants: set[int] = set()
    made: dict[int, set[int]] = {0: set(), 1: set()}
    own = {u: captures.captured_s[captures.unit_ix == u].tolist() for u in (0, 1)}

    def enough(held: set[int]) -> bool:
        return any(len(held & set(range(first, first + confirm.of))) >= confirm.hits for first in range(-9, 19))

    for k, one in enumerate(run):
        for e in one:
            counts = (
                e.role in (MATCH, DUPLICATE)
                and e.object_ix == object_ix
                and e.existence >= at_least
                and k <= episode[1]
            )
            if not counts or (e.captured_s < episode[0] and not count_earlier):
                continue
            if confirm.hits == 1:
                return float(k)
            unit = next((u for u in (e.unit_ix, 0, 1) if u in own and e.captured_s in own[u]), None)
            if unit is not None:
                made[unit].add(own[unit].index(e.captured_s))
                instants.add(int(captures.instant[(captures.captured_s == e.captured_s)][0]))
            else:
                earlier = captures.instant[captures.captured_s < e.captured_s]
                instants |= {int(earlier.max())} if len(earlier) else set()
        if enough(instants) or enough(made[0]) or enough(made[1]):
            return float(k)
    return None


def asked_for(steps: DetectionSteps, run: int, episode: int, at_least: float) -> float | None:
    mine = (steps.run_ix == run) & (steps.episode_ix == episode)
    enough = steps.detection_s[mine][steps.existence[mine] >= at_least]
    return float(enough[0]) if len(enough) else None


EXISTENCE = [0.2, 0.5, 0.7, 0.9]
ENTRY = st.tuples(
    st.integers(0, 8), st.sampled_from(EXISTENCE), st.sampled_from([MATCH, MATCH, GHOST]), st.integers(-1, 1)
)
SPARE = st.none() | st.tuples(st.integers(0, 8), st.integers(-1, 1))
RUN = st.lists(st.tuples(st.none() | ENTRY, SPARE, st.none() | ENTRY, SPARE), min_size=9, max_size=9)


def items(told: tuple[Any, ...]) -> list[Item]:
    """Of each object an entry, perhaps; beside a match a duplicate, perhaps, that is no surer."""
    made = []
    for o, said, spare in ((4, told[0], told[1]), (1, told[2], told[3])):
        if said is not None:
            made.append(Item(o, float(said[0]), said[1], said[2], said[3]))
            if spare is not None and said[2] == MATCH:
                made.append(Item(o, float(spare[0]), said[1], DUPLICATE, spare[1]))
    return made


@given(
    runs=st.lists(RUN, min_size=1, max_size=3),
    episodes=st.lists(st.tuples(st.integers(0, 8), st.integers(0, 8)), min_size=2, max_size=2),
    first=st.sets(st.integers(0, 8)),
    second=st.sets(st.integers(0, 8)),
    confirm=st.sampled_from([(1, 1), (1, 3), (2, 2), (2, 3), (3, 5)]),
    count_earlier=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
    cuts=st.lists(st.floats(0, 1), max_size=5),
)
def test_as_the_sentences_have_it(
    runs: list[Any], episodes: list[tuple[int, int]], first: set[int], second: set[int], confirm: tuple[int, int],
    count_earlier: bool, seed: int, cuts: list[float],
) -> None:  # fmt: skip
    objects = (4, 1)
    told = [[items(one) for one in run] for run in runs]
    lists, matches = listed(told)
    asked = Confirm(hits=confirm[0], of=confirm[1])
    issue_s = np.arange(9.0)
    look_at = dict(zip(objects, episodes, strict=True))
    # Whole seconds: what two units captured in the same one is one instant.
    together = sorted(first | second)
    captured = [*sorted(first), *sorted(second)]
    captures = CaptureInstants(
        np.array(captured, dtype=float),
        np.repeat([0, 1], [len(first), len(second)]),
        np.array([together.index(t) for t in captured], dtype=int),
    )

    def detect(lists: ObjectLists, matches: Matches) -> Any:
        return first_matches(
            lists, matches, issue_s, episodes_of(look_at), confirm=asked, count_earlier=count_earlier, captures=captures
        )

    detections, steps = detect(lists, matches)
    for s, run in enumerate(told):
        for m, o in enumerate(objects):
            got = detections.detection_s[s, m], detections.captured_s[s, m], detections.first_unit_ix[s, m]
            for e in [0.0, *EXISTENCE]:
                assert asked_for(steps, s, m, e) == plainly(run, o, look_at[o], captures, asked, count_earlier, e)
            sure = plainly(run, o, look_at[o], captures, asked, count_earlier, 0.0)
            if sure is None:
                assert np.isnan(got[0])
                assert np.isnan(got[1])
                assert got[2] == -1
            else:
                assert got[0] == sure
                stands = [e for e in run[int(sure)] if e.object_ix == o and e.role != GHOST]
                assert got[1:] in {(e.captured_s, e.unit_ix) for e in stands}
            mine = (steps.run_ix == s) & (steps.episode_ix == m)
            assert (np.diff(steps.existence[mine]) > 0).all()
            assert (np.diff(steps.detection_s[mine]) > 0).all()
        alone, its = one_run(lists, s)
        by_itself, _ = detect(alone, taken(matches, its))
        np.testing.assert_array_equal(by_itself.detection_s[0], detections.detection_s[s])
    assert (np.diff(steps.run_ix * len(objects) + steps.episode_ix) >= 0).all()
    shuffled, moved, _ = permuted(lists, matches, np.random.default_rng(seed))
    assert moved is not None
    again, steps_again = detect(shuffled, moved)
    for name in ("detection_s", "captured_s", "first_unit_ix"):
        np.testing.assert_array_equal(getattr(again, name), getattr(detections, name))
    np.testing.assert_array_equal(steps_again.existence, steps.existence)
    adding = FirstMatches(
        episodes_of(look_at), runs=len(told), confirm=asked, count_earlier=count_earlier, captures=captures
    )  # fmt: skip
    for a, b in chunks(cuts, 9):
        some, rows = between(lists, a, b)
        adding.add(some, taken(matches, rows), issue_s[a:b])
    for whole, parts in zip((detections, steps), adding.result(), strict=True):
        for name in type(whole).__annotations__:
            column = getattr(whole, name)
            np.testing.assert_array_equal(getattr(parts, name), column)
            assert getattr(parts, name).dtype == column.dtype


@pytest.mark.parametrize("cut", [1, 2, 3])
def test_what_confirms_may_lie_on_both_sides_of_a_cut(cut: int) -> None:
    lists, matches = listed([[[Item(7, 1.0, 0.6)], [Item(7, 2.0, 0.4)], [], [Item(7, 3.0, 0.9)]]])
    issue_s = np.array([1.0, 2.0, 2.5, 3.0])
    adding = FirstMatches(
        episodes_of({7: (0.0, 9.0)}), runs=1, confirm=Confirm(hits=2, of=3), count_earlier=False,
        captures=of_one_unit([1, 2, 3]),
    )  # fmt: skip
    for a, b in ((0, cut), (cut, 4)):
        some, rows = between(lists, a, b)
        adding.add(some, taken(matches, rows), issue_s[a:b])
    _, steps = adding.result()
    assert steps.existence.tolist() == [0.4, 0.6]
    assert steps.detection_s.tolist() == [2.0, 3.0]


def test_little_is_remembered_of_what_is_known() -> None:
    """However long it is looked at: of captures that make it no surer nothing is kept."""
    times = [float(t) for t in range(1, 200)]
    lists, matches = listed([[[Item(7, t, 0.5 + (t % 10 == 0) * 0.3)] for t in times]] * 2)
    adding = FirstMatches(
        episodes_of({7: (0.0, 999.0)}), runs=2, confirm=Confirm(hits=2, of=3), count_earlier=False,
        captures=of_one_unit(times),
    )  # fmt: skip
    adding.add(lists, matches, np.array(times))
    # Of both runs every tenth capture, as an instant and as a list.
    assert len(adding._held) == 2 * 2 * 19


def test_of_equal_entries_about_one_object_the_newer_stands_then_that_of_the_first_unit() -> None:
    """The match is of before the onset; what else the list holds says since when the object is known, and by whom."""
    before = Item(7, 0.9, unit_ix=3)
    newer = [Item(7, 1.2, role=DUPLICATE, unit_ix=k) for k in (2, 1)]
    older = [Item(7, 1.1, role=DUPLICATE, unit_ix=0)]
    for order in ([before, *older, *newer], [before, *newer, *older], [*newer[::-1], *older, before]):
        assert found([order], [1.3], hits=2, of=2, captured_s=[1.1, 1.2])[0] == (1.3, 1.2, 1)
