"""What the receiver keeps of partial messages, against plain counting."""

from __future__ import annotations

import numpy as np
import pytest

from copem_replay.communication.arrivals import FusionSchedule, SentEntries, fusion_schedule, keep_entries
from copem_replay.core.tracks import Float, Int, Tracks


def lists(unit_ix: Int, captured_s: Float, arrives_s: Float) -> Tracks:
    """Lists of two units with one row each, which nobody looks at."""
    F = len(unit_ix)
    zero = np.zeros((1, F))
    names = ("x_m", "y_m", "z_m", "yaw_rad", "vx_mps", "vy_mps", "length_m", "width_m", "height_m")
    return Tracks(
        units=("partial", "whole"), start=np.arange(F + 1), unit_ix=unit_ix, object_ix=np.zeros(F, dtype=int),
        frame_ix=np.arange(F), stamp_ns=np.rint(captured_s * 1e9).astype(np.int64), captured_s=captured_s,
        frame_unit_ix=unit_ix, arrives_s=arrives_s[None], valid=np.ones((1, F), dtype=bool),
        **dict.fromkeys(names, zero),
    )  # fmt: skip


def test_a_part_of_the_instants_has_the_lists_that_arrived_at_each() -> None:
    whole = FusionSchedule(
        np.array([1.0, 2.0, 3.0, 4.0]), np.array([[0], [2], [2], [3]]), np.arange(4), np.array([0, 1, 3, 3, 4])
    )
    part = whole.between(2.0, 4.0)
    assert (part.issue_s.tolist(), part.newest.tolist()) == ([2.0, 3.0], [[2], [2]])
    assert (part.arrived.tolist(), part.arrived_start.tolist()) == ([1, 2], [0, 2, 2])


@pytest.mark.parametrize("seed", range(20))
def test_of_each_object_the_newest_entry_that_is_not_too_old(seed: int) -> None:
    """Messages overtake each other and get lost; of the whole unit the newest list stays what it is."""
    rng = np.random.default_rng(seed)
    F = 60
    unit_ix, captured_s = np.repeat([0, 1], F // 2), np.tile(np.arange(F // 2) / 10, 2)
    arrives_s = captured_s + rng.integers(0, 40, F) / 100
    arrives_s[rng.random(F) < 0.3] = np.inf
    received = lists(unit_ix, captured_s, arrives_s)
    start = np.append(0, np.cumsum(rng.integers(0, 4, F)))
    frame, same = np.repeat(np.arange(F), np.diff(start)), rng.integers(0, 6, start[-1])
    for f in range(F):  # an object is in a message once
        mine = slice(start[f], start[f + 1])
        same[mine] = rng.permutation(6)[: start[f + 1] - start[f]]
    schedule = fusion_schedule(received, max_age_s=0.4)
    cut_s = schedule.issue_s[len(schedule.issue_s) // 3]
    for at in (schedule, schedule.between(cut_s, np.inf)):
        kept = keep_entries(received, SentEntries(start, same), np.array([True, False]), schedule, at, max_age_s=0.4)
        np.testing.assert_array_equal(kept.newest[:, 1], at.newest[:, 1])
        for k, now_s in enumerate(at.issue_s):
            known: dict[int, int] = {}
            for e in np.flatnonzero(unit_ix[frame] == 0):
                f = frame[e]
                newer = same[e] not in known or captured_s[f] > captured_s[frame[known[same[e]]]]
                if arrives_s[f] <= now_s + 1e-6 and newer:
                    known[same[e]] = e
            expected = sorted(e for e in known.values() if now_s <= arrives_s[frame[e]] + 0.4 + 1e-6)
            which = kept.newest[k, 0] - F
            found = kept.entry[kept.start[which] : kept.start[which + 1]].tolist() if which >= 0 else []
            arriving = {same[e] for e in np.flatnonzero(unit_ix[frame] == 0) if abs(arrives_s[frame[e]] - now_s) < 1e-6}
            assert arriving <= {same[e] for e in found}, "what is taken in now, is there now"
            older = {same[e] for e in expected}
            assert [e for e in found if same[e] in older] == expected
            # An older entry may take the place of a newer one that is too old by now: it came later.
            assert all(arrives_s[frame[e]] > arrives_s[frame[known[same[e]]]] for e in set(found) - set(expected))


def test_an_older_message_that_comes_when_the_newer_one_is_too_old_has_its_entries_kept() -> None:
    """No list comes in between: the newer entry is too old at the very instant at which the older one arrives."""
    received = lists(np.array([0, 0]), np.array([0.8, 1.0]), np.array([1.43, 1.2]))
    schedule = fusion_schedule(received, max_age_s=0.2)
    sent = SentEntries(np.array([0, 1, 2]), np.array([7, 7]))
    kept = keep_entries(received, sent, np.array([True, False]), schedule, schedule, max_age_s=0.2)
    which = kept.newest[:, 0] - 2
    assert [kept.entry[kept.start[k] : kept.start[k + 1]].tolist() for k in which] == [[1], [0]]
