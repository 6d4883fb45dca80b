"""The union of all lists by hand."""

import numpy as np
import pytest
from pydantic import ValidationError

from copem_replay.core.object_list import entries_of
from copem_replay.fusion.union import Union
from tests.helpers.reports import entry, inputs_of, joined
from tests.oracles.gnn import in_any_order, random_reports

NONE = entries_of(0)


def test_entries_of_all_newest_lists_stand_side_by_side_as_they_are():
    mine = joined(entry(1.0, existence=0.9, track_id=7), entry(2.0, of="pedestrian", track_id=8))
    yours = entry(1.0, cov=(4.0, 1.0, 2.0), track_id=7)
    fused = Union().fuse(inputs_of([[mine, yours]], ["a", "b"], [0.1, 0.2], [0.3, 0.3]))
    expected = joined(mine, yours)
    expected["captured_s"], expected["unit_ix"] = [0.1, 0.1, 0.2], [0, 0, 1]
    expected["track_id"] = [7, 8, 7 ^ (2**63 - 7046029254386353131)]  # the two 7 have nothing to do with each other
    assert fused.start.tolist() == [[0, 3]]
    assert in_any_order(fused.entries) == in_any_order(expected)


def test_an_id_that_a_list_has_twice_says_nothing():
    twice = joined(entry(1.0, track_id=7), entry(2.0, track_id=8), entry(3.0, track_id=7))
    lists = [twice, entry(4.0, track_id=7)]
    fused = Union().fuse(inputs_of([lists], ["a", "a"], [0.0, 0.1], [0.0, 0.1]))
    assert dict(zip(fused.of(0, 0)["x_m"].tolist(), fused.of(0, 0)["track_id"].tolist(), strict=True)) == {
        1.0: -1, 2.0: 8, 3.0: -1,
    }  # fmt: skip
    assert fused.of(0, 1)["track_id"].tolist() == [7]


def test_what_was_reported_stays_as_it_was():
    inputs = inputs_of([[entry(1.0, track_id=7)]], ["a"], [0.0], [0.0])
    Union().fuse(inputs)
    assert inputs.lists.entries["track_id"].tolist() == [7]


def test_of_each_unit_the_newest_list_counts_until_it_is_too_old():
    lists = [entry(0.0), entry(10.0), entry(1.0), entry(2.0)]
    # At 0.5 the second list of `a` is 0.4 s old, at 2.0 the one of `b` 1.9 s.
    inputs = inputs_of([lists], ["a", "b", "a", "a"], [0.0, 0.1, 0.5, 2.0], [0.0, 0.1, 0.5, 2.0])
    fused = Union().fuse(inputs)
    assert [sorted(fused.of(0, k)["x_m"]) for k in range(4)] == [[0.0], [0.0, 10.0], [1.0, 10.0], [2.0]]


def test_entries_less_likely_than_asked_for_are_left_out():
    lists = [joined(entry(0.0, existence=0.49), entry(1.0, existence=0.5)), entry(2.0, existence=0.1)]
    inputs = inputs_of([lists], ["a", "b"], [0.0, 0.0], [0.0, 0.0])
    assert Union(min_existence=0.5).fuse(inputs).entries["x_m"].tolist() == [1.0]
    assert sorted(Union().fuse(inputs).entries["x_m"]) == [0.0, 1.0, 2.0]


def test_lists_without_entries_and_no_lists_at_all():
    empty = Union().fuse(inputs_of([[NONE, NONE]] * 3, ["a", "b"], [0.0, 0.1], [0.0, 0.1]))
    assert empty.start.tolist() == [[0, 0, 0]] * 3
    assert len(empty.entries) == 0
    never = Union().fuse(inputs_of([[entry(0.0)], [entry(0.0)]], ["a"], [0.0], [np.inf]))
    assert never.start.tolist() == [[0], [0]]
    assert len(Union().fuse(inputs_of([[], []], [], [], [], names=["a"])).entries) == 0


def test_every_run_has_its_own_lists():
    inputs = random_reports(1, units=3, objects=4, captures=3, runs=3)
    fused = Union().fuse(inputs)
    assert fused.start.shape == (3, len(inputs.issue_s) + 1)
    assert fused.start[0, 0] == 0
    assert (fused.start[1:, 0] == fused.start[:-1, -1]).all()
    assert fused.start[-1, -1] == len(fused.entries)
    for run in range(3):
        for k, newest in enumerate(inputs.newest):
            expected = joined(*(inputs.lists.of(run, f) for f in newest if f >= 0))
            assert in_any_order(fused.of(run, k)) == in_any_order(expected)


def test_a_share_is_a_share():
    with pytest.raises(ValidationError):
        Union(min_existence=1.1)
