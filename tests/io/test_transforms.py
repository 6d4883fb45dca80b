"""Frames of reference: chains of transforms, by hand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from copem_replay.core.interpolation import yaw_of
from copem_replay.io.frames import FrameTree, SampledPoses, make_pose_track
from copem_replay.io.schemas.poses import Poses

Sample = tuple[float, float, float, float]
"""Seconds, x, y, yaw in degrees."""


def poses(parent: str, child: str, *samples: Sample) -> Poses:
    half = np.deg2rad([s[3] for s in samples]) / 2
    zero = np.zeros(len(samples))
    return Poses(
        stamp_ns=np.array([round(s[0] * 1e9) for s in samples], dtype=np.int64),
        position_m=np.array([[s[1], s[2], 0.0] for s in samples]),
        rotation=np.stack([zero, zero, np.sin(half), np.cos(half)], axis=1),
        velocity_mps=np.full((len(samples), 2), np.nan),
        frame=(parent,) * len(samples),
        child=(child,) * len(samples),
        log_time_ns=np.array([round(s[0] * 1e9) for s in samples], dtype=np.int64),
    )


def at(*seconds: float) -> np.ndarray:
    return np.array([round(s * 1e9) for s in seconds], dtype=np.int64)


def flat(placed: SampledPoses | None) -> list[list[float]]:
    """x, y and yaw in degrees."""
    assert placed is not None
    found = np.column_stack([placed.position_m[:, :2], np.rad2deg(yaw_of(placed.rotation))])
    return np.round(found, 9).tolist()


def moving() -> FrameTree:
    """The car drives east from (10, 0), 10 m/s, then turns to the north; a lidar 2 m ahead looks to the left."""
    frames = FrameTree()
    frames.add(poses("map", "base", (0.0, 10, 0, 0), (0.1, 11, 0, 0), (0.2, 11, 0, 90)))
    frames.add(poses("base", "lidar", (5.0, 2, 0, 90)), static=True)
    return frames


def test_a_chain_of_transforms() -> None:
    placed = moving().place("lidar", "map", at(0.0, 0.1, 0.2))
    assert flat(placed) == [[12, 0, 90], [13, 0, 90], [11, 2, 180]]


def test_between_samples_positions_are_linear_and_turns_the_short_way_round() -> None:
    frames = FrameTree()
    frames.add(poses("map", "base", (0.0, 0, 0, 170), (0.2, 4, 0, -170)))
    assert flat(frames.place("base", "map", at(0.1))) in ([[2, 0, 180]], [[2, 0, -180]])


def test_nothing_is_known_before_after_and_in_a_long_gap() -> None:
    frames = FrameTree()
    frames.add(poses("map", "base", (1.0, 0, 0, 0), (1.5, 5, 0, 0), (2.1, 11, 0, 0)))
    placed = frames.place("base", "map", at(0.99, 1.0, 1.25, 1.5, 1.8, 2.1, 2.2))
    assert placed is not None
    assert placed.there.tolist() == [False, True, True, True, False, True, False]


def test_from_the_world_down_and_across() -> None:
    frames = moving()
    assert flat(frames.place("map", "lidar", at(0.0))) == [[0, 12, -90]]
    frames.add(poses("map", "mast", (0.0, 10, 5, 0)))
    assert flat(frames.place("lidar", "mast", at(0.0))) == [[2, -5, 90]]
    assert frames.place("lidar", "elsewhere", at(0.0)) is None


def test_the_world_is_the_outermost_frame_that_something_moves_in() -> None:
    frames = moving()
    frames.add(poses("earth", "map", (0.0, 1000, 2000, 0)), static=True)
    assert frames.world_of("lidar") == "map"
    assert frames.world_of("base") == "map"
    assert frames.world_of("map") == "map"
    assert frames.world_of("unknown") == "unknown"


def test_a_circle_has_an_end() -> None:
    frames = FrameTree()
    frames.add(poses("a", "b", (0, 1, 0, 0)))
    frames.add(poses("b", "a", (0, 1, 0, 0)))
    assert frames.chain("a") == ["a", "b"]
    assert flat(frames.place("b", "a", at(0))) == [[-1, 0, 0]]  # they contradict each other; one is gone by


def test_of_several_samples_at_an_instant_the_first() -> None:
    course = make_pose_track(poses("map", "base", (0.2, 3, 0, 0), (0.1, 1, 0, 0), (0.1, 2, 0, 0)))
    assert course is not None
    assert course.stamp_ns.tolist() == [100_000_000, 200_000_000]
    assert course.position_m[:, 0].tolist() == [1.0, 3.0]
    assert make_pose_track(poses("map", "base", (0, 0, 0, 0)), np.array([False])) is None


ANGLE = st.floats(-180, 180)
PLACE = st.floats(-100, 100)


@given(chain=st.lists(st.tuples(PLACE, PLACE, ANGLE), min_size=1, max_size=4))
def test_there_and_back_is_nowhere(chain: Sequence[tuple[float, float, float]]) -> None:
    """By complex numbers: each frame turns and moves what is in it."""
    frames = FrameTree()
    for k, (x, y, yaw) in enumerate(chain):
        frames.add(poses(f"f{k}", f"f{k + 1}", (0.0, x, y, yaw)))
    last = f"f{len(chain)}"
    where, turn = 0j, 0.0
    for x, y, yaw in reversed(chain):
        where = complex(x, y) + where * np.exp(1j * np.deg2rad(yaw))
        turn += yaw
    placed = frames.place(last, "f0", at(0.0))
    assert placed is not None
    assert placed.position_m[0, :2] == pytest.approx([where.real, where.imag], abs=1e-9)
    found = np.exp(1j * yaw_of(placed.rotation)[0])
    assert abs(found - np.exp(1j * np.deg2rad(turn))) < 1e-9
    back = frames.place("f0", last, at(0.0))
    assert back is not None
    returned = complex(*back.position_m[0, :2]) + where * np.exp(1j * yaw_of(back.rotation)[0])
    assert abs(returned) < 1e-8
