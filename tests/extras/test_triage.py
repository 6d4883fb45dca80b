"""Late episodes in groups: what hides an object, on which side of the ego it is, and the sentence about it."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from copem_replay.extras.why.causes import share_lateness
from copem_replay.extras.why.triage import describe_episode, group_late_episodes, name_places
from tests.extras.test_causes import of_file
from tests.helpers.experiments import drive
from tests.helpers.recordings import Obj, pedestrian, write_recording

TEXT = """\
version: 1
logs: [drive.mcap]
pems: {{sure: [{{when: {{range_m: [0, {range_m}]}}, detection: {{kind: visible_share}}}}]}}
units: {{ego: {{on: ego, height_m: 1.8, pem: sure}}}}
obstacles: [{obstacle}]
configurations: {{alone: {{units: [ego], latency_s: {latency_s}}}}}
measure: {{onset: {{kind: in_range, range_m: 60}}, horizon_s: 2, began: [crossed]}}
"""
WALL = "{polygon_m: [[20, -9], [21, -9], [21, 9], [20, 9]], height_m: 4}"


def triage(folder: Path, obstacle: str, range_m: float, latency_s: float = 0.0) -> tuple[pd.DataFrame, pd.DataFrame]:
    drive(folder / "drive.mcap")
    (folder / "e.yaml").write_text(TEXT.format(obstacle=obstacle, range_m=range_m, latency_s=latency_s))
    replays = of_file(folder / "e.yaml", "alone")
    return group_late_episodes(replays, share_lateness(replays))


def test_a_wall_hides_the_car_all_the_time(tmp_path: Path) -> None:
    """2 s from the onset to the end, all of them hidden, though nothing is missed."""
    groups, episodes = triage(tmp_path, WALL, 80)
    assert len(groups) == 1
    row = groups.iloc[0]
    assert (row["cause"], row["episodes"], row["objects"], row["example"]) == ("hidden", 1, 1, "2")
    assert row["where"] == "obstacle 0"
    assert (row["lost_s"], row["never_share"], row["structural_share"]) == pytest.approx((2.0, 1.0, 1.0))
    assert describe_episode(episodes.iloc[0]) == f"2.0 s late: 2.0 hidden by {row['where']}"


def test_out_of_range_is_told_with_the_side(tmp_path: Path) -> None:
    """45 m away at 2.5 s: 1.5 s, ahead of the ego."""
    groups, episodes = triage(tmp_path, "", 45)
    row = groups.iloc[0]
    assert (row["cause"], row["where"]) == ("range", "ahead")
    assert (row["lost_s"], row["never_share"]) == pytest.approx((1.5, 0.0))
    assert describe_episode(episodes.iloc[0]) == "1.5 s late: 1.5 out of range or view"


def test_what_hides_are_places_of_one_group() -> None:
    """5 s behind two trucks and 3 s out of view: hidden is most, with the truck that costs most first."""
    late = pd.DataFrame({
        "where": ["truck 1", "truck 2", "truck 1", "left"], "unknown_s": [1.0, 3.0, 1.0, 3.0],
        "cause": ["hidden", "hidden", "hidden", "range"],
    })  # fmt: skip
    assert name_places(late[late["cause"] == "hidden"]) == "truck 2 for 3.0 s, truck 1 for 2.0 s"
    assert name_places(late[late["cause"] == "range"]) == "left"
    assert name_places(late.assign(where="")) == ""
    many = pd.DataFrame({"where": [f"car {k}" for k in range(5)], "unknown_s": [5.0, 4.0, 3.0, 2.0, 1.0]})
    assert name_places(many) == "car 0 for 5.0 s, car 1 for 4.0 s, car 2 for 3.0 s and 2 more"


def test_hidden_is_one_group_of_a_drive_whoever_hides(tmp_path: Path) -> None:
    """A walker behind a wall on the left, another behind a wall on the right: one group with both walls."""
    walls = "{polygon_m: [[20, 4], [21, 4], [21, 30], [20, 30]], height_m: 4}, "
    walls += "{polygon_m: [[20, -30], [21, -30], [21, -4], [20, -4]], height_m: 4}"
    frames = []
    for t in range(60):
        walkers = [pedestrian(id=number, x=62.0 - 0.4 * t, y=y) for number, y in ((2, 12.0), (3, -12.0))]
        frames.append((0.1 * t, [Obj(id=1, x=0.0), *walkers]))
    write_recording(tmp_path / "drive.mcap", frames, host=1)
    (tmp_path / "e.yaml").write_text(TEXT.format(obstacle=walls, range_m=80, latency_s=0.0))
    replays = of_file(tmp_path / "e.yaml", "alone")
    groups, episodes = group_late_episodes(replays, share_lateness(replays))
    assert set(episodes["where"]) == {"obstacle 0", "obstacle 1"}
    row = groups.iloc[0]
    assert (len(groups), row["cause"], row["objects"]) == (1, "hidden", 2)
    assert row["lost_s"] == pytest.approx(episodes["unknown_s"].sum())
    assert {part.partition(" for ")[0] for part in row["where"].split(", ")} == {"obstacle 0", "obstacle 1"}


def test_what_nobody_can_know_in_time_is_in_no_group(tmp_path: Path) -> None:
    """With 2.5 s of latency no list arrives within the 2 s that are left."""
    groups, episodes = triage(tmp_path, "", 80, latency_s=2.5)
    assert len(groups) == 0
    assert episodes["hopeless_share"].tolist() == [1.0]


def test_in_time_is_not_late(tmp_path: Path) -> None:
    groups, episodes = triage(tmp_path, "", 55)
    assert len(groups) == 0
    assert episodes["unknown_s"].tolist() == pytest.approx([0.5])
