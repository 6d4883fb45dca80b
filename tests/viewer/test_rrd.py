"""Recordings for the viewer, read back: every box where and when the arrays have it, every word as it should be.

The ego stands at the origin. A car, 100 m ahead at 0 s, drives towards it at 10 m/s and leaves the log at 4 s, 60 m
away. A pedestrian stands 70 m ahead. The ego's unit sees to 60 m: the car once, at 4 s, the pedestrian never; a pole
beside the pedestrian sees all; the car carries a unit that sees nothing.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from copem_replay.core.errors import OutputError
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import CLASSES, TimeChunk
from copem_replay.experiment.schema import Experiment
from copem_replay.pipeline.one_run import RunTracks, tracks_of_run
from copem_replay.pipeline.prepare import Replay, prepare_log
from copem_replay.pipeline.replay import replay_block
from copem_replay.viewer import write_rrd
from copem_replay.viewer.sink import ELAPSED, TIME
from tests.helpers.scenes import EGO_UNIT, SEES_60_M, SEES_ALL, T0_NS, Thing, driving, experiment, recording, standing

os.environ["RERUN_ANALYTICS"] = "0"  # before it is imported, which is when something is written

SUMMARY = pd.DataFrame(
    {"configuration": ["GT", "a|b"], "n": [2, 0], "ttd_median_s": [0.25, np.nan], "interval": ["", None]}
)
TILTED = {"kind": "gaussian", "covariance_m2": [[2.5, 1.5], [1.5, 2.5]]}  # 4 m² along 45°, 1 m² across
CHANGES: dict[str, Any] = {
    "pems": {
        "sure": [SEES_60_M[0] | {"error": {"kind": "gaussian", "covariance_m2": [[4.0, 0.0], [0.0, 1.0]]}}],
        "all": [SEES_ALL[0] | {"error": TILTED}],
        "blind": [{"detection": {"kind": "constant", "probability": 0.0}}],
    },
    "units": {
        "ego": EGO_UNIT,
        "pole": {"at": [70, 1], "height_m": 6.0, "ground_z_m": 0.0, "pem": "all", "rate_hz": 4},
        "obu": {"on": "7", "height_m": 2.0, "pem": "blind"},
    },
    "configurations": {
        "GT": {"units": "truth"},
        "GT late": {"units": "truth", "latency_s": 0.5},
        "PEM": {"units": ["ego"]},
        "pole": {"units": ["pole"]},
        "none": {"units": ["obu"]},
    },
}  # fmt: skip


def approaching() -> Any:
    return recording(
        [
            Thing("ego", "car", standing(0, 0)),
            Thing("7", "car", driving(100, 0, -10), there=lambda t: t < 4.01, yaw_rad=np.pi),
            Thing("9", "pedestrian", standing(70, 0)),
            Thing("bin", "other", standing(30, 8), yaw_rad=0.5, moving=False),
        ],
        until_s=5.0,
    )


@dataclass
class Made:
    """What went in, and what came out."""

    path: Path
    replay: Replay
    given: Experiment
    run_tracks: dict[str, FusedTracks]
    table: pd.DataFrame

    def write(self, path: Path, **changes: Any) -> None:
        columns = {"replay": self.replay, "run_tracks": self.run_tracks, "table": self.table}
        columns |= {"summary": SUMMARY} | changes
        write_rrd(path, columns["replay"], self.given, [columns["run_tracks"]], columns["table"], columns["summary"], 3)


def make(path: Path, scene: Any, **changes: Any) -> Made:
    given = experiment(**changes)
    replay = prepare_log(scene, given)
    run_tracks = tracks_of_run(replay, given, 3)
    made = Made(path, replay, given, run_tracks, replay_block(replay, given, np.array([3])))
    made.write(path)
    return made


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return make(tmp_path_factory.mktemp("show") / "not yet" / "there" / "replay.rrd", approaching(), **CHANGES)


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Nothing but the truth: then it has views of its own."""
    truths = {name: asked for name, asked in CHANGES["configurations"].items() if asked["units"] == "truth"}
    path = tmp_path_factory.mktemp("alone") / "replay.rrd"
    return make(path, approaching(), **CHANGES | {"configurations": truths})


BESIDE = ["PEM", "pole", "none"]
"""Configurations that are not the truth."""


# ------------------------------------------------------------------------------- reading back


def chunks(path: Path, entity: str) -> Iterator[Any]:
    from rerun.chunk import RrdReader

    return (c for c in RrdReader(path).stream() if c.entity_path == entity)


def static(path: Path, entity: str) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {}
    for batch in (c.to_record_batch() for c in chunks(path, entity) if c.is_static):
        found |= {name: batch.column(name).to_pylist()[0] for name in batch.schema.names}
    return found


def rows(path: Path, entity: str) -> list[dict[str, Any]]:
    """The rows of an entity over time: elapsed and absolute ns, and per component the instances."""
    found = []
    for batch in (c.to_record_batch() for c in chunks(path, entity) if not c.is_static):
        names = [n for n in batch.schema.names if not n.startswith("rerun")]
        columns = [
            batch.column(n).cast("int64").to_pylist() if n in (ELAPSED, TIME) else batch.column(n).to_pylist()
            for n in names
        ]
        found += [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]
    return sorted(found, key=lambda row: row[ELAPSED])


def at(path: Path, entity: str, elapsed_s: float, of: str = "") -> dict[str, Any]:
    """What the viewer shows then: the newest row, of those that have this component."""
    return [row for row in rows(path, entity) if row[ELAPSED] <= elapsed_s * 1e9 + 1000 and (not of or of in row)][-1]


def rerun(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [str(Path(sys.executable).parent / "rerun"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)


def float32(*columns: Any) -> list[list[float]]:
    return np.stack(columns, axis=-1).astype(np.float32).tolist()


def turns(row: dict[str, Any], archetype: str) -> list[float]:
    """Angles about the vertical, rad."""
    found = row[f"{archetype}:rotation_axis_angles"]
    assert all(turn["axis"] == [0, 0, 1] for turn in found)
    return [turn["angle"] for turn in found]


def kinds_of_boxes(path: Path) -> dict[int, Any]:
    context = static(path, "/")["AnnotationContext:context"][0]
    return {info["class_id"]: info["class_description"]["info"] for info in context}


# ------------------------------------------------------------------------------- boxes


@pytest.mark.parametrize("name", ["truth", *CHANGES["configurations"]])
def test_boxes_are_those_of_the_arrays(made: Made, alone: Made, name: str) -> None:
    made = alone if name in alone.run_tracks else made
    tracks = made.replay.truth if name == "truth" else made.run_tracks[name].fused
    entity = f"/world/{name}/boxes".replace(" ", "\\ ")
    found = rows(made.path, entity)
    assert [row[ELAPSED] for row in found] == np.rint(tracks.arrives_s[0] * 1e9).astype(int).tolist()
    assert [row[TIME] - T0_NS for row in found] == [row[ELAPSED] for row in found]
    scene = made.replay.scene
    named = {number: info["label"] for number, info in kinds_of_boxes(made.path).items()}
    for frame, row in enumerate(found):
        mine = np.flatnonzero((tracks.frame_ix == frame) & tracks.valid[0])
        x, y, z, yaw, long, wide, high = (
            getattr(tracks, n)[0, mine] for n in ("x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m", "height_m")
        )
        assert row["Boxes3D:centers"] == float32(x, y, z)
        assert row["Boxes3D:half_sizes"] == float32(long / 2, wide / 2, high / 2)
        assert turns(row, "Boxes3D") == yaw.astype(np.float32).tolist()
        objects = tracks.row_object_ix[mine]
        kinds = [CLASSES[k] for k in scene.object_class[objects]]
        assert [named[k] for k in row["Boxes3D:class_ids"]] == [
            f"{scene.object_ids[o]} {kind}" for o, kind in zip(objects, kinds, strict=True)
        ]


def test_what_lists_hold_and_when(made: Made, alone: Made) -> None:
    assert [80.0, 0.0, 0.75] in at(made.path, "/world/truth/boxes", 2.0)["Boxes3D:centers"]
    # From the ego: the bin, 31 m away, always, and once the car.
    assert [len(row["Boxes3D:centers"]) for row in rows(made.path, "/world/PEM/boxes")] == [1] * 40 + [2] + [1] * 10
    # Lists without objects are there, and empty; they end where the carrier leaves.
    assert [row["Boxes3D:centers"] for row in rows(made.path, "/world/none/boxes")] == [[]] * 41
    # Half a second late: nothing before, and then what was half a second before.
    late = rows(alone.path, "/world/GT\\ late/boxes")
    assert late[0][ELAPSED] == 500_000_000
    assert [80.0, 0.0, 0.75] in at(alone.path, "/world/GT\\ late/boxes", 2.5)["Boxes3D:centers"]
    assert len(at(alone.path, "/world/GT\\ late/boxes", 4.5)["Boxes3D:centers"]) == 3
    assert len(at(alone.path, "/world/GT\\ late/boxes", 4.6)["Boxes3D:centers"]) == 2


def test_colours_tell_ego_standing_and_configurations_apart(made: Made) -> None:
    kinds = kinds_of_boxes(made.path)
    ego, car, walker, bin = (kinds[k] for k in at(made.path, "/world/truth/boxes", 0)["Boxes3D:class_ids"])
    assert (ego["label"], bin["label"]) == ("ego car", "bin other")
    assert len({ego["color"], car["color"], bin["color"]}) == 3
    assert car["color"] >> 8 == walker["color"] >> 8 == 0x919191, "the truth is grey"
    assert bin["color"] < car["color"] < ego["color"], "stationary: darker"
    colours = [at(made.path, f"/world/{n}/boxes", 4.0)["Boxes3D:colors"][0] >> 8 for n in ("PEM", "pole")]
    assert len({*colours, 0x919191}) == 3


def test_the_older_the_paler(made: Made, alone: Made) -> None:
    def opaque(name: str, elapsed_s: float) -> set[int]:
        path = alone.path if name.startswith("GT") else made.path
        return {colour & 0xFF for colour in at(path, f"/world/{name}/boxes", elapsed_s)["Boxes3D:colors"]}

    assert opaque("GT", 3.0) == {220}
    assert opaque("GT\\ late", 3.0) == {120}, "half a second: two and a half steps, to even"
    # The pole lists at 0, 0.25, 0.5 s …, and the lists of others leave it as it is.
    assert opaque("pole", 3.0) == {220}


def test_ellipses_are_two_sigma(made: Made) -> None:
    alone = at(made.path, "/world/PEM/covariance", 4.0)
    assert alone["Ellipsoids3D:half_sizes"] == [pytest.approx([4, 2, 0.01])] * 2
    assert turns(alone, "Ellipsoids3D") == [0, 0]
    boxes = at(made.path, "/world/PEM/boxes", 4.0)["Boxes3D:centers"]
    assert [x for x, _, _ in alone["Ellipsoids3D:centers"]] == pytest.approx([x for x, _, _ in boxes], abs=0.004)
    assert all(float(value * 128).is_integer() for place in alone["Ellipsoids3D:centers"] for value in place)
    assert [z for _, _, z in alone["Ellipsoids3D:centers"]] == pytest.approx([0, 0])
    tilted = at(made.path, "/world/pole/covariance", 1.0)
    assert tilted["Ellipsoids3D:half_sizes"][0] == pytest.approx([4, 2, 0.01])
    assert turns(tilted, "Ellipsoids3D")[0] == pytest.approx(np.pi / 4)


def test_exact_positions_have_no_ellipses(alone: Made) -> None:
    assert list(chunks(alone.path, "/world/GT/boxes"))
    assert not list(chunks(alone.path, "/world/GT/covariance"))


def test_the_truth_has_nothing_of_its_own_beside_others(made: Made, alone: Made) -> None:
    """Its outlines are in every view; as the baseline of differences, or alone, it is one like any other."""
    from rerun.chunk import RrdReader

    def of_truth(path: Path) -> set[str]:
        return {c.entity_path for c in RrdReader(path).stream() if "GT" in c.entity_path}

    assert of_truth(made.path) == set()
    assert "/world/GT/boxes" in of_truth(alone.path)
    assert not any("| GT" in text for text in static(made.path, "/difference")["TextDocument:text"])


# ------------------------------------------------------------------------------- units, obstacles


def test_units_are_where_they_are_and_gone_with_their_carrier(made: Made) -> None:
    assert static(made.path, "/world/units/pole")["Points3D:positions"] == [[70.0, 1.0, 6.0]]
    assert static(made.path, "/world/units/obu")["Points3D:labels"] == ["obu"]
    carried = rows(made.path, "/world/units/obu")
    assert [row["Points3D:positions"] for row in carried[:2]] == [[[100.0, 0.0, 2.0]], [[99.0, 0.0, 2.0]]]
    assert [len(row["Points3D:positions"]) for row in carried] == [1] * 41 + [0] * 10


def test_obstacles_are_prisms(tmp_path: Path) -> None:
    corner = {"polygon_m": [[10, 8], [16, 8], [16, 12], [13, 12], [13, 10], [10, 10]], "height_m": 4, "ground_z_m": 1}
    block = {"polygon_m": [[0, 20], [4, 20], [4, 23]], "height_m": 2.0, "ground_z_m": 0}
    made = make(tmp_path / "x.rrd", approaching(), obstacles=[corner, block])
    mesh = static(made.path, "/world/static/obstacles")
    place, normal = (np.array(mesh[f"Mesh3D:vertex_{name}"]) for name in ("positions", "normals"))
    faces = np.array(mesh["Mesh3D:triangle_indices"])
    turned = np.cross(place[faces[:, 1]] - place[faces[:, 0]], place[faces[:, 2]] - place[faces[:, 0]])
    area = np.linalg.norm(turned, axis=1) / 2
    # Seen from outside: corners run counter-clockwise around the normal.
    assert (turned * normal[faces[:, 0]]).sum(axis=1) == pytest.approx(2 * area)
    lid = normal[faces[:, 0], 2] == 1
    assert area[lid].sum() == pytest.approx((6 * 2 + 3 * 2) + 6)
    assert set(place[faces[lid]][..., 2].ravel()) == {5.0, 2.0}
    # Walls: at the very least around both; the corner is cut into convex parts, which have walls of their own.
    assert area[~lid].sum() >= (6 + 4 + 3 + 2 + 3 + 2) * 4 + (4 + 3 + 5) * 2 - 1e-4


def test_what_hides_from_below_the_ground_is_drawn_from_the_ground(tmp_path: Path) -> None:
    made = make(
        tmp_path / "x.rrd", approaching(), obstacles=[{"polygon_m": [[0, 20], [4, 20], [4, 23]], "height_m": 2}]
    )
    assert made.replay.placed.static.bottom_m.tolist() == [-20.0]
    place = np.array(static(made.path, "/world/static/obstacles")["Mesh3D:vertex_positions"])
    assert set(place[..., 2].ravel()) == {0.0, 2.0}


# ------------------------------------------------------------------------------- plots, words


def test_errors_are_those_of_the_instant_a_list_is_available(made: Made, alone: Made) -> None:
    def error(name: str) -> list[dict[str, Any]]:
        path = alone.path if name.startswith("GT") else made.path
        return rows(path, f"/plots/position_error/7_car/{name}".replace(" ", "\\ "))

    # Quartiles of a second around every quarter of one; ten lists a second.
    exact = error("GT")
    assert [row["Scalars:scalars"] for row in exact] == [[0.0, 0.0, 0.0]] * 17
    assert [row[ELAPSED] for row in exact] == [250_000_000 * k for k in range(17)]
    late = error("GT late")  # ten metres a second, half a second
    assert np.array([row["Scalars:scalars"] for row in late]) == pytest.approx(np.full((15, 3), 5.0))
    assert (late[0][ELAPSED], late[-1][ELAPSED]) == (500_000_000, 4_000_000_000)  # at 4.5 s it has left
    once = error("PEM")
    assert [row[ELAPSED] for row in once] == [4_000_000_000]
    fused = made.run_tracks["PEM"].fused
    [seen] = np.flatnonzero((fused.row_object_ix == 1) & fused.valid[0])
    x, y = fused.x_m[0, seen], fused.y_m[0, seen]
    assert once[0]["Scalars:scalars"] == [np.hypot(x - 60, y)] * 3
    assert not error("none")


SLOW = {"at": [0, 1], "height_m": 6.0, "ground_z_m": 0.0, "pem": "noisy", "rate_hz": 0.5}
NOISY = [SEES_ALL[0] | {"error": {"kind": "gaussian", "covariance_m2": [[1.0, 0.0], [0.0, 0.01]]}}]


@pytest.fixture(scope="module")
def with_gaps(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """A pedestrian who is away from 3 s to 5 s and from 8 s to 8.7 s, as a noisy ego lists him, and a slow pole."""
    scene = recording(
        [
            Thing("ego", "car", standing(0, 0)),
            Thing("9", "pedestrian", standing(20, 0), there=lambda t: not (3.01 < t < 4.99 or 8.01 < t < 8.69)),
        ],
        until_s=12.0,
    )
    return make(
        tmp_path_factory.mktemp("gaps") / "x.rrd", scene, pems={"noisy": NOISY},
        units={"ego": EGO_UNIT | {"pem": "noisy"}, "pole": SLOW},
        configurations={"PEM": {"units": ["ego"]}, "slow": {"units": ["pole"]}},
        measure={"onset": {"kind": "appears"}, "objects": {"classes": ["pedestrian"]}},
    )  # fmt: skip


def drawn_lines(found: list[dict[str, Any]]) -> list[list[dict[str, Any]]]:
    """The rows of each line that the viewer draws: it breaks lines at empty rows."""
    lines: list[list[dict[str, Any]]] = [[]]
    for row in found:
        if row["Scalars:scalars"]:
            lines[-1].append(row)
        else:
            lines.append([])
    return [line for line in lines if line]


def test_lines_of_errors_are_quartiles_and_break_where_there_is_none(with_gaps: Made) -> None:
    found = rows(with_gaps.path, "/plots/position_error/9_pedestrian/PEM")
    lines = drawn_lines(found)
    assert len(lines) == 3 - 1, "0.7 s without him are bridged by medians over a second"
    for line in lines:
        assert np.diff([row[ELAPSED] for row in line]).max() <= 500_000_000
    # The errors as they are in the lists, and their quartiles as NumPy has them.
    fused = with_gaps.run_tracks["PEM"].fused
    mine = np.flatnonzero((fused.row_object_ix == 1) & fused.valid[0])
    time_s = fused.common_arrives_s[fused.frame_ix[mine]]
    error_m = np.hypot(fused.x_m[0, mine] - 20, fused.y_m[0, mine])
    below = 0
    for row in (row for line in lines for row in line):
        near_m = error_m[np.abs(time_s - row[ELAPSED] / 1e9) <= 0.5 + 1e-6]
        assert row["Scalars:scalars"] == pytest.approx(np.percentile(near_m, [25, 50, 75]))
        assert min(row["Scalars:scalars"]) >= 0
        low, median, high = row["Scalars:scalars"]
        below += median - (high - low) / 2 < low
    assert below, "a band of half their distance about the median would be lower"
    assert static(with_gaps.path, "/plots/position_error/9_pedestrian/PEM")["SeriesLines:widths"] == [0.5, 1.5, 0.5]


def test_a_line_of_a_slow_unit_breaks_after_each_list(with_gaps: Made) -> None:
    """A list every two seconds: its GOSPA is drawn for half a second, as steps."""
    found = rows(with_gaps.path, "/plots/gospa/slow")
    lines = drawn_lines(found)
    assert [line[0][ELAPSED] for line in lines] == [2_000_000_000 * k for k in range(7)]
    for line in lines[:-1]:
        assert [row[ELAPSED] - line[0][ELAPSED] for row in line] == [0, 499_999_999]
        assert line[1]["Scalars:scalars"] == line[0]["Scalars:scalars"]
    assert len(lines[-1]) == 1
    gospa = drawn_lines(rows(with_gaps.path, "/plots/gospa/PEM"))
    assert [len(line) for line in gospa] == [121], "ten lists a second"


def test_lines_that_break_are_the_same_in_time_chunks(with_gaps: Made, tmp_path: Path) -> None:
    replay, given = with_gaps.replay, with_gaps.given
    cuts = [-np.inf, 1.0, 2.2, 2.3, 7.0, np.inf]
    pieces = replace(replay, chunks=tuple(TimeChunk(*pair) for pair in pairwise(cuts)))
    path = tmp_path / "pieces.rrd"
    write_rrd(path, pieces, given, RunTracks(pieces, given, 3), with_gaps.table, SUMMARY, 3)
    for name in ("/plots/gospa/slow", "/plots/gospa/PEM", "/plots/position_error/9_pedestrian/slow"):
        assert rows(path, name) == rows(with_gaps.path, name), name


def test_visible_shares_break_where_there_are_no_lists(tmp_path: Path) -> None:
    """The log has no frame between 2 s and 3 s: of the best of all the line ends there; a slow unit's has breaks."""
    scene = recording([Thing("ego", "car", standing(0, 0)), Thing("9", "pedestrian", standing(20, 0))], until_s=4.0)
    kept = (scene.truth.captured_s < 2.01) | (scene.truth.captured_s > 2.99)
    frames = np.flatnonzero(kept)
    truth = scene.truth.take_rows(np.flatnonzero(kept[scene.truth.frame_ix]))
    truth = replace(
        truth, frame_ix=np.searchsorted(frames, truth.frame_ix), stamp_ns=truth.stamp_ns[kept],
        captured_s=truth.captured_s[kept], frame_unit_ix=truth.frame_unit_ix[kept], arrives_s=truth.arrives_s[:, kept],
    )  # fmt: skip
    made = make(tmp_path / "x.rrd", replace(scene, truth=truth), units={"ego": EGO_UNIT})
    lines = drawn_lines(rows(made.path, "/plots/visible_share/9_pedestrian/ego"))
    assert [[row[ELAPSED] / 1e9 for row in line] for line in lines] == [[0, 2], [3, 4]]


def test_visible_shares_of_the_ego_and_of_the_best(tmp_path: Path) -> None:
    # A wall across the ego's line hides the pedestrian from it; he is missing between 1 s and 2 s. The pole lists at
    # 0, 0.25, 0.5 … s: at the instants of either, the newest list of each counts.
    scene = recording(
        [
            Thing("ego", "car", standing(0, 0)),
            Thing("9", "pedestrian", standing(70, 0), there=lambda t: not 1.01 < t < 1.99),
            Thing("wall", "other", standing(10, 0), size_m=(0.1, 6.0, 40.0), moving=False),
        ],
        until_s=3.0,
    )
    pole = CHANGES["units"]["pole"] | {"at": [70, 8]}
    made = make(tmp_path / "x.rrd", scene, units={"ego": EGO_UNIT | {"pem": "all"}, "pole": pole})
    own, best = (rows(made.path, f"/plots/visible_share/9_pedestrian/{name}") for name in ("ego", "any_unit"))
    # Only where a line bends: its ends, and the gap.
    assert [row["Scalars:scalars"] for row in own] == [[0.0], [0.0], [], [0.0], [0.0]]
    assert [row["Scalars:scalars"] for row in best] == [[1.0], [1.0], [], [1.0], [1.0]]
    assert (best[0][ELAPSED], best[-1][ELAPSED]) == (0, 3_000_000_000)
    assert not rows(made.path, "/plots/visible_share/9_pedestrian/ego_outside")
    # From 60 m it does not look at all, whatever could be seen: crosses, ten a second, and no line.
    far = make(tmp_path / "far.rrd", scene, units={"ego": EGO_UNIT, "pole": pole}).path
    crosses = rows(far, "/plots/visible_share/9_pedestrian/ego_outside")
    assert not rows(far, "/plots/visible_share/9_pedestrian/ego")
    assert [row["Scalars:scalars"] for row in crosses] == [[0.0]] * 22
    assert np.diff([row[ELAPSED] for row in crosses[:10]]).tolist() == [100_000_000] * 9
    assert not rows(far, "/plots/visible_share/9_pedestrian/any_unit_outside")


def test_events_in_words(made: Made, alone: Made) -> None:
    def told(name: str) -> list[tuple[float, str, str]]:
        found = rows(alone.path if name == "GT" else made.path, f"/events/{name}")
        return [(row[ELAPSED] * 1e-9, row["TextLog:level"][0], row["TextLog:text"][0]) for row in found]

    found = rows(made.path, "/events/onsets")
    assert [(row[ELAPSED] * 1e-9, row["TextLog:text"][0]) for row in found] == [(2.0, "counts: 7 car")]
    assert told("GT") == [], "the truth knows at once, which is the onset"
    assert told("PEM") == [(4.0, "INFO", "PEM: 7 car known after 2.00 s by ego, at 60.0 m")]
    assert told("none") == [(4.0, "WARN", "none: 7 car never known")], "9 is too short to judge"


def test_what_becomes_of_a_conflict_is_told(made: Made, tmp_path: Path) -> None:
    mine = made.table[made.table["object_id"] == "7"]
    verdicts = mine.assign(
        conflict=True, braking_pass=[True, True, False, False, False], min_distance_m=[9.0, 8.0, 0.0, 0.25, 0.0],
        impact_speed_mps=[0.0, 0.0, 4.0, 0.0, 10.0],
    )  # fmt: skip
    made.write(tmp_path / "x.rrd", table=verdicts)
    path = tmp_path / "x.rrd"
    [end] = rows(path, "/events/PEM")
    text = "PEM: 7 car known after 2.00 s by ego, at 60.0 m; the ego does not stay clear"
    assert (end["TextLog:level"], end["TextLog:text"]) == (["WARN"], [text])
    assert static(path, "/difference")["TextDocument:text"][0].splitlines() == [
        "**7 car**, counts from 2.00 s on",
        "",
        "| configuration | after | at | the ego | by |",
        "| --- | ---: | ---: | ---: | ---: |",
        "| PEM | 2.00 s | 60.0 m | **hits** at 4.0 m/s | ego |",
        "| pole | 0.00 s | 80.0 m | **too near**, 0.2 m | pole |",
        "| none | never | – | **hits** at 10.0 m/s | – |",
        "",
        "What would help none: the lists of pole instead (pole): known after 0.00 s instead of never.",
    ]
    both = (static(path, entity)["TextDocument:text"] for entity in ("/difference_short", "/difference"))
    assert next(both) == next(both), "one object is all of it"
    # The strong line on the ground, and in its middle the same in short.
    mark = at(path, "/world/PEM/marks/from", 4.0)
    assert mark["Points3D:labels"] == ["7 detected +2.00 s, 60.0 m, does not stay clear"]
    assert mark["Points3D:positions"] == [[30.0, 0.0, 0.0]]
    [line] = at(path, "/world/PEM/marks/from/line", 4.0)["LineStrips3D:strips"]
    assert line == [[0.0, 0.0, 0.0], [60.0, 0.0, 0.0]]


@pytest.mark.parametrize(("many", "lines"), [(3, True), (4, False)])
def test_up_to_three_marks_have_lines(tmp_path: Path, many: int, lines: bool) -> None:
    walkers = [Thing(f"w{k}", "pedestrian", standing(20 + k, 8 * k)) for k in range(many)]
    scene = recording([Thing("ego", "car", standing(0, 0)), *walkers], until_s=0.5)
    path = make(tmp_path / "x.rrd", scene).path
    assert len(at(path, "/world/PEM/marks/from", 0.5)["Points3D:labels"]) == many
    assert static(path, "/world/PEM/marks/from")["Points3D:show_labels"] == [False], "words when it is selected"
    assert bool(rows(path, "/world/PEM/marks/from/line")) == lines


def test_detected_before_the_onset_and_where_nobody_knows(made: Made, tmp_path: Path) -> None:
    table = made.table[made.table["detected"] & (made.table["configuration"] == "PEM")].head(1).assign(
        detection_s=0.5, onset_s=1.0, time_to_detection_s=-0.5, distance_at_detection_m=np.nan
    )  # fmt: skip
    made.write(tmp_path / "x.rrd", table=table)
    found = rows(tmp_path / "x.rrd", "/events/PEM")
    assert [row["TextLog:text"] for row in found] == [["PEM: 7 car known 0.50 s before it counts by ego"]]


def test_the_summary_says_which_run_and_lists_configurations_side_by_side(made: Made) -> None:
    document = static(made.path, "/summary")
    assert document["TextDocument:media_type"] == ["text/markdown"]
    assert document["TextDocument:text"][0].splitlines() == [
        "Run 3 of scene, seed 7, visibility `surface`. The table is over all runs and logs.",
        "",
        "| configuration | GT | a\\|b |",
        "| --- | ---: | ---: |",
        "| n | 2 | 0 |",
        "| ttd_median_s | 0.25 | – |",
        "| interval |  | – |",
    ]


def test_properties(made: Made) -> None:
    own = static(made.path, "/__properties/replay")
    assert (own["log"], own["run"], own["seed"]) == (["scene"], [3], ["7"])
    assert own["configurations"] == BESIDE
    assert own["rerun_sdk"][0].startswith("0.41")
    general = static(made.path, "/__properties")
    assert general["RecordingInfo:name"] == ["scene: run 3"]
    assert np.datetime64(general["RecordingInfo:start_time"][0], "ns").astype(int) == T0_NS


# ------------------------------------------------------------------------------- the file


def test_a_blueprint_inside_and_one_name_per_layout(made: Made, tmp_path: Path) -> None:
    from rerun.chunk import RrdReader
    from rerun.components import FillMode

    reader = RrdReader(made.path)
    [blueprint], [held] = reader.blueprints(), reader.recordings()
    assert blueprint.application_id == held.application_id
    batches = [c.to_record_batch() for c in reader.stream(store=blueprint)]
    names = [
        b.column("ViewBlueprint:display_name")[0].as_py()[0]
        for b in batches
        if "ViewBlueprint:display_name" in b.schema.names
    ]
    assert set(names) >= {
        "PEM · whole run: 1 of 2 known", "pole · whole run: 2 of 2 known",
        "none · whole run: 0 of 2 known",
        "7 car, from 2.0 s", "What difference it made",
        "7 car: position error, m", "GOSPA of all measured objects, m", "Measured objects known (grey: there are)",
        "Events", "Legend",
        "Summary of all runs", "pole: known after 0.00 s",
        "Solid: pole · outlines: PEM · grey: the truth",
    }  # fmt: skip
    pages = [
        b.column("ContainerBlueprint:display_name")[0].as_py()[0]
        for b in batches
        if "ContainerBlueprint:display_name" in b.schema.names
    ]
    assert "GT" not in " ".join(names)
    asked = {
        "7 · 1.5–4.5 s",
        "Overview",
        "Who knew when",
        "Side by side",
        "Why not earlier",
        "What each believes",
        "How far off",
        "Units",
        "In words",
    }
    assert set(pages) >= asked
    modes = {
        batch.schema.metadata[b"rerun:entity_path"].decode().split("/overrides/world/")[-1].split("/")[0]:
        batch.column("Boxes3D:fill_mode")[0].as_py()
        for batch in batches
        if "Boxes3D:fill_mode" in batch.schema.names
    }  # fmt: skip
    assert modes == {"pole": [FillMode.Solid.value], "PEM": [FillMode.MajorWireframe.value]}
    fewer = {name: made.run_tracks[name] for name in ("GT", "PEM")}
    made.write(tmp_path / "x.rrd", run_tracks=fewer)
    [other] = RrdReader(tmp_path / "x.rrd").recordings()
    assert other.application_id != held.application_id


def test_the_large_scene_of_two_has_a_camera_of_its_own_beside_wide_views(made: Made, tmp_path: Path) -> None:
    """With two configurations views of the overview are three times as wide as high; four are as it is."""
    made.write(tmp_path / "x.rrd", run_tracks={name: made.run_tracks[name] for name in ("GT", "PEM", "pole")})
    assert not list(chunks(made.path, "/world/eyes/large"))
    assert len(rows(tmp_path / "x.rrd", "/world/eyes/large")) == len(rows(made.path, "/world/eyes/ego"))


def test_two_writings_compare_equal_and_the_file_is_sound(made: Made, tmp_path: Path) -> None:
    made.write(tmp_path / "same.rrd")
    assert rerun("rrd", "compare", "--unordered", made.path, tmp_path / "same.rrd").returncode == 0
    made.write(tmp_path / "other.rrd", summary=SUMMARY.assign(n=[2, 1]))
    assert rerun("rrd", "compare", "--unordered", made.path, tmp_path / "other.rrd").returncode == 1
    assert rerun("rrd", "verify", made.path).returncode == 0


def test_it_is_there_whole_or_not_at_all(made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import rerun as rr

    assert [p.name for p in made.path.parent.iterdir()] == ["replay.rrd"]
    assert not rr.strict_mode()
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=r"file/x\.rrd: cannot be written: "):
        made.write(tmp_path / "file" / "x.rrd")
    broken = {"GT": made.run_tracks["GT"], "PEM": "no tracks"}
    with pytest.raises(AttributeError):
        made.write(tmp_path / "x.rrd", run_tracks=broken)
    monkeypatch.setenv("RERUN", "off")
    with pytest.raises(OutputError, match=r"x\.rrd: not written, Rerun is switched off"):
        made.write(tmp_path / "x.rrd")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]
    assert not rr.strict_mode()


def test_names_that_are_taken(tmp_path: Path) -> None:
    configurations = {"truth": {"units": "truth", "latency_s": 1.0}, "a b.c": {"units": "truth"}}
    made = make(tmp_path / "x.rrd", approaching(), configurations=configurations)
    assert rows(made.path, "/world/truth/boxes")[0][ELAPSED] == 0
    assert rows(made.path, "/world/configuration\\ truth/boxes")[0][ELAPSED] == 1_000_000_000
    assert len(rows(made.path, "/world/a\\ b.c/boxes")) == 51


def test_nothing_to_measure_no_ego_no_units(tmp_path: Path) -> None:
    nobody = {"objects": {"classes": ["bus"]}, "onset": {"kind": "appears"}}
    scene = recording([Thing("7", "car", driving(100, 0, -10))], until_s=1.0, ego=None)
    made = make(
        tmp_path / "x.rrd", scene, units={"pole": CHANGES["units"]["pole"] | {"pem": "sure"}},
        configurations={"pole": {"units": ["pole"]}}, measure=nobody | {"distance_to": "pole"},
    )  # fmt: skip
    assert len(rows(made.path, "/world/pole/boxes")) == 5
    made = make(
        tmp_path / "y.rrd", approaching(), units={}, pems={}, measure=nobody,
        configurations={"GT": {"units": "truth"}},
    )  # fmt: skip
    assert len(rows(made.path, "/world/GT/boxes")) == 51


def test_at_most_thirty_seven_bytes_a_box_and_a_layout(tmp_path: Path) -> None:
    turn = np.random.default_rng(1)
    things = [Thing("ego", "car", standing(0, 0))]
    for k in range(80):
        x, y, vx, vy = turn.normal(0, [60, 60, 8, 8])
        things.append(Thing(str(k), "car", driving(x, y, vx, vy), yaw_rad=float(np.arctan2(vy, vx))))
    names = {"PEM": {"units": ["ego"]}, **{f"late {k}": {"units": "all", "latency_s": k / 10} for k in range(4)}}
    made = make(
        tmp_path / "x.rrd", recording(things, until_s=15.0), pems=CHANGES["pems"], configurations=names,
        units={"ego": EGO_UNIT | {"pem": "all"}, "pole": CHANGES["units"]["pole"] | {"rate_hz": None}},
    )  # fmt: skip
    boxes = len(made.replay.truth.frame_ix) + sum(
        int(fused_tracks.fused.valid.sum()) for fused_tracks in made.run_tracks.values()
    )
    assert boxes > 70_000
    layout = 770_000  # whatever the number of boxes
    assert made.path.stat().st_size <= 37 * boxes + layout


def test_a_disk_that_is_full_is_an_error_and_leaves_nothing(made: Made, tmp_path: Path) -> None:
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))  # of one file: what is more is refused as on a full disk
    try:
        with pytest.raises(OutputError, match=r"x\.rrd: cannot be written: File too large"):
            made.write(tmp_path / "x.rrd")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(tmp_path.iterdir()) == []


def test_lanes_are_drawn_where_the_log_has_them(tmp_path: Path) -> None:
    from dataclasses import replace

    lines = (np.array([[0.0, 2, 0], [50, 2, 0]]), np.array([[0.0, -2, 0], [50, -2, 0], [60, -3, 0]]))
    made = make(tmp_path / "with.rrd", replace(approaching(), lane_boundaries=lines))
    drawn = static(made.path, "/world/truth/lanes")["LineStrips3D:strips"]
    assert drawn == [line.tolist() for line in lines]
    assert not list(chunks(make(tmp_path / "without.rrd", approaching()).path, "/world/truth/lanes"))
