"""Which true object an entry is about: the contract's sentences one by one, and a plain walk over random lists."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from copem_replay.core.object_list import Entries
from copem_replay.core.tracks import AGREE, CLASSES
from copem_replay.metrics.matching import DUPLICATE, GHOST, MATCH, Matches, match_entries
from tests.helpers.reports import entry, joined, lists_of
from tests.oracles.accuracy import likely, one_run, permuted, scene_of, truth_of
from tests.oracles.origin import unknown_origins

Found = list[tuple[int, int]]
GATE_M = 3.0


def of_one_list(*entries: Entries, objects: dict[tuple[float, float], str], gate_m: float = GATE_M) -> Found:
    """Object and role of each entry of one list; the objects, by place, are numbered from 0."""
    world = truth_of({o: [place] for o, place in enumerate(objects)}, [0.0])
    return pairs(
        match_entries(
            lists_of([[joined(*entries)]]),
            world,
            scene_of(*objects.values()),
            unknown_origins(lists_of([[joined(*entries)]])),
            gate_m=gate_m,
        )
    )


def pairs(found: Matches) -> Found:
    return list(zip(found.object_ix.tolist(), found.role.tolist(), strict=True))


def test_highest_existence_is_the_match_though_another_is_nearer() -> None:
    near, far = entry(0.1, existence=0.5), entry(2.0, existence=0.6)
    assert of_one_list(near, far, objects={(0, 0): "car"}) == [(0, DUPLICATE), (0, MATCH)]


@pytest.mark.parametrize(
    ("preferred", "other"),
    [
        ({"x_m": 1.0, "existence": 0.9}, {"captured_s": 2.0, "existence": 0.8}),
        ({"captured_s": 2.0, "unit_ix": 1, "cov": (4.0, 0.0, 4.0)}, {"captured_s": 1.0, "unit_ix": 0}),
        ({"cov": (1.0, 0.0, 1.9), "unit_ix": 1, "x_m": 1.0}, {"cov": (2.0, 0.9, 1.0), "unit_ix": 0}),
        ({"x_m": -0.5, "unit_ix": 1}, {"x_m": 0.4, "unit_ix": 0}),  # its place scattered: .141 and .887
        ({"x_m": 0.5, "unit_ix": 1}, {"x_m": 0.4, "unit_ix": 0}),  # .859
        ({"track_id": 3, "unit_ix": 1}, {"track_id": 7, "unit_ix": 0}),
    ],
)
def test_at_equal_existence_the_newest_then_the_surest_of_its_place_then_one_by_a_number_of_its_place(
    preferred: dict[str, Any], other: dict[str, Any]
) -> None:
    first, second = (entry(**{"x_m": 0.0, "existence": 0.7} | given) for given in (preferred, other))
    assert of_one_list(first, second, objects={(0, 0): "car"}) == [(0, MATCH), (0, DUPLICATE)]
    assert of_one_list(second, first, objects={(0, 0): "car"}) == [(0, DUPLICATE), (0, MATCH)]


def test_two_side_by_side_get_a_match_each_though_both_entries_are_nearer_to_one() -> None:
    objects = {(0.0, 0.0): "pedestrian", (0.0, 1.0): "pedestrian"}
    surer, other = (
        entry(0, 0.4, of="pedestrian", existence=0.9),
        entry(0, -0.1, of="pedestrian", existence=0.8),
    )
    assert of_one_list(surer, other, objects=objects) == [(0, MATCH), (1, MATCH)]


def test_only_the_preferred_of_the_rest_gets_the_free_object() -> None:
    objects = {(0.0, 0.0): "car", (0.0, 2.5): "car"}
    entries = [entry(0, y, existence=e) for y, e in ((0.0, 0.9), (1.0, 0.5), (0.1, 0.6), (1.1, 0.4))]
    assert of_one_list(*entries, objects=objects) == [(0, MATCH), (0, DUPLICATE), (1, MATCH), (0, DUPLICATE)]


def test_of_a_rest_of_two_the_preferred_comes_first_in_whatever_order_they_are_listed() -> None:
    objects = {(0.0, 0.0): "car", (0.0, 2.5): "car"}
    entries = [entry(0, y, existence=e) for y, e in ((0.0, 0.9), (1.0, 0.4), (0.1, 0.6))]
    assert of_one_list(*entries, objects=objects) == [(0, MATCH), (0, DUPLICATE), (1, MATCH)]


def test_a_copy_is_no_match_of_a_neighbour() -> None:
    """Of an entry that is listed three times one is the match: two that stand beside it would seem known."""
    objects = {(0.0, 0.0): "car", (2.0, 0.0): "car", (0.0, 2.0): "car"}
    thrice = [entry(0.1, existence=e) for e in (0.9, 0.9, 0.5)]
    assert sorted(of_one_list(*thrice, objects=objects)) == [(0, MATCH), (0, DUPLICATE), (0, DUPLICATE)]
    apart = [entry(0.1, existence=0.9), *(entry(0.2, existence=e) for e in (0.8, 0.7))]
    assert of_one_list(*apart, objects=objects) == [(0, MATCH), (1, MATCH), (1, DUPLICATE)]


def test_the_rest_take_the_nearest_object_that_is_free() -> None:
    objects = {(0.0, 0.0): "car", (1.0, 0.0): "car", (-1.5, 0.0): "car"}
    entries = [entry(0.0, existence=0.9), entry(0.1, existence=0.8), entry(0.2, existence=0.7)]
    assert of_one_list(*entries, objects=objects) == [(0, MATCH), (1, MATCH), (2, MATCH)]


def test_a_free_object_beyond_the_gate_is_not_taken() -> None:
    objects = {(0.0, 0.0): "car", (3.5, 0.0): "car"}
    entries = [entry(0.0, existence=0.9), entry(0.4, existence=0.8)]
    assert of_one_list(*entries, objects=objects) == [(0, MATCH), (0, DUPLICATE)]


def test_the_nearest_object_keeps_its_own_match() -> None:
    objects = {(0.0, 0.0): "car", (1.0, 0.0): "car"}
    entries = [entry(0.0, existence=0.9), entry(0.1, existence=0.8), entry(1.0, existence=0.1)]
    assert of_one_list(*entries, objects=objects) == [(0, MATCH), (0, DUPLICATE), (1, MATCH)]


@pytest.mark.parametrize(
    ("called", "true", "agree"),
    [
        ("pedestrian", "pedestrian", True),
        ("pedestrian", "car", False),
        ("car", "truck", False),
        ("other", "pedestrian", True),
        ("car", "other", True),
        ("vehicle", "truck", True),
        ("bus", "vehicle", True),
        ("vehicle", "pedestrian", False),
        ("vehicle", "bicycle", False),
    ],
)
def test_classes_agree(called: str, true: str, agree: bool) -> None:
    assert of_one_list(entry(0, of=called), objects={(0, 0): true}) == [(0, MATCH) if agree else (-1, GHOST)]


def test_the_most_probable_class_counts() -> None:
    shares = np.zeros(len(CLASSES))
    shares[[CLASSES.index("pedestrian"), CLASSES.index("car")]] = 0.4, 0.6
    unsure = entry(0, class_probability=shares)
    objects = {(1.0, 0.0): "pedestrian", (2.0, 0.0): "car"}
    assert of_one_list(unsure, objects=objects) == [(1, MATCH)]


@pytest.mark.parametrize("true", ["car", "pedestrian", "truck"])
def test_nothing_said_of_the_class_agrees_with_all(true: str) -> None:
    silent = entry(0, class_probability=np.zeros(len(CLASSES)))
    assert of_one_list(silent, objects={(0, 0): true}) == [(0, MATCH)]


@pytest.mark.parametrize(("x_m", "y_m"), [(3.0, 0.0), (-3.0, 0.0), (1.8, 2.4), (0.0, -3.0)])
def test_the_gate_holds_its_bound(x_m: float, y_m: float) -> None:
    objects = {(100.0, -50.0): "car"}
    assert of_one_list(entry(100 + x_m, y_m - 50), objects=objects) == [(0, MATCH)]
    assert of_one_list(entry(100 + x_m * (1 + 1e-6), y_m * (1 + 1e-6) - 50), objects=objects) == [(-1, GHOST)]


def test_an_entry_at_the_ego_or_at_something_standing_is_no_ghost_where_nothing_is_known_of_origin() -> None:
    objects = {(0.0, 0.0): "car", (20.0, 0.0): "truck"}  # the first is the ego
    assert of_one_list(entry(0.5), entry(21, of="truck"), objects=objects) == [(0, MATCH), (1, MATCH)]


def test_an_object_counts_only_at_instants_at_which_it_is_there() -> None:
    world = truth_of({0: [(0, 0), None, (50, 0)]}, [0.0, 1.0, 2.0])
    lists = lists_of([[entry(0), entry(0), joined(entry(0), entry(50))]])
    found = match_entries(lists, world, scene_of("car"), unknown_origins(lists), gate_m=GATE_M)
    assert pairs(found) == [(0, MATCH), (-1, GHOST), (-1, GHOST), (0, MATCH)]


def test_nothing_to_match() -> None:
    nobody = truth_of({}, [0.0, 1.0])
    assert pairs(
        match_entries(
            lists_of([[entry(0), joined()]]),
            nobody,
            scene_of(),
            unknown_origins(lists_of([[entry(0), joined()]])),
            gate_m=GATE_M,
        )
    ) == [(-1, GHOST)]
    one = truth_of({0: [(0, 0)]}, [0.0])
    assert (
        pairs(
            match_entries(
                lists_of([[joined()]]), one, scene_of("car"), unknown_origins(lists_of([[joined()]])), gate_m=GATE_M
            )
        )
        == []
    )
    no_instant = truth_of({}, [])
    assert (
        pairs(
            match_entries(
                lists_of([[], []]), no_instant, scene_of("car"), unknown_origins(lists_of([[], []])), gate_m=GATE_M
            )
        )
        == []
    )


def preference(e: Any) -> tuple[Any, ...]:
    scattered = math.modf(e["x_m"] * 7919.7182818 + e["y_m"] * 104729.3141593)[0] % 1
    spread = e["cov_ee_m2"] + e["cov_nn_m2"]
    return (-e["existence"], -e["captured_s"], spread, round(scattered, 9), e["track_id"], likely(e), e["unit_ix"])


def by_the_rules(entries: Entries, within: Callable[[int, set[int]], list[int]], everybody: set[int]) -> Found:
    """One list by the three rules of the module; `within`: of some objects those in an entry's gate, by distance."""

    def is_copy(i: int, of: Iterable[int]) -> bool:
        return any(all(entries[i][axis] == entries[j][axis] for axis in ("x_m", "y_m")) for j in of)

    order = sorted(range(len(entries)), key=lambda i: preference(entries[i]))
    belongs = {i: near[0] for i in order if (near := within(i, everybody))}
    match_of: dict[int, int] = {}
    for i, o in belongs.items():
        match_of.setdefault(o, i)
    matched, free = {i: o for o, i in match_of.items()}, everybody - set(match_of)
    rest = [i for i in belongs if i not in matched and within(i, free) and not is_copy(i, [match_of[belongs[i]]])]
    for place, i in enumerate(rest):
        if (near := within(i, free)) and not is_copy(i, rest[:place]):
            matched[i] = near[0]
            free.remove(near[0])
    return [
        (matched[i], MATCH) if i in matched else (belongs[i], DUPLICATE) if i in belongs else (-1, GHOST)
        for i in range(len(entries))
    ]


def plainly(entries: Entries, objects: dict[int, tuple[float, float]], classes: list[str], gate_m: float) -> Found:
    """One list whose entries tell of one instant."""

    def within(i: int, among: set[int]) -> list[int]:
        e = entries[i]
        fits = [o for o in among if AGREE[likely(e), CLASSES.index(classes[o])]]
        away = {o: np.hypot(e["x_m"] - objects[o][0], e["y_m"] - objects[o][1]) for o in fits}
        return sorted((o for o in fits if away[o] <= gate_m + 1e-9), key=lambda o: (away[o], objects[o][0], o))

    return by_the_rules(entries, within, set(objects))


PLACE = st.tuples(st.integers(-3, 3), st.integers(-3, 3))
KIND = st.sampled_from(["pedestrian", "car", "truck", "vehicle", "other"])
THING = st.tuples(PLACE, KIND)
LISTED = st.tuples(PLACE, KIND, st.sampled_from([0.3, 0.6, 1.0]), st.integers(-1, 1))
"""Whole metres and few values, so that ties of all kinds are the rule."""


@given(
    things=st.lists(st.tuples(KIND, st.lists(st.none() | PLACE, min_size=2, max_size=2)), max_size=6),
    runs=st.lists(st.lists(st.lists(LISTED, max_size=8), min_size=2, max_size=2), min_size=1, max_size=3),
    gate_m=st.sampled_from([1.0, 2.0, 2.5]),
    seed=st.integers(0, 2**32 - 1),
)
def test_lists_as_the_rules_have_it(
    things: list[tuple[str, list[tuple[int, int] | None]]], runs: list[Any], gate_m: float, seed: int
) -> None:
    classes = [kind for kind, _ in things]
    world = truth_of({o: places for o, (_, places) in reversed(list(enumerate(things)))}, [0.0, 1.0])
    lists = lists_of(
        [
            [joined(*(entry(*at, of=of, existence=p, unit_ix=u) for at, of, p, u in one)) for one in of_run]
            for of_run in runs
        ]
    )
    scene = scene_of(*classes)
    found = match_entries(lists, world, scene, unknown_origins(lists), gate_m=gate_m)
    for s in range(len(runs)):
        for k in (0, 1):
            objects = {o: at for o, (_, places) in enumerate(things) if (at := places[k]) is not None}
            of_list = slice(lists.start[s, k], lists.start[s, k + 1])
            assert pairs(found)[of_list] == plainly(lists.of(s, k), objects, classes, gate_m)
        alone, its = one_run(lists, s)
        assert pairs(match_entries(alone, world, scene, unknown_origins(alone), gate_m=gate_m)) == pairs(found)[its]
    # Equal entries may change places: they are told apart by nothing.
    shuffled, _, _ = permuted(lists, None, np.random.default_rng(seed))
    again = match_entries(shuffled, world, scene, unknown_origins(shuffled), gate_m=gate_m)

    def as_sets(entries: Entries, what: Found) -> list[list[tuple[Any, ...]]]:
        told = [(*preference(e), *w) for e, w in zip(entries, what, strict=True)]
        return [sorted(told[a:b]) for start in lists.start for a, b in pairwise(start)]

    assert as_sets(shuffled.entries, pairs(again)) == as_sets(lists.entries, pairs(found))
