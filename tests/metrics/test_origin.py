"""Which objects an entry may be about: sentences of `metrics/origin.py` by hand, and all of them against an oracle."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from copem_replay.metrics.matching import DUPLICATE, GHOST, MATCH, match_entries
from copem_replay.metrics.origin import GoesBack, find_holding_lists, may_be_about
from tests.helpers.reports import entry, joined, lists_of
from tests.oracles.accuracy import scene_of, truth_of
from tests.oracles.origin import Heard, going_back, holding, origins_of

PAIR = {1: [(10.0, 0.0)], 2: [(12.0, 0.0)]}
"""Two people who walk 2 m apart."""


def holds(*objects: int) -> tuple[frozenset[int], ...]:
    return (frozenset(objects),)


def roles(entries: Any, heard: list[Heard], now_s: float = 1.0, **of: Any) -> list[tuple[int, int]]:
    """Object and role of each entry of one list."""
    lists, truth = lists_of([[entries]]), truth_of(PAIR, [now_s])
    scene = scene_of("car", "pedestrian", "pedestrian")
    found = match_entries(lists, truth, scene, origins_of(lists, [now_s], heard, **of), gate_m=3.0)
    return list(zip(found.object_ix.tolist(), found.role.tolist(), strict=True))


def person(x_m: float, **more: Any) -> Any:
    return entry(x_m, of="pedestrian", captured_s=1.0, **more)


def test_an_entry_is_not_about_a_neighbour_that_no_list_holds() -> None:
    """Its error takes it nearer to the second person; listed thrice it would make known whom nobody has seen."""
    heard = [Heard(0, 1.0, 1.0, holds(1))]
    assert roles(person(11.5), heard) == [(1, MATCH)]
    thrice = joined(*(person(11.5 + k / 10) for k in range(3)))
    assert sorted(roles(thrice, heard)) == [(1, MATCH), (1, DUPLICATE), (1, DUPLICATE)]
    assert roles(person(11.5), [Heard(0, 1.0, 1.0, holds(1, 2))]) == [(2, MATCH)]
    assert roles(person(11.5), [Heard(0, 1.0, 1.0, holds())]) == [(-1, GHOST)]
    assert roles(person(11.5), heard, to=GoesBack.UNKNOWN) == [(2, MATCH)]


def test_no_list_holds_the_receivers_own_body() -> None:
    heard = [Heard(0, 1.0, 1.0, holds(1, 2))]
    assert roles(person(11.5), heard, own_body_ix=2) == [(1, MATCH)]


def test_what_a_unit_has_missed_since_it_no_longer_holds() -> None:
    heard = [Heard(0, 0.8, 0.8, holds(2)), Heard(0, 1.0, 1.0, holds())]
    assert roles(person(12.0), heard) == [(-1, GHOST)]
    assert roles(person(12.0), heard, partial=[0]) == [(2, MATCH)]  # it leaves out what has not changed
    assert roles(person(12.0), heard, to=GoesBack.TO_ALL) == [(2, MATCH)]  # it may coast
    late = [heard[0], Heard(0, 1.0, 1.1, holds())]
    assert roles(person(12.0), late) == [(2, MATCH)]


@pytest.mark.parametrize(("max_age_s", "role"), [(0.5, MATCH), (0.49, GHOST)])
def test_a_list_is_in_use_for_its_greatest_age_from_its_arrival(max_age_s: float, role: int) -> None:
    heard = [Heard(0, 0.1, 0.5, holds(2)), Heard(1, 1.0, 1.0, holds())]
    assert roles(person(12.0), heard, max_age_s=max_age_s)[0][1] == role


def test_an_entry_with_a_truth_id_is_about_that_object() -> None:
    heard = [Heard(0, 1.0, 1.0, holds(1, 2))]
    assert roles(person(11.9), heard, own_ix=[1]) == [(1, MATCH)]
    assert roles(person(15.0), heard, own_ix=[1]) == [(-1, GHOST)]


HEARD = st.builds(
    lambda unit, at, late, held: Heard(unit, float(at), float(at + late), held),
    st.integers(0, 2), st.integers(0, 6), st.sampled_from([0, 0, 1, 2, np.inf]),
    st.lists(st.frozensets(st.integers(0, 3)), min_size=2, max_size=2).map(tuple),
)  # fmt: skip


@settings(max_examples=300, deadline=None)
@given(
    heard=st.lists(HEARD, max_size=18, unique_by=lambda one: (one.unit, one.captured_s)),
    captures=st.lists(st.tuples(st.integers(0, 6), st.integers(-1, 2)), min_size=1, max_size=4),
    to=st.sampled_from(list(GoesBack)),
    partial=st.frozensets(st.integers(0, 2)),
    max_age_s=st.sampled_from([0.5, 1.0, 3.0]),
    own=st.booleans(),
    since_s=st.sampled_from([-np.inf, 0.0, 2.0, 4.0]),
)
def test_the_lists_an_entry_goes_back_to(
    heard: list[Heard], captures: list[tuple[int, int]], to: GoesBack, partial: frozenset[int], max_age_s: float,
    own: bool, since_s: float,
) -> None:  # fmt: skip
    """The same entries in each of seven lists, in two runs, about each of four objects."""
    own &= to is GoesBack.TO_NEWEST  # a stack has no truth ids
    one = joined(*(entry(0, captured_s=float(t), unit_ix=u) for t, u in captures))
    lists, issue_s = lists_of([[one] * 7] * 2), [float(k) for k in range(7)]
    for o in range(4):
        own_ix = [o] * len(lists.entries) if own else []
        origins = origins_of(
            lists, issue_s, heard, max_age_s=max_age_s, partial=partial, to=to, own_ix=own_ix, own_body_ix=3
        )
        origins = origins._replace(entries=lists.entries.view(np.recarray))  # Python names fields of no other records
        for s, k, j in np.ndindex(2, 7, len(captures)):
            back = going_back(heard, captures[j][0], issue_s[k], max_age_s=max_age_s, partial=partial, to=to, own=own)
            since = [[a for a in of_unit if heard[a].captured_s >= since_s] for of_unit in back]
            expected = sorted(set(holding(heard, since, s, o, own))) if o != 3 else []
            if to is GoesBack.UNKNOWN:
                expected = sorted(a for of_unit in since for a in of_unit)
            i = int(lists.start[s, k]) + j
            count = find_holding_lists(origins, s, k, i, o, since_s, False)
            assert sorted(origins.holdings.frame[origins.holdings.holding[:count]].tolist()) == expected
            if since_s == -np.inf and to is not GoesBack.UNKNOWN and not own:
                assert may_be_about(origins, s, k, i, o) == bool(expected)
