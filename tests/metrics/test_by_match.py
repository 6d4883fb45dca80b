"""First detections by match: scenes of a few lists, and the contract's sentences walked through plainly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from copem_replay.core.object_list import ObjectLists
from copem_replay.metrics.config import Confirm
from copem_replay.metrics.detection.by_match import DetectionSteps, FirstMatches
from copem_replay.metrics.detection.by_truth_id import FirstDetections
from copem_replay.metrics.detection.turns import number_turns
from copem_replay.metrics.matching import DUPLICATE, GHOST, MATCH, Matches
from tests.helpers.at_once import first_matches
from tests.helpers.reports import between, chunks, entry, joined, lists_of
from tests.oracles.accuracy import episodes_of, matches_of, permuted, taken
from tests.oracles.origin import Heard, enough, going_back, holding, numbered, origins_of, tracks_of


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


def heard_of(runs: Sequence[Sequence[Sequence[Item]]], issue_s: Sequence[float], empty_s: Sequence[float] = ()) -> Any:
    """The lists that the entries say they are from, taken in when the first of them is issued, each holding their
    objects; and lists of the first unit, captured at `empty_s`, that hold nobody and come at once."""
    first: dict[tuple[int, float], float] = {}
    holds: dict[tuple[int, float], list[set[int]]] = {}
    for s, run in enumerate(runs):
        for now_s, one in zip(issue_s, run, strict=True):
            for item in one:
                name = (max(item.unit_ix, 0), item.captured_s)
                first[name] = min(now_s, first.get(name, np.inf))
                holds.setdefault(name, [set() for _ in runs])[s].add(item.object_ix)
    spare = [Heard(0, t, t, (frozenset(),)) for t in empty_s if (0, t) not in first]
    return spare + [Heard(u, t, at, tuple(map(frozenset, holds[u, t]))) for (u, t), at in first.items()]


def detect(
    runs: Sequence[Sequence[Sequence[Item]]], issue_s: Sequence[float], episodes: dict[int, tuple[float, float]],
    heard: Sequence[Heard], *, hits: int = 1, of: int = 1, count_earlier: bool = False,
) -> tuple[FirstDetections, DetectionSteps]:  # fmt: skip
    lists, matches = listed(runs)
    return first_matches(
        lists, matches, np.array(issue_s, dtype=float), episodes_of(episodes), confirm=Confirm(hits=hits, of=of),
        count_earlier=count_earlier, turns=number_turns(tracks_of(heard)), origins=origins_of(lists, issue_s, heard),
    )  # fmt: skip


def found(
    run: Sequence[Sequence[Item]], issue_s: Sequence[float], *, episode: tuple[float, float] = (1.0, 9.0),
    captured_s: Sequence[float] | None = None, heard: Sequence[Heard] | None = None, **asked: Any,
) -> tuple[tuple[float, float, int] | None, list[tuple[float, float]]]:  # fmt: skip
    """Of object 7 in one run: detection, capture and unit, and the steps as existence and time."""
    if heard is None:
        heard = heard_of([run], issue_s, issue_s if captured_s is None else captured_s)
    detections, steps = detect([run], issue_s, {7: episode}, heard, **asked)
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
    assert found(lists, [1.0, 1.1, 1.2, 1.3], captured_s=[])[0] == (1.2, 1.0 - 5e-7, 0)


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


def lists_of_unit(unit: int, captured_s: Sequence[float], *held_s: float, late_s: float = 0.0) -> list[Heard]:
    """Lists of a unit, those of `held_s` with object 7."""
    return [Heard(unit, t, t + late_s, (frozenset((7,)) if t in held_s else frozenset(),)) for t in captured_s]


def test_what_another_unit_sends_late_confirms_by_its_capture() -> None:
    heard = [*lists_of_unit(0, [2, 3, 4, 5], 3.0), *lists_of_unit(1, [2.0], 2.0, late_s=3.0)]
    lists = [[Item(7, 3.0)], [], [Item(7, 2.0, unit_ix=1)]]
    assert found(lists, [3.0, 4.0, 5.0], hits=2, of=2, heard=heard)[0] == (5.0, 2.0, 1)


def test_what_is_overtaken_belongs_to_the_turn_of_what_overtook_it() -> None:
    """The receiver issues a list twice; still the unit had one turn to say something new."""
    heard = [Heard(0, 3.0, 3.0, (frozenset((7,)),)), Heard(0, 2.0, 4.0, (frozenset((7,)),))]
    lists = [[Item(7, 3.0)], [Item(7, 2.0)]]
    assert found(lists, [3.0, 4.0], hits=2, of=2, heard=heard)[0] is None


def test_a_duplicate_says_that_its_capture_holds_the_object() -> None:
    lists = [[Item(7, 1.0)], [Item(7, 1.0), Item(7, 2.0, role=DUPLICATE)]]
    assert found(lists, [1.0, 2.0], hits=2, of=2)[0] == (2.0, 2.0, 0)


def test_a_match_from_before_the_onset_is_no_hit() -> None:
    lists = [[Item(7, 0.9)], [Item(7, 1.1)], [Item(7, 2.0)]]
    times = [0.9, 1.1, 2.0]
    assert found(lists, times, hits=2, of=2)[0] == (2.0, 2.0, 0)
    assert found(lists, times, hits=2, of=2, count_earlier=True)[0] == (1.1, 1.1, 0)


def test_a_blind_unit_confirms_nothing_and_takes_nothing_away() -> None:
    """A mast lists every 0.8 s, a blind ego every 0.1 s: the mast's own two of three, and not before."""
    ego_s, mast_s = (np.arange(20) / 10).tolist(), [0.0, 0.8, 1.6]
    heard = lists_of_unit(0, ego_s) + lists_of_unit(1, mast_s, *mast_s)
    lists = [[Item(7, max(m for m in mast_s if m <= t), unit_ix=1)] for t in ego_s]
    assert found(lists, ego_s, episode=(0.0, 9.0), heard=heard, hits=2, of=3)[0] == (0.8, 0.8, 1)


def test_captures_of_two_units_within_half_a_period_are_one_hit() -> None:
    heard = lists_of_unit(0, [1.0, 2.0], 1.0) + lists_of_unit(1, [1.3, 2.3], 1.3, 2.3)
    lists = [[Item(7, 1.0)], [Item(7, 1.3, unit_ix=1)], [Item(7, 2.3, unit_ix=1)]]
    assert found(lists[:2], [1.0, 1.3], heard=heard, hits=2, of=3)[0] is None
    assert found(lists, [1.0, 1.3, 2.3], heard=heard, hits=2, of=3)[0] == (2.3, 2.3, 1)


def test_lists_that_one_fused_list_takes_in_are_one_hit_however_many_they_are() -> None:
    """Lists at 10 Hz, issued at 5 Hz: two of two are two issued lists, for it or for another unit's entry beside it."""
    heard = [Heard(0, t / 10, (t + t % 2) / 10, (frozenset((7,)),)) for t in range(1, 9)]
    lists = [[Item(7, t / 10)] for t in (2, 4, 6, 8)]
    assert found(lists, [0.2, 0.4, 0.6, 0.8], episode=(0, 9), heard=heard, hits=2, of=2)[0] == (0.4, 0.4, 0)
    assert found(lists, [0.2, 0.4, 0.6, 0.8], episode=(0, 9), heard=heard, hits=3, of=3)[0] == (0.6, 0.6, 0)


def test_a_list_that_does_not_hold_it_makes_nobody_known() -> None:
    """The entry of a neighbour lies within the gate: whatever it is matched with, no list holds it before 3 s."""
    heard = lists_of_unit(0, [1, 2, 3], 3.0)
    assert found([[Item(7, 1.0)], [Item(7, 2.0)], [Item(7, 3.0)]], [1, 2, 3], heard=heard)[0] == (3.0, 3.0, 0)


def test_an_entry_with_an_old_capture_goes_back_to_what_was_new_then() -> None:
    """A track that coasts: since 2 s no list holds the object, and its newest capture, 1 s, is before the onset."""
    heard = lists_of_unit(0, [1, 2, 3], 1.0)
    coasting = [[Item(7, 1.0)], [Item(7, 1.0)], [Item(7, 1.0)]]
    assert found(coasting, [1, 2, 3], episode=(1.5, 9.0), heard=heard)[0] is None
    assert found(coasting, [1, 2, 3], episode=(0.5, 9.0), heard=heard)[0] == (1.0, 1.0, 0)
    claims = [[], [Item(7, 2.0)], [Item(7, 3.0)]]  # false: no list of these captures holds it
    assert found(claims, [1, 2, 3], episode=(0.5, 9.0), heard=heard)[0] is None


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
    detections, steps = detect([[[Item(3, 1.0)]], [[]]], [1.0], {}, [], hits=2, of=2)
    assert detections.detection_s.shape == (2, 0)
    assert len(steps.run_ix) == len(steps.detection_s) == 0
    detections, steps = detect([[], []], [], {3: (0, 1)}, [], hits=2, of=2)
    assert np.isnan(detections.detection_s).all()
    assert detections.first_unit_ix.tolist() == [[-1], [-1]]
    assert len(steps.run_ix) == 0


def plainly(
    run: Sequence[Sequence[Item]], s: int, object_ix: int, episode: tuple[float, float], heard: Sequence[Heard],
    confirm: Confirm, count_earlier: bool, at_least: float,
) -> tuple[float, float, int] | None:  # fmt: skip
    """One look of one run, list k available at k seconds, of entries of at least some existence."""
    turn, instant = numbered(heard)
    turns, instants = dict[int, set[int]](), set[int]()
    for k, one in enumerate(run):
        about = [e for e in one if e.role in (MATCH, DUPLICATE) and e.object_ix == object_ix]
        origin = set[int]()
        for e in about:
            if e.existence >= at_least and k <= episode[1]:
                back = going_back(heard, e.captured_s, k, max_age_s=1.0)
                since = [[a for a in of_unit if heard[a].captured_s >= episode[0] or count_earlier] for of_unit in back]
                origin |= set(holding(heard, since, s, object_ix))
        for a in origin:
            turns.setdefault(turn[a][0], set()).add(turn[a][1])
            instants.add(instant[a])
        confirmed = (enough(places, confirm.hits, confirm.of) for places in (instants, *turns.values()))
        if origin and any(confirmed):
            newest = min(origin, key=lambda a: (-heard[a].captured_s, heard[a].unit))
            return float(k), heard[newest].captured_s, heard[newest].unit
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


HEARD = st.builds(
    lambda unit, at, late, holds: Heard(unit, float(at), float(at + late), holds),
    st.integers(0, 1), st.integers(0, 8), st.sampled_from([0, 0, 1, 2, np.inf]),
    st.lists(st.frozensets(st.sampled_from([4, 1])), min_size=3, max_size=3).map(tuple),
)  # fmt: skip


@settings(max_examples=300, deadline=None)
@given(
    runs=st.lists(RUN, min_size=1, max_size=3),
    episodes=st.lists(st.tuples(st.integers(0, 8), st.integers(0, 8)), min_size=2, max_size=2),
    heard=st.lists(HEARD, max_size=16, unique_by=lambda one: (one.unit, one.captured_s)),
    confirm=st.sampled_from([(1, 1), (1, 3), (2, 2), (2, 3), (3, 5)]),
    count_earlier=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
    cuts=st.lists(st.floats(0, 1), max_size=5),
)
def test_as_the_sentences_have_it(
    runs: list[Any], episodes: list[tuple[int, int]], heard: list[Heard], confirm: tuple[int, int],
    count_earlier: bool, seed: int, cuts: list[float],
) -> None:  # fmt: skip
    objects = (4, 1)
    told = [[items(one) for one in run] for run in runs]
    lists, matches = listed(told)
    asked, issue_s, look_at = (
        Confirm(hits=confirm[0], of=confirm[1]),
        np.arange(9.0),
        dict(zip(objects, episodes, strict=True)),
    )
    turns = number_turns(tracks_of(heard))

    def detect(lists: ObjectLists, matches: Matches) -> Any:
        return first_matches(
            lists, matches, issue_s, episodes_of(look_at), confirm=asked, count_earlier=count_earlier, turns=turns,
            origins=origins_of(lists, issue_s, heard),
        )  # fmt: skip

    detections, steps = detect(lists, matches)
    for s, run in enumerate(told):
        for m, o in enumerate(objects):
            got = tuple(column[s, m] for column in detections)
            for e in [0.0, *EXISTENCE]:
                sure = plainly(run, s, o, look_at[o], heard, asked, count_earlier, e)
                assert asked_for(steps, s, m, e) == (sure and sure[0])
                if e == 0.0:
                    assert (got[2] < 0 and np.isnan(got[:2]).all()) if sure is None else got == sure
            mine = (steps.run_ix == s) & (steps.episode_ix == m)
            assert (np.diff(steps.existence[mine]) > 0).all()
            assert (np.diff(steps.detection_s[mine]) > 0).all()
    assert (np.diff(steps.run_ix * len(objects) + steps.episode_ix) >= 0).all()
    shuffled, moved, _ = permuted(lists, matches, np.random.default_rng(seed))
    assert moved is not None
    adding = FirstMatches(
        episodes_of(look_at), runs=len(told), confirm=asked, count_earlier=count_earlier, turns=turns
    )  # fmt: skip
    for a, b in chunks(cuts, 9):
        some, rows = between(lists, a, b)
        adding.add(some, taken(matches, rows), issue_s[a:b], origins_of(some, issue_s[a:b], heard))
    for again in (detect(shuffled, moved), adding.result()):
        for whole, other in zip((detections, steps), again, strict=True):
            for name in type(whole).__annotations__:
                np.testing.assert_array_equal(getattr(other, name), getattr(whole, name))
                assert getattr(other, name).dtype == getattr(whole, name).dtype


@pytest.mark.parametrize("cut", [1, 2, 3])
def test_what_confirms_may_lie_on_both_sides_of_a_cut(cut: int) -> None:
    run, issue_s = [[Item(7, 1.0, 0.6)], [Item(7, 2.0, 0.4)], [], [Item(7, 3.0, 0.9)]], np.array([1.0, 2.0, 2.5, 3.0])
    (lists, matches), heard = listed([run]), heard_of([run], issue_s.tolist())
    adding = FirstMatches(
        episodes_of({7: (0.0, 9.0)}), runs=1, confirm=Confirm(hits=2, of=3), count_earlier=False,
        turns=number_turns(tracks_of(heard)),
    )  # fmt: skip
    for a, b in ((0, cut), (cut, 4)):
        some, rows = between(lists, a, b)
        adding.add(some, taken(matches, rows), issue_s[a:b], origins_of(some, issue_s[a:b], heard))
    _, steps = adding.result()
    assert steps.existence.tolist() == [0.4, 0.6]
    assert steps.detection_s.tolist() == [2.0, 3.0]


def test_little_is_remembered_of_what_is_known() -> None:
    """However long it is looked at: of turns that make it no surer nothing is kept."""
    times = [float(t) for t in range(1, 200)]
    runs = [[[Item(7, t, 0.5 + (t % 10 == 0) * 0.3)] for t in times]] * 2
    (lists, matches), heard = listed(runs), heard_of(runs, times)
    adding = FirstMatches(
        episodes_of({7: (0.0, 999.0)}), runs=2, confirm=Confirm(hits=2, of=3), count_earlier=False,
        turns=number_turns(tracks_of(heard)),
    )  # fmt: skip
    adding.add(lists, matches, np.array(times), origins_of(lists, times, heard))
    # Of both runs every tenth turn, as an instant and as one of the unit.
    assert len(adding._held) == 2 * 2 * 19


def test_of_lists_about_one_object_the_newest_stands_then_that_of_the_first_unit() -> None:
    """The match is of before the onset; what else the list holds says since when the object is known, and by whom."""
    before = Item(7, 0.9, unit_ix=3)
    newer = [Item(7, 1.2, role=DUPLICATE, unit_ix=k) for k in (2, 1)]
    older = [Item(7, 1.1, role=DUPLICATE, unit_ix=0)]
    for order in ([before, *older, *newer], [before, *newer, *older], [*newer[::-1], *older, before]):
        assert found([order], [1.3], captured_s=[])[0] == (1.3, 1.2, 1)
