"""Whether a map and the traffic are in one frame: shares by hand, and of a real drive in wrong places."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from copem_replay.core.site_map import Lane, SiteMap
from copem_replay.core.tracks import Float
from copem_replay.extras.maps.registry import read_map
from copem_replay.io.recording import Recording, read_log
from copem_replay.metrics.agreement import Agreement, DirectedLanes, estimate_shift, find_agreement

SHARED = Path(__file__).parents[3] / "shared/data"


def lane(left: list[tuple[float, float]], right: list[tuple[float, float]], kind: str = "driving") -> Lane:
    lines = [np.array([(x, y, 0.0) for x, y in line]) for line in (left, right)]
    return Lane("a", kind, *lines)  # type: ignore[arg-type]


EASTWARDS = lane([(0, 3), (50, 3)], [(0, 0), (20, 0), (50, 0)])


@pytest.mark.parametrize(("x_m", "y_m", "yaw_deg", "along"), [
    (10, 1, 0, True), (10, 1, 44, True), (10, 1, -44, True), (10, 1, 46, False), (10, 1, 180, False),
    (10, 3.1, 0, False), (-1, 1, 0, False), (49, 2.9, 359, True),
])  # fmt: skip
def test_a_place_is_along_a_lane_that_runs_its_way(x_m: float, y_m: float, yaw_deg: float, along: bool) -> None:
    found = DirectedLanes([EASTWARDS]).are_along(np.array([x_m]), np.array([y_m]), np.radians([yaw_deg]))
    assert found.tolist() == [along]


def test_a_bend_has_the_direction_of_each_of_its_parts() -> None:
    bend = lane([(0, 3), (17, 3), (17, 20)], [(0, 0), (20, 0), (20, 20)])
    x, y = np.array([5.0, 18.5, 5.0, 18.5]), np.array([1.0, 15.0, 1.0, 15.0])
    assert DirectedLanes([bend]).are_along(x, y, np.radians([0, 90, 90, 0])).tolist() == [True, True, False, False]


def test_nobody_drives_on_a_bicycle_lane() -> None:
    bicycles = lane([(0, 3), (50, 3)], [(0, 0), (50, 0)], "bicycle")
    assert not DirectedLanes([bicycles]).are_along(np.array([10.0]), np.array([1.0]), np.zeros(1)).any()


@pytest.mark.parametrize(("states", "along", "share", "refused", "words"), [
    (0, 0, None, False, "unknown: no vehicle moves"),
    (99, 0, 0.0, False, "too few to conclude from"),
    (100, 29, 0.29, True, "0.29: 29 of 100 states of moving vehicles are in a lane of their heading; is the map"),
    (100, 30, 0.3, False, "is the map in the frame of the log"),
    (100, 60, 0.6, False, "0.60: 60 of 100 states of moving vehicles are in a lane of their heading"),
])  # fmt: skip
def test_what_is_said(states: int, along: int, share: float | None, refused: bool, words: str) -> None:
    found = Agreement(states, along)
    assert (found.share, found.refused) == (share, refused)
    assert words in found.words
    assert ("is the map" in found.words) == (states >= 100 and along < 60)


@pytest.fixture(scope="module")
def drive() -> tuple[Recording, SiteMap]:
    """A drive of Argoverse 2 with its map, brought to the frame of the recording."""
    recording = SHARED / "av2_3b3570b4.mcap"
    maps = sorted((SHARED / "maps/av2").glob("log_map_archive_*.json"))
    if not (recording.is_file() and maps):
        pytest.skip("no drive of Argoverse 2 here")
    return read_log(recording, name="a"), read_map(maps[0]).moved(lambda at: at - [700, 2200])


def share_of(drive: tuple[Recording, SiteMap], move: Callable[[Float], Float]) -> float:
    recording, site = drive
    share = find_agreement(recording.scene, recording.truth, site.moved(move).lanes).share
    assert share is not None
    return share


def test_a_real_drive_agrees_with_its_map(drive: tuple[Recording, SiteMap]) -> None:
    assert share_of(drive, lambda at: at) >= 0.6


@pytest.mark.parametrize("move", [
    lambda at: at * [1, -1], lambda at: at * [-1, 1], lambda at: at[:, ::-1], lambda at: at - [-100, 0],
])  # fmt: skip
def test_a_real_drive_does_not_agree_with_a_map_elsewhere(
    drive: tuple[Recording, SiteMap], move: Callable[[Float], Float]
) -> None:
    assert share_of(drive, move) <= 0.3


def test_ten_metres_off_agree_less_on_average(drive: tuple[Recording, SiteMap]) -> None:
    """Along a street ten metres are hardly seen, across they are: the mean of eight directions."""
    angles = np.arange(8) * np.pi / 4
    shares = [share_of(drive, lambda at, a=a: at + 10 * np.array([np.cos(a), np.sin(a)])) for a in angles]
    assert np.mean(shares) <= 0.3


@pytest.mark.parametrize("off_m", [(0.0, 0.0), (10.0, 0.0), (-7.0, 21.0)])
def test_the_shift_is_found(drive: tuple[Recording, SiteMap], off_m: tuple[float, float]) -> None:
    recording, site = drive
    found = estimate_shift(recording.scene, recording.truth, site.moved(lambda at: at + off_m).lanes)
    assert found is not None
    assert np.hypot(found.east_m + off_m[0], found.north_m + off_m[1]) <= 1.0
    assert "nothing is moved by itself" in found.words


def test_no_shift_without_lanes(drive: tuple[Recording, SiteMap]) -> None:
    recording, _ = drive
    assert estimate_shift(recording.scene, recording.truth, []) is None
