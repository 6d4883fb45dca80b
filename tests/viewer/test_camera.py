"""The camera on the ego: what is in its picture, by the corners of boxes, with a camera model written plainly here.

On every sample, and on every recording of shared/data, with the experiment that `init` drafts.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import copem_replay as cr
from copem_replay.api.recordings import read_recordings
from copem_replay.core.tracks import Float
from copem_replay.experiment.draft.survey import survey_recording
from copem_replay.experiment.draft.template import format_draft
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.detections_table import first_episodes
from copem_replay.pipeline.expansion import resolve_for_run
from copem_replay.pipeline.prepare import Replay, prepare_log
from copem_replay.pipeline.replay import replay_block
from copem_replay.results.shown_objects import axis_s, choose_shown_objects, find_opening_s, select_differing_rows
from copem_replay.viewer.blueprint import select_perceiving, view_aspect
from copem_replay.viewer.camera import (
    TOGETHER_M,
    Camera,
    camera_following,
    camera_on_ego,
    follow_episodes,
    write_false_words,
    write_moving_origin,
)
from copem_replay.viewer.sink import RecordingSink, file_stream
from tests.helpers.recordings import SHARED
from tests.helpers.scenes import Thing, driving, experiment, recording, standing
from tests.viewer.test_rrd import rows

SAMPLES = ["tc016d", "tc016d_beyond", "crossing", "crossing_memory", "crossing_radio", "crossing_units"]
RECORDINGS = sorted(path.stem for path in SHARED.glob("*.mcap")) or ["none"]
LOGS = Path(__file__).parents[2] / "logs"
TALL = np.tan(np.deg2rad(55) / 2)
"""Half the height of the picture at 1 m: the viewer's field of view is 55° high."""


def prepared(text: Path) -> tuple[Replay, Experiment, Any]:
    asked = cr.load_experiment(text)
    asked = asked.model_copy(update={"sweep": None})
    scene = read_recordings(asked)[0]
    alone = resolve_for_log(asked, scene.scene.log)
    given = resolve_for_run(alone, scene.scene, 0)
    replay = prepare_log(scene, given, onsets_of=alone)
    return replay, given, first_episodes(replay_block(replay, given, np.array([0])))


def written(
    path: Path, replay: Replay, given: Experiment, stories: dict[int, tuple[float, float]], aspect: float = 1.5
) -> Camera:
    """The camera; the file at the path has the entity that it follows."""
    eye = camera_on_ego(replay, given, stories, aspect)
    if eye.object_ix is not None:
        with file_stream(path, "a", "b") as rec:
            picture = follow_episodes(replay, given, eye, stories)
            write_moving_origin(RecordingSink(rec, replay.scene.t0_ns), replay, picture)
    return eye


def origins(path: Path, eye: Camera, entity: str = "ego") -> list[tuple[float, Float, float, float]]:
    """Instant (s), place (3,), turn and scale of what the camera follows."""
    if eye.object_ix is None:
        return [(0.0, np.zeros(3), 0.0, 1.0)]
    found = []
    for row in rows(path, f"/world/eyes/{entity}"):
        [place], [size] = (row[f"Transform3D:{name}"] for name in ("translation", "scale"))
        [turn] = row.get("Transform3D:rotation_axis_angle", [{"axis": [0, 0, 1], "angle": 0.0}])
        assert size[0] == size[1] == size[2]
        assert turn["axis"] == [0, 0, 1]
        found.append((row["elapsed"] / 1e9, np.array(place), float(turn["angle"]), float(size[0])))
    return found


def picture(eye: Camera, origin: tuple[float, Float, float, float], places: Float, aspect: float = 1.5) -> Float:
    """Where places (K, 3) of the world are in the picture: (K, 2), −1 … 1 from left to right and from below."""
    _, at, turn, scale = origin
    cos, sin = np.cos(turn), np.sin(turn)
    inside = (places - at) @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) / scale
    depth = eye.target_m - eye.place_m
    depth = depth / np.linalg.norm(depth)
    right = np.cross(depth, [0, 0, 1])
    right /= np.linalg.norm(right)
    seen = inside - eye.place_m
    far = (seen @ depth)[:, None] * TALL
    return np.stack([seen @ right, seen @ np.cross(right, depth)], axis=1) / far / [aspect, 1]


def corners(replay: Replay, row: int) -> Float:
    """(8, 3) of a true box."""
    truth = replay.truth
    half = np.array([truth.length_m[0, row], truth.width_m[0, row], truth.height_m[0, row]]) / 2
    signs = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) * half
    cos, sin = np.cos(truth.yaw_rad[0, row]), np.sin(truth.yaw_rad[0, row])
    turned = signs @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    return np.asarray(turned + np.array([truth.x_m[0, row], truth.y_m[0, row], truth.z_m[0, row]]))


def share_inside(replay: Replay, given: Experiment, table: Any, path: Path) -> tuple[float, int]:
    """Share of object × frame, of the shown objects during their axes, with all of the box in the picture; how many."""
    shown = choose_shown_objects(replay.scene, replay.truth, given, table).object_ix
    names = replay.scene.object_ids
    stories = {k: axis_s(table[table["object_id"] == names[k]], replay.scene.end_s) for k in shown}
    perceiving = [name for name, asked in given.configurations.items() if asked.units != "truth"]
    aspect = view_aspect(given, perceiving)
    eye = written(path, replay, given, stories, aspect)
    found, inside, truth = origins(path, eye), [], replay.truth
    times = np.array([at for at, *_ in found])
    for k, (first_s, last_s) in stories.items():
        for row in np.flatnonzero(truth.row_object_ix == k).tolist():
            now = truth.row_captured_s[row]
            if first_s <= now <= last_s:
                origin = found[max(int(np.searchsorted(times, now + 1e-6, side="right")) - 1, 0)]
                inside.append(bool(np.abs(picture(eye, origin, corners(replay, row), aspect)).max() <= 1))
    return float(np.mean(inside)), len(inside)


def differs_at_opening(replay: Replay, given: Experiment, table: Any) -> bool:
    shown = choose_shown_objects(replay.scene, replay.truth, given, table).object_ix
    by_object = [table[table["object_id"] == replay.scene.object_ids[k]] for k in shown]
    opens_s = find_opening_s(given, by_object)
    known = [(select_differing_rows(given, rows)["detection_s"] <= opens_s).nunique() for rows in by_object]
    apart = [select_differing_rows(given, rows)["detection_s"].nunique(dropna=False) for rows in by_object]
    return max(known) == 2 or max(apart) == 1


@pytest.mark.parametrize("name", SAMPLES)
def test_nine_of_ten_boxes_of_the_samples_are_in_the_picture(name: str, tmp_path: Path) -> None:
    replay, given, table = prepared(LOGS / f"{name}.yaml")
    share, count = share_inside(replay, given, table, tmp_path / "x.rrd")
    assert count > 20
    assert share >= 0.9
    assert differs_at_opening(replay, given, table)
    if name.startswith("crossing"):
        assert len(choose_shown_objects(replay.scene, replay.truth, given, table).object_ix) == 6


@pytest.mark.long
@pytest.mark.parametrize("name", RECORDINGS)
def test_nine_of_ten_boxes_of_recordings_are_in_the_picture(name: str, tmp_path: Path) -> None:
    if not (SHARED / f"{name}.mcap").exists():
        pytest.skip("no shared/data beside the project")
    (tmp_path / "e.yaml").write_text(format_draft(survey_recording(SHARED / f"{name}.mcap")))
    replay, given, table = prepared(tmp_path / "e.yaml")
    share, count = share_inside(replay, given, table, tmp_path / "x.rrd")
    assert count > 20
    assert share >= 0.9
    assert differs_at_opening(replay, given, table)
    assert len(given.configurations) <= 7, "what is drafted fits one file"


def follow(path: Path, stories: dict[str, tuple[float, float]], left_m: float = 100.0) -> tuple[Replay, Camera]:
    """The ego drives north at 10 m/s from the origin; a car goes ahead of it, another stands to the left."""
    scene = recording(
        [
            Thing("ego", "car", driving(0, 0, 0, 10), yaw_rad=np.pi / 2),
            Thing("7", "car", driving(0, 30, 0, 10), yaw_rad=np.pi / 2),
            Thing("61", "car", standing(-left_m, 50)),
        ],
        until_s=10.0,
    )
    given = experiment(configurations={"GT": {"units": "truth"}})
    replay = prepare_log(scene, given)
    numbers = replay.scene.object_number
    return replay, written(path, replay, given, {numbers[name]: story for name, story in stories.items()})


def test_sixty_metres_wide_twenty_ahead_and_turned_with_the_ego_without_a_story(tmp_path: Path) -> None:
    _, eye = follow(tmp_path / "x.rrd", {})
    down = eye.target_m - eye.place_m
    assert 75 <= np.rad2deg(np.arctan2(-down[2], np.hypot(*down[:2]))) <= 80
    for origin in origins(tmp_path / "x.rrd", eye):
        north = 10 * origin[0]
        middle, ahead, left = picture(
            eye, origin, np.array([[0, north + 20, 0], [0, north + 50, 0], [-15, north + 20, 0]])
        )
        assert middle == pytest.approx([0, 0], abs=1e-6)
        assert ahead == pytest.approx([1, 0], abs=0.01), "the ego drives to the right; 30 m are half of the width"
        assert left[0] == pytest.approx(0, abs=1e-6)
        assert 0.5 < left[1] < 1


def test_the_picture_holds_the_ego_and_the_object_of_a_story_and_nothing_more(tmp_path: Path) -> None:
    """One 30 m ahead is seen from nearer than without a story, one 45 m to the left from farther away."""
    _, eye = follow(tmp_path / "x.rrd", {"7": (0.0, 2.0), "61": (6.0, 7.0)}, left_m=45.0)
    found = {round(origin[0], 1): origin for origin in origins(tmp_path / "x.rrd", eye)}
    for at, other in ((1.0, [0.0, 40.0, 0.0]), (6.0, [-45.0, 50.0, 0.0]), (7.0, [-45.0, 50.0, 0.0])):
        both = picture(eye, found[at], np.array([[0.0, 10 * at, 0.0], other]))
        assert 0.5 < np.abs(both).max(axis=1).min() <= np.abs(both).max() < 0.8, "as large as words beside it allow"
    scales = {at: scale for at, (*_, scale) in found.items()}
    assert scales[10.0] == pytest.approx(60 / 36)
    assert scales[1.0] < scales[10.0] < scales[6.0] <= 180 / 36
    assert 0 < np.abs(np.diff([*scales.values()])).max() < 0.5, "in a tenth of a second"


def test_a_story_too_far_away_does_not_change_the_picture(tmp_path: Path) -> None:
    """150 m beside the way is more than fits."""
    _, eye = follow(tmp_path / "x.rrd", {"61": (4.0, 5.0)}, left_m=150.0)
    scales = [scale for *_, scale in origins(tmp_path / "x.rrd", eye)]
    assert scales == pytest.approx([60 / 36] * len(scales))


def test_an_arrow_for_what_is_outside(tmp_path: Path) -> None:
    """100 m to the left of the ego's way: up in the picture. The car ahead is inside."""
    _, eye = follow(tmp_path / "x.rrd", {"61": (-9.0, -8.0), "7": (-9.0, -8.0)})
    found = {round(row["elapsed"] / 1e9, 1): row for row in rows(tmp_path / "x.rrd", "/world/eyes/ego/arrows")}
    assert found[0.0]["Points3D:labels"] == ["61 ↑ 112 m"], "√(100² + 50²)"
    assert found[5.0]["Points3D:labels"] == ["61 ↑ 100 m"]
    [place] = found[5.0]["Points3D:positions"]
    still = (0.0, np.zeros(3), 0.0, 1.0)  # it is drawn in the picture's own frame
    [[across, high]] = picture(eye, still, np.array([place]))
    assert 0.8 < high < 0.9
    assert -0.2 < across < 0, "the target is 20 m ahead of the ego"


def test_words_at_the_edge_are_apart(tmp_path: Path) -> None:
    """Three cars far to the left of the ego's way, one behind the other as seen from it."""
    cars = [Thing(name, "car", standing(-100 - 8 * k, 20)) for k, name in enumerate(("61", "62", "63"))]
    scene = recording([Thing("ego", "car", driving(0, 0, 0, 1), yaw_rad=np.pi / 2), *cars], until_s=4.0)
    given = experiment(configurations={"GT": {"units": "truth"}})
    written(tmp_path / "x.rrd", prepare_log(scene, given), given, dict.fromkeys((1, 2, 3), (-9.0, -8.0)))
    eye = camera_on_ego(prepare_log(scene, given), given, {}, 1.5)
    for row in rows(tmp_path / "x.rrd", "/world/eyes/ego/arrows"):
        assert len(row["Points3D:labels"]) == 3
        seen = picture(eye, (0.0, np.zeros(3), 0.0, 1.0), np.array(row["Points3D:positions"]))
        assert np.abs(seen).max() < 0.9
        apart = np.abs(seen[:, None] - seen)[np.triu_indices(3, 1)]
        assert ((apart[:, 0] > 0.39) | (apart[:, 1] > 0.15)).all()


def test_the_nearest_false_entries_are_named_by_their_places(tmp_path: Path) -> None:
    """The ego drives north, at 10 m/s; in its second list there is nothing about no object."""
    replay, eye = follow(tmp_path / "x.rrd", {})
    moving = follow_episodes(replay, experiment(configurations={"GT": {"units": "truth"}}), eye, {})
    entries = np.array([[-6, 34, 1], [3, 4, 1], [0, 61, 1], [70, 10, 1], [0, 200, 1]], dtype=float).T
    path = tmp_path / "y.rrd"
    with file_stream(path, "a", "b") as rec:
        out = RecordingSink(rec, replay.scene.t0_ns)
        lists_ns = np.array([1_000_000_000, 2_000_000_000])
        write_false_words(out, "PEM", moving, lists_ns, np.array([5, 0]), entries)
        write_false_words(out, "far", moving, lists_ns[:1], np.array([2]), entries[:, 3:])
    found = rows(path, "/world/eyes/ego/false/PEM")
    assert [row["Points3D:labels"] for row in found] == [
        ["false: 6 m behind, 3 m right", "false: 24 m ahead, 6 m left", "false → 51 m"], []
    ]  # fmt: skip
    [origin] = [origin for origin in origins(tmp_path / "x.rrd", eye) if origin[0] == pytest.approx(1.0)]
    still = (0.0, np.zeros(3), 0.0, 1.0)  # they are drawn in the picture's own frame
    behind, ahead, edge = picture(eye, still, np.array(found[0]["Points3D:positions"]))
    crosses = picture(eye, origin, entries.T[[1, 0]])
    for word, cross in zip((behind, ahead), crosses, strict=True):
        assert word[0] == pytest.approx(cross[0], abs=0.02)
        assert 0.05 < cross[1] - word[1] < 0.15, "below its cross"
    assert edge == pytest.approx([0.85, 0.0], abs=0.1)
    [far] = rows(path, "/world/eyes/ego/false/far")
    assert far["Points3D:labels"] == ["false ↓ 70 m"], "the other one is farther away than pictures are wide"


def test_without_an_ego_the_story_and_units_around_are_in_view_and_without_one_the_whole_site(tmp_path: Path) -> None:
    """The car's first second, 14 m long, and the pole 22 m from its end; the other car is 400 m away."""
    scene = recording(
        [Thing("7", "car", driving(40, 0, -10, 10)), Thing("8", "car", driving(-300, -200, 50, 40))],
        until_s=8.0, ego=None,
    )  # fmt: skip
    pole = {"at": [20, -10], "height_m": 6.0, "ground_z_m": 0.0, "pem": "sure"}
    given = experiment(
        units={"pole": pole}, configurations={"pole": {"units": ["pole"]}}, measure={"distance_to": "pole"}
    )
    replay = prepare_log(scene, given)
    rows_of = replay.truth.row_object_ix == replay.scene.object_number["7"]
    story = rows_of & (replay.truth.row_captured_s <= 1.0)
    for stories, kept, wide in (({replay.scene.object_number["7"]: (0.0, 1.0)}, story, 1.3), ({}, rows_of | True, 1.5)):
        eye = written(tmp_path / f"{wide}.rrd", replay, given, stories)
        [still] = origins(tmp_path / f"{wide}.rrd", eye)
        every = np.concatenate([corners(replay, row) for row in np.flatnonzero(kept)])
        seen = picture(eye, still, np.concatenate([every, [[20, -10, 0]]]))
        assert np.abs(seen).max() <= 1.02
        assert np.ptp(seen, axis=0).max() > wide, "as large as it can be, but for words at the edge"
    assert select_perceiving(given, ["pole"]) == ["pole"]


def test_a_near_view_holds_the_ego_and_masts_of_the_object_from_onset_to_detection(tmp_path: Path) -> None:
    """A pole 40 m beside it, and the ego that comes from 50 m to 10 m; a pole that is too far away changes nothing."""
    scene = recording(
        [Thing("ego", "car", driving(-50, 0, 10, 0)), Thing("7", "pedestrian", standing(0, 0))], until_s=4.0
    )
    far_m = TOGETHER_M + 1
    units = {
        name: {"at": [x, y], "height_m": 6.0, "ground_z_m": 0.0, "pem": "sure"}
        for name, (x, y) in {"pole": (0, 40), "far": (0, -far_m)}.items()
    }
    given = experiment(units=units, configurations={"both": {"units": ["pole", "far"]}})
    replay = prepare_log(scene, given)
    k = scene.scene.object_number["7"]
    table = pd.DataFrame({"object_id": ["7"], "onset_s": [0.0]})
    eye = camera_following(replay, given, table, k, 1.7)
    path = tmp_path / "x.rrd"
    with file_stream(path, "a", "b") as rec:
        moving = follow_episodes(replay, given, eye, {k: (0.0, 4.0)}, {k: ["pole", "far"]})
        write_moving_origin(RecordingSink(rec, 0), replay, moving)
    scales = []
    for origin in origins(path, eye, "7_pedestrian"):
        held = np.array([[-50 + 10 * origin[0], 0, 0.75], [0, 0, 0.75], [0, 40, 6]])
        assert np.abs(picture(eye, origin, held, 1.7)).max() < 0.85
        assert np.abs(picture(eye, origin, np.array([[0.0, -far_m, 6.0]]), 1.7)).max() > 1
        assert origin[2] == 0.0, "it does not turn"
        scales.append(origin[3])
    assert len(scales) > 30
    assert scales[0] > 1.1 * scales[-1] >= 1.1, "as near as the ego allows"
