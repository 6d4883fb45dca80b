"""First detections against loops written from the contract's sentences, and against what the ideal fusion lists."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from statistics import median
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from copem_replay.communication.arrivals import fusion_schedule
from copem_replay.core.tracks import VALUES, Tracks
from copem_replay.fusion.ideal import fuse_ideal
from copem_replay.metrics.config import Confirm
from copem_replay.metrics.detection.by_match import FirstMatches
from copem_replay.metrics.detection.by_truth_id import FirstDetections, detect_by_truth_id
from copem_replay.metrics.detection.turns import number_turns
from copem_replay.metrics.episodes import Episodes
from copem_replay.metrics.matching import MATCH
from copem_replay.metrics.origin import GoesBack, OriginLists, Origins
from copem_replay.pipeline.receiver import convert_to_lists
from tests.helpers.drawn import examples
from tests.oracles.accuracy import episodes_of, matches_of, scene_of
from tests.oracles.origin import Heard, numbered

NEVER = None
Held = frozenset[tuple[int, int]]
"""Which (run, object) a list holds."""


@dataclass(frozen=True)
class Unit:
    """A unit's lists: captured when and holding what, in milliseconds; all arrive `latency` later."""

    latency: int
    lists: tuple[tuple[int, Held], ...]
    candidates: frozenset[int] = frozenset((0, 1))


@dataclass(frozen=True)
class World:
    """Units in the experiment's order, and from when to when each object is looked at."""

    units: dict[str, Unit]
    episodes: dict[int, tuple[int, int]]
    runs: int = 1
    hits: int = 1
    of: int = 1
    count_earlier: bool = False
    max_age: int = 1000


@dataclass(frozen=True)
class Found:
    """A detection in milliseconds."""

    at: int
    captured: int
    first_unit: str


def tracks(world: World) -> Tracks:
    """The lists as tracks."""
    start, unit_ix, object_ix, frame_ix, valid = [0], [], [], [], []
    frames = [(u, k) for u, unit in enumerate(world.units.values()) for k in range(len(unit.lists))]
    for u, unit in enumerate(world.units.values()):
        for o in sorted(unit.candidates):
            if not unit.lists:
                continue
            for k, (_, held) in enumerate(unit.lists):
                frame_ix.append(frames.index((u, k)))
                valid.append([(run, o) in held for run in range(world.runs)])
            start.append(len(frame_ix))
            unit_ix.append(u)
            object_ix.append(o)
    units = list(world.units.values())
    captured = np.array([units[u].lists[k][0] for u, k in frames], dtype=np.int64)
    latency_s = np.array([units[u].latency for u, _ in frames]) / 1000
    values: dict[str, Any] = {name: np.zeros((1, len(frame_ix))) for name in VALUES}
    return Tracks(
        units=tuple(world.units),
        start=np.array(start),
        unit_ix=np.array(unit_ix, dtype=int),
        object_ix=np.array(object_ix, dtype=int),
        frame_ix=np.array(frame_ix, dtype=int),
        stamp_ns=captured * 1_000_000,
        captured_s=captured / 1000,
        frame_unit_ix=np.array([u for u, _ in frames], dtype=int),
        arrives_s=(captured / 1000 + latency_s)[None],
        valid=np.array(valid, dtype=bool).reshape(len(frame_ix), world.runs).T.copy(),
        **values,
    )


def episodes(world: World) -> Episodes:
    return episodes_of({name: (onset / 1000, end / 1000) for name, (onset, end) in world.episodes.items()})


def detected(world: World, received: Tracks | None = None) -> dict[tuple[int, int], Found | None]:
    """What `detect` says for each run and object, in milliseconds."""
    result = detect_by_truth_id(
        tracks(world) if received is None else received,
        episodes(world),
        confirm=Confirm(hits=world.hits, of=world.of),
        count_earlier=world.count_earlier,
        max_age_s=world.max_age / 1000,
    )
    found: dict[tuple[int, int], Found | None] = {}
    for m, o in enumerate(world.episodes):
        for run in range(world.runs):
            at, captured = result.detection_s[run, m], result.captured_s[run, m]
            unit = int(result.first_unit_ix[run, m])
            assert np.isnan(at) == np.isnan(captured) == (unit < 0)
            ms = [round(float(t) * 1000) for t in (at, captured)] if unit >= 0 else []
            assert np.allclose([at, captured], np.array(ms or [np.nan] * 2) / 1000, atol=2e-6, equal_nan=True)
            found[run, o] = Found(ms[0], ms[1], list(world.units)[unit]) if ms else NEVER
    return found


def instants_of(world: World) -> dict[tuple[str, int], int]:
    """The capture instant of each list: captures of several units within half a list period are one."""
    periods = [
        median(b[0] - a[0] for a, b in pairwise(unit.lists)) for unit in world.units.values() if len(unit.lists) > 1
    ]
    captures = sorted(
        (t, u, name, k) for u, (name, unit) in enumerate(world.units.items()) for k, (t, _) in enumerate(unit.lists)
    )
    instants: list[list[tuple[int, str, int]]] = []
    for t, _, name, k in captures:
        joins = instants and t - instants[-1][0][0] <= min(periods, default=0) / 2
        if joins and name not in [other for _, other, _ in instants[-1]]:
            instants[-1].append((t, name, k))
        else:
            instants.append([(t, name, k)])
    return {(name, k): i for i, members in enumerate(instants) for _, name, k in members}


def confirmed(places: set[int], hits: int, of: int) -> bool:
    """Do `of` places in a row hold `hits` of these?"""
    return any(len([p for p in places if first <= p < first + of]) >= hits for first in places)


def plainly(world: World) -> dict[tuple[int, int], Found | None]:
    """Walk through the instants of arrival, run by run and object by object."""
    instant_of = instants_of(world)
    result: dict[tuple[int, int], Found | None] = {}
    for o, (onset, end) in world.episodes.items():
        for run in range(world.runs):
            result[run, o] = NEVER
            holding: list[tuple[int, int, str, int]] = []  # arrived, unit's place, unit, list
            for now in sorted({t + unit.latency for unit in world.units.values() for t, _ in unit.lists}):
                if now > end:
                    break  # we stop looking
                for u, (name, unit) in enumerate(world.units.items()):
                    for k, (t, held) in enumerate(unit.lists):
                        counts = t >= onset or world.count_earlier
                        if t + unit.latency == now and (run, o) in held and counts:
                            holding.append((now, u, name, k))
                if not any(arrived == now for arrived, *_ in holding):
                    continue
                together = confirmed({instant_of[name, k] for *_, name, k in holding}, world.hits, world.of)
                alone = any(
                    confirmed({k for *_, other, k in holding if other == name}, world.hits, world.of)
                    for name in world.units
                )
                if not (together or alone):
                    continue
                contributing = []
                for u, (name, unit) in enumerate(world.units.items()):
                    arrived = [(t, held) for t, held in unit.lists if t + unit.latency <= now]
                    if arrived and now - arrived[-1][0] <= world.max_age + unit.latency and (run, o) in arrived[-1][1]:
                        contributing.append((-arrived[-1][0], u, name))
                newest, _, first = min(contributing)
                result[run, o] = Found(now, -newest, first)
                break
    return result


def holds(*objects: int) -> Held:
    """Held in the first run."""
    return frozenset((0, o) for o in objects)


def at_rate(period: int, held: str, latency: int = 0, first: int = 0) -> Unit:
    """Lists every `period`; `x` where they hold object 0."""
    says = {"x": holds(0), ".": holds()}
    return Unit(latency, tuple((first + k * period, says[mark]) for k, mark in enumerate(held)))


class TestByHand:
    @pytest.mark.parametrize(
        ("onset", "end", "latency", "expected"),
        [
            (0, 900, 0, 300),
            (0, 900, 250, 550),
            (300, 900, 0, 300),  # captured at the onset
            (301, 900, 0, 400),
            (0, 550, 250, 550),  # arrives just in time
            (0, 549, 250, NEVER),
            (600, 900, 0, NEVER),
        ],
    )
    def test_one_unit(self, onset: int, end: int, latency: int, expected: int | None) -> None:
        """Lists every 0.1 s; those of 0.3, 0.4 and 0.5 s hold the object."""
        world = World({"ego": at_rate(100, "...xxx....", latency)}, {0: (onset, end)})
        captured = -1 if expected is None else expected - latency
        assert detected(world) == {(0, 0): expected and Found(expected, captured, "ego")}

    def test_what_was_captured_before_the_onset_counts_when_asked(self) -> None:
        world = World({"ego": at_rate(100, ".x....", latency=50)}, {0: (200, 900)})
        assert detected(world) == {(0, 0): NEVER}
        assert detected(replace(world, count_earlier=True)) == {(0, 0): Found(150, 100, "ego")}

    def test_it_is_the_list_that_must_be_captured_after_the_onset_not_arrive(self) -> None:
        world = World({"ego": at_rate(100, ".xx...", latency=50)}, {0: (120, 900)})
        assert detected(world) == {(0, 0): Found(250, 200, "ego")}

    def test_the_first_unit_is_that_of_the_newest_list_then_by_order(self) -> None:
        ego, mast = at_rate(100, "..x...", latency=100), at_rate(100, "...x..")
        for order in ({"ego": ego, "mast": mast}, {"mast": mast, "ego": ego}):
            assert detected(World(order, {0: (0, 900)})) == {(0, 0): Found(300, 300, "mast")}
        early = replace(mast, latency=99)
        assert detected(World({"mast": early, "ego": ego}, {0: (0, 900)})) == {(0, 0): Found(300, 200, "ego")}
        also = at_rate(100, "..x...", latency=100)
        assert detected(World({"van": also, "ego": ego}, {0: (0, 900)})) == {(0, 0): Found(300, 200, "van")}

    @pytest.mark.parametrize("offset_us", [0.0, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8])
    def test_arrivals_within_a_microsecond_are_one_instant(self, offset_us: float) -> None:
        """The later of two, by 0.4 µs, belongs to the unit that comes first in the experiment."""
        world = World({"ego": at_rate(100, ".x"), "mast": at_rate(100, ".x")}, {0: (0, 900)})
        received = tracks(world)
        moved = received.arrives_s + offset_us * 1e-6 + 0.4e-6 * (received.frame_unit_ix == 0)
        assert detected(world, replace(received, arrives_s=moved)) == {(0, 0): Found(100, 100, "ego")}

    def test_lost_lists_never_arrive(self) -> None:
        world = World({"ego": at_rate(100, ".xxx..")}, {0: (0, 900)})
        received = tracks(world)
        lost = np.where(received.captured_s == 0.1, np.inf, received.arrives_s)
        assert detected(world, replace(received, arrives_s=lost)) == {(0, 0): Found(200, 200, "ego")}
        assert detected(world, replace(received, arrives_s=np.full_like(lost, np.inf))) == {(0, 0): NEVER}

    def test_who_has_no_truth_id_is_nobody(self) -> None:
        """`object_ix = -1` means: no truth id."""
        world = World({"ego": at_rate(100, "xxx")}, {0: (0, 900), 1: (0, 900)})
        received = tracks(world)
        assert detected(world, replace(received, object_ix=np.array([-1, -1]))) == {(0, 0): NEVER, (0, 1): NEVER}

    def test_nothing_to_hear_and_nothing_to_look_at(self) -> None:
        assert detected(World({"ego": Unit(0, ()), "mast": Unit(0, ())}, {0: (0, 900)})) == {(0, 0): NEVER}
        assert detected(World({"ego": at_rate(100, "xxx")}, {})) == {}


class TestConfirmed:
    @pytest.mark.parametrize(
        ("held", "hits", "of", "expected"),
        [
            ("...x.xx..x", 1, 1, 300),
            ("...x.xx..x", 2, 2, 600),
            ("...x.xx..x", 2, 3, 500),
            ("...x.xx..x", 3, 3, NEVER),
            ("...x.xx..x", 3, 4, 600),
            ("x..x..x..x", 2, 3, NEVER),
            ("x..x..x..x", 2, 4, 300),
            ("xx........", 2, 2, 100),
        ],
    )
    def test_by_one_unit(self, held: str, hits: int, of: int, expected: int | None) -> None:
        world = World({"ego": at_rate(100, held)}, {0: (0, 900)}, hits=hits, of=of)
        assert detected(world) == {(0, 0): expected and Found(expected, expected, "ego")}

    def test_hits_before_the_onset_do_not_count(self) -> None:
        world = World({"ego": at_rate(100, "..xx.x.x")}, {0: (300, 900)}, hits=2, of=3)
        assert detected(world) == {(0, 0): Found(500, 500, "ego")}
        assert detected(replace(world, count_earlier=True)) == {(0, 0): Found(300, 300, "ego")}

    def test_captures_count_not_messages(self) -> None:
        """Two units see it 20 ms apart: that is one capture instant, not two hits of two; the next are."""
        both = {"ego": at_rate(100, "..x..."), "mast": at_rate(100, "..x...", first=20)}
        world = World(both, {0: (0, 900)}, hits=2, of=2)
        assert detected(world) == {(0, 0): NEVER}
        world = replace(world, units=world.units | {"mast": at_rate(100, "...x..", first=20)})
        assert detected(world) == {(0, 0): Found(320, 320, "mast")}

    @pytest.mark.parametrize(("apart", "of_b"), [(0, [0, 1, 2]), (49, [0, 1, 2]), (50, [0, 1, 2]), (51, [1, 2, 3])])
    def test_half_a_list_period(self, apart: int, of_b: list[int]) -> None:
        """51 ms after one list of the other is 49 ms before its next."""
        world = World({"a": at_rate(100, "...."), "b": at_rate(100, "...", first=apart)}, {})
        a, b = np.split(number_turns(tracks(world)).list_instant, [4])
        assert (a.tolist(), b.tolist()) == ([0, 1, 2, 3], of_b)

    def test_the_shortest_period_decides(self) -> None:
        """Every 0.1 s and every 1 s: within 50 ms is one."""
        world = World({"a": at_rate(100, "." * 11), "b": at_rate(1000, "..", first=30)}, {})
        a, b = np.split(number_turns(tracks(world)).list_instant, [11])
        assert (a.tolist(), b.tolist()) == ([*range(11)], [0, 10])

    def test_two_captures_of_one_unit_are_two(self) -> None:
        """Its lists jitter: 30 ms instead of 100. Still each list is a capture of its own."""
        lists = tuple((t, holds()) for t in (0, 100, 200, 230, 300, 400, 500))
        assert len(set(number_turns(tracks(World({"a": Unit(0, lists)}, {}))).list_instant.tolist())) == 7

    def test_jitter_does_not_confirm_for_one_what_it_does_not_for_two(self) -> None:
        """Held at 0 and 0.13 s but not at 0.1 s: no two in a row, with a second unit that sees nothing or without."""
        jitter = Unit(0, tuple((t, holds(0) if t in (0, 130) else holds()) for t in (0, 100, 130, 230, 330, 430)))
        world = World({"a": jitter}, {0: (0, 900)}, hits=2, of=2)
        assert detected(world) == {(0, 0): NEVER}
        assert detected(replace(world, units={"a": jitter, "b": at_rate(100, "....", first=60)})) == {(0, 0): NEVER}

    def test_a_late_list_confirms_what_was_seen_earlier(self) -> None:
        """The ego holds it at 0.3 s; the mast's list of 0.2 s, late, at 0.6 s makes two of two in a row."""
        world = World({"ego": at_rate(100, "...x......"), "mast": at_rate(100, "..x.......", 400)}, {0: (0, 900)},
                      hits=2, of=2)  # fmt: skip
        assert detected(world) == {(0, 0): Found(600, 200, "mast")}

    def test_of_a_unit_alone_a_list_that_never_arrives_is_no_capture(self) -> None:
        """The ego's list of 0.2 s is lost: those of 0.0, 0.1 and 0.3 s are three in a row, and two of them hold it.

        With the mast, which lists nothing, they are four capture instants.
        """
        world = World({"ego": at_rate(100, "x..x.."), "mast": at_rate(100, "......")}, {0: (0, 900)}, hits=2, of=3)
        received = tracks(world)
        lost = np.where((received.captured_s == 0.2) & (received.frame_unit_ix == 0), np.inf, received.arrives_s)
        assert detected(world, replace(received, arrives_s=lost)) == {(0, 0): Found(300, 300, "ego")}
        assert detected(world) == {(0, 0): NEVER}

    def test_every_list_counts_when_it_is_taken_in(self) -> None:
        """Lists of 0.1 to 0.5 s come in at 0.5 s, and the newest does not hold it; that of 0.6 s is overtaken."""
        world = World({"ego": at_rate(100, "..x...x.")}, {0: (50, 900), 1: (250, 900)})
        received = tracks(world)
        late_s = np.array([[0.0, 0.5, 0.5, 0.5, 0.5, 0.5, 0.9, 0.7]])
        assert detected(world, replace(received, arrives_s=late_s)) == {(0, 0): Found(500, 200, "ego"), (0, 1): NEVER}
        after = replace(world, episodes={0: (250, 900)})
        assert detected(after, replace(received, arrives_s=late_s)) == {(0, 0): Found(900, 600, "ego")}

    def test_what_is_taken_in_together_is_one_turn(self) -> None:
        """Lists of 0.1 to 0.5 s come in at 0.5 s, those of 0.6 and 0.7 s at 0.9 s: the third of three is the first."""
        world = World({"ego": at_rate(100, "..x.x..x")}, {0: (0, 900)}, hits=2, of=2)
        at_once_s = np.array([[0.0, 0.5, 0.5, 0.5, 0.5, 0.5, 0.9, 0.9]])
        received = replace(tracks(world), arrives_s=at_once_s)
        assert number_turns(received).turn.tolist() == [0, 1, 1, 1, 1, 1, 2, 2]
        assert detected(world, received) == {(0, 0): Found(900, 700, "ego")}
        assert detected(replace(world, hits=1, of=1), received) == {(0, 0): Found(500, 400, "ego")}

    def test_a_list_exactly_at_its_greatest_age_still_contributes(self) -> None:
        """The ego's only list, of 0.5 s, is 0.4 s old when the mast's of 0.4 s arrives at 0.9 s: not too old."""
        ego = Unit(0, ((500, holds(0)),))
        world = World({"ego": ego, "mast": at_rate(100, "....x.....", 500)}, {0: (0, 5000)}, hits=2, of=2, max_age=400)
        assert detected(world) == {(0, 0): Found(900, 500, "ego")}
        assert detected(replace(world, max_age=399)) == {(0, 0): Found(900, 400, "mast")}


TICK = 10
"""Milliseconds: all instants are multiples, so that many coincide and the others are far apart."""


@st.composite
def units(draw: st.DrawFn, runs: int) -> Unit:
    """Lists at a rate, some missing, some early or late; what they hold is up to chance."""
    period, first = draw(st.integers(1, 10)), draw(st.integers(0, 10))
    ticks = {first + k * period + draw(st.sampled_from([0, 0, 0, 1, -1, 3])) for k in range(draw(st.integers(0, 8)))}
    members = st.sampled_from([(run, o) for run in range(runs) for o in (0, 1)])
    lists = tuple((t * TICK, draw(st.frozensets(members))) for t in sorted(ticks))
    return Unit(draw(st.integers(0, 12)) * TICK, lists)


@st.composite
def worlds(draw: st.DrawFn, confirm: bool = True) -> World:
    names = draw(st.sampled_from([("ego",), ("ego", "mast"), ("van", "ego", "mast")]))
    of = draw(st.integers(1, 4)) if confirm else 1
    measured = draw(st.sampled_from([(0,), (1,), (0, 1)]))
    return World(
        units={name: draw(units(runs=2)) for name in names},
        episodes={o: (draw(st.integers(0, 60)) * TICK, draw(st.integers(0, 110)) * TICK) for o in measured},
        runs=2,
        hits=draw(st.integers(1, of)),
        of=of,
        count_earlier=draw(st.booleans()),
        max_age=draw(st.sampled_from([1, 10, 30, 100])) * TICK,
    )


@settings(max_examples=examples(600), deadline=None)
@given(worlds())
def test_against_the_oracle(world: World) -> None:
    assert detected(world) == plainly(world)


@settings(deadline=None)
@given(worlds())
def test_capture_instants_against_the_oracle(world: World) -> None:
    expected = instants_of(world)
    frames = [(name, k) for name, unit in world.units.items() for k in range(len(unit.lists))]
    assert number_turns(tracks(world)).list_instant.tolist() == [expected[frame] for frame in frames]


@settings(max_examples=examples(300), deadline=None)
@given(worlds(confirm=False))
def test_detected_when_the_ideal_fusion_first_lists_it(world: World) -> None:
    """From what was captured at or after the onset, as long as we look; nothing is left to confirm."""
    received = tracks(world)
    for o, (onset, end) in world.episodes.items():
        counted = (received.row_captured_s >= onset / 1000 - 1e-6) | world.count_earlier
        fused = fuse_ideal(replace(received, valid=received.valid & counted), max_age_s=world.max_age / 1000).fused
        for run in range(world.runs):
            rows = np.flatnonzero((fused.row_object_ix == o) & fused.valid[run])
            times = fused.arrives_s[0, fused.frame_ix[rows]]
            times = times[times <= end / 1000 + 1e-6]
            found = detected(world)[run, o]
            assert (found is None) == (len(times) == 0)
            if found is not None:
                assert found.at / 1000 == pytest.approx(times.min())


def by_match(world: World, received: Tracks) -> FirstDetections:
    """The detections in the lists of ideal fusion, read like those of any other fusion."""
    max_age_s, nobody = world.max_age / 1000, np.zeros(len(received.units), dtype=bool)
    scene = scene_of("car", "car", "car")
    fused, own = convert_to_lists(fuse_ideal(received, max_age_s=max_age_s), scene)
    of = OriginLists(received, received, GoesBack.TO_NEWEST, max_age_s, nobody, -1)
    issue_s = fusion_schedule(received, max_age_s=max_age_s).issue_s
    known = FirstMatches(
        episodes(world), runs=world.runs, confirm=Confirm(hits=world.hits, of=world.of),
        count_earlier=world.count_earlier, turns=number_turns(received),
    )  # fmt: skip
    matches = matches_of(own.tolist(), [MATCH] * len(own))
    known.add(fused, matches, issue_s, Origins(fused.entries, own, of.find_holdings(issue_s)))
    return known.result()[0]


@settings(max_examples=examples(600), deadline=None)
@given(worlds(), st.data())
def test_the_fast_path_finds_what_is_in_the_lists_of_ideal_fusion(world: World, data: st.DataObject) -> None:
    """However lists are late, lost, overtaken, or taken in together."""
    received = tracks(world)
    late = st.sampled_from([0, 0, TICK, 3 * TICK, 12 * TICK, np.inf])
    later_s = np.array([[data.draw(late) / 1000 for _ in received.stamp_ns]]).reshape(1, -1)
    tick_s = data.draw(st.sampled_from([0, 5, 20])) * TICK / 1000
    arrives_s = received.arrives_s + later_s
    if tick_s:
        arrives_s = np.ceil(arrives_s / tick_s - 1e-9) * tick_s
    received = replace(received, arrives_s=arrives_s)
    fast = detect_by_truth_id(
        received, episodes(world), confirm=Confirm(hits=world.hits, of=world.of), count_earlier=world.count_earlier,
        max_age_s=world.max_age / 1000,
    )  # fmt: skip
    for column, of_lists in zip(fast, by_match(world, received), strict=True):
        np.testing.assert_allclose(column, of_lists, rtol=0, atol=1e-6)  # arrivals within 1 µs are one instant


@settings(max_examples=examples(), deadline=None)
@given(worlds(), st.data())
def test_turns_against_the_oracle(world: World, data: st.DataObject) -> None:
    received = tracks(world)
    late = st.sampled_from([0, 0, TICK, 3 * TICK, 12 * TICK, np.inf])
    arrives_s = received.arrives_s + np.array([[data.draw(late) / 1000 for _ in received.stamp_ns]]).reshape(1, -1)
    turns = number_turns(replace(received, arrives_s=arrives_s))
    columns = zip(received.frame_unit_ix.tolist(), received.captured_s.tolist(), arrives_s[0].tolist(), strict=True)
    turn, instant = numbered([Heard(*column, (frozenset(),)) for column in columns])
    first = {u: int(np.searchsorted(turns.unit_ix, u)) for u, _ in turn}
    for f in np.flatnonzero(np.isfinite(arrives_s[0])):
        assert (turns.turn[f], turns.list_instant[f]) == (first[turn[f][0]] + turn[f][1], instant[f])


@settings(max_examples=examples(300), deadline=None)
@given(worlds(), st.data())
def test_another_unit_never_delays(world: World, data: st.DataObject) -> None:
    """What one unit alone confirms is confirmed with others too, and not later: with equal latencies or any."""
    alone = data.draw(st.sampled_from(list(world.units)))
    by_one = detected(replace(world, units={alone: world.units[alone]}))
    by_all = detected(world)
    for key, found in by_one.items():
        together = by_all[key]
        assert found is None or (together is not None and together.at <= found.at)


@settings(deadline=None)
@given(worlds(confirm=False), st.integers(0, 40))
def test_latency_moves_every_detection_by_itself(world: World, more: int) -> None:
    """All lists `more` later, and looked at as much longer: so are all detections, and nothing else changes."""
    later = replace(
        world,
        units={name: replace(unit, latency=unit.latency + more * TICK) for name, unit in world.units.items()},
        episodes={o: (onset, end + more * TICK) for o, (onset, end) in world.episodes.items()},
    )
    moved = {key: found and replace(found, at=found.at + more * TICK) for key, found in detected(world).items()}
    assert detected(later) == moved
