"""Recordings for the viewer, read back: what each configuration knows of whom we look at, and why not.

Mostly an ego that stands at the origin and looks east, and pedestrians who are measured from their first frame on.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from copem_replay.core.colours import configuration_colours
from copem_replay.core.tracks import Solid, Tracks
from copem_replay.pipeline.sight import compute_sight
from copem_replay.pipeline.status import (
    IN_SIGHT,
    KNOWN,
    LOST,
    STATUSES,
    UNDER_WAY,
    UNMATCHED,
    Status,
    compute_status,
    read_episode_clocks,
)
from copem_replay.viewer.sink import slice_by_frame, split_into_files
from tests.helpers.scenes import EGO_UNIT, Thing, driving, recording, standing
from tests.viewer.test_line_of_sight import PERSON, SECTOR, WALL, lines
from tests.viewer.test_rrd import SUMMARY, Made, at, chunks, make, rows, static

POLE = {"at": [0, 50], "height_m": 6.0, "ground_z_m": 0.0, "pem": "all"}
EGO_ONLY = {"GT": {"units": "truth"}, "PEM": {"units": ["ego"]}}


def told(path: Path, configuration: str, elapsed_s: float) -> list[str]:
    """The sentences, which are shown when it is selected."""
    found: list[str] = at(path, f"/world/{configuration}/status", elapsed_s, "why:why")["why:why"]
    return sorted(found)


def labels(path: Path, configuration: str, elapsed_s: float) -> list[str]:
    """What is written over the objects."""
    return sorted(at(path, f"/world/{configuration}/status", elapsed_s, "Points3D:labels")["Points3D:labels"])


def lane(path: Path, who: str, number: int) -> list[tuple[float, str | None]]:
    """When a configuration's lane changes, and to what; None: it says nothing. Without its name and without times."""
    from rerun.chunk import RrdReader

    begin = f"/lanes/{who.replace(' ', '_')}/{number + 1}_"
    [entity] = {chunk.entity_path for chunk in RrdReader(path).stream() if chunk.entity_path.startswith(begin)}
    said = [(row["elapsed"] / 1e9, (row["StateChange:state"] or [None])[0]) for row in rows(path, entity)]
    plain = [(when, text and re.sub(r"^(.*: )?(-?[0-9.]+ s )?", "", text).rstrip()) for when, text in said]
    return [(when, text) for when, text in plain if text != ""]


# ------------------------------------------------------------------------------- hidden, out of view


@pytest.fixture(scope="module")
def hiding(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """A truck hides pedestrian 2, behind the ego, until it leaves at 1 s; an obstacle hides pedestrian 4."""
    scene = recording(
        [
            Thing("ego", "car", standing(0, 0)),
            Thing("2", "pedestrian", standing(-30, 0), there=lambda t: t < 1.51),
            Thing("3", "truck", standing(-15, 0.5), there=lambda t: t < 0.99),
            Thing("4", "pedestrian", standing(30, 0)),
        ],
        until_s=2.0,
    )
    seen = {"detection": {"kind": "visible_share"}}
    return make(
        tmp_path_factory.mktemp("hiding") / "replay.rrd", scene, obstacles=[WALL], measure=PERSON,
        pems={"sure": [seen], "all": [seen]}, units={"pole": POLE, "ego": EGO_UNIT},
        configurations=EGO_ONLY | {"both": {"units": "all"}},
    )  # fmt: skip


def test_a_solid_of_the_log_is_told_by_its_name(tmp_path: Path) -> None:
    """It is beside an obstacle that hides nothing: each has its own name."""
    scene = recording([Thing("ego", "car", standing(0, 0)), Thing("4", "pedestrian", standing(30, 0))], until_s=0.5)
    corners = ((10.0, -10.0), (12.0, 0.0), (10.0, 10.0))
    scene = replace(scene, scene=replace(scene.scene, solids=(Solid("object 9", corners, 0.0, 40.0),)))
    away = WALL | {"polygon_m": [[-90, 5], [-80, 5], [-80, 9]]}
    seen = [{"detection": {"kind": "visible_share"}}]
    made = make(tmp_path / "x.rrd", scene, obstacles=[away], measure=PERSON, pems={"sure": seen})
    assert told(made.path, "PEM", 0.2) == ["4 hidden from ego by object 9 (share 0.00)"]
    assert labels(made.path, "PEM", 0.2) == ["4 behind object 9"]
    assert lane(made.path, "4 pedestrian", 0) == [(0, "behind object 9 (from ego)")]


def test_who_is_hidden_and_by_whom(hiding: Made) -> None:
    assert told(hiding.path, "PEM", 0.5) == [
        "2 hidden from ego by truck 3 (share 0.00)",
        "4 hidden from ego by obstacle 0 (share 0.00)",
    ]
    # To the middle of the truck, and of the wall, 1 m to 41 m high.
    ego = [0, 0, pytest.approx(1.8)]
    ends = sorted(line.tolist() for line in lines(at(hiding.path, "/world/PEM/hiding", 0.5)))
    assert ends == [[ego, [-15, 0.5, 1.75]], [ego, [10, 0, 21]]]
    # The truck has left: known. Then the pedestrian has, too.
    assert told(hiding.path, "PEM", 1.2) == ["2 known", "4 hidden from ego by obstacle 0 (share 0.00)"]
    assert told(hiding.path, "PEM", 1.8) == ["4 hidden from ego by obstacle 0 (share 0.00)"]
    drawn = rows(hiding.path, "/world/PEM/hiding")
    assert [len(lines(row)) for row in drawn] == [2] * 10 + [1] * 11, (
        "one where it begins to be one, and so on to the end"
    )
    # The pole sees both, and nobody is hidden from those who share their lists.
    assert told(hiding.path, "both", 0.5) == ["2 known", "4 known"]
    assert not list(chunks(hiding.path, "/world/both/hiding"))


def test_the_labels_are_short(hiding: Made) -> None:
    assert labels(hiding.path, "PEM", 0.5) == ["2 behind truck 3", "4 behind obstacle 0"]
    assert labels(hiding.path, "PEM", 1.2) == ["2", "4 behind obstacle 0"]
    assert labels(hiding.path, "both", 0.5) == ["2", "4"], "what is known is only named"


def test_lanes_tell_when_a_configuration_knew(hiding: Made) -> None:
    assert lane(hiding.path, "2 pedestrian", 0) == [(0, "behind truck 3 (from ego)"), (1.0, "known"), (1.6, None)]
    assert lane(hiding.path, "4 pedestrian", 0) == [(0, "behind obstacle 0 (from ego)")]
    assert lane(hiding.path, "4 pedestrian", 1) == [(0, "known")]

    def colour_of(name: str) -> dict[str, int]:
        style = static(hiding.path, f"/lanes/2_pedestrian/{name}")
        return dict(zip(style["StateConfiguration:values"], style["StateConfiguration:colors"], strict=True))

    names = {"1_PEM": "1.00 s known", "2_both": "both: 0.00 s known"}
    known = [colour_of(name)[text] >> 8 for name, text in names.items()]
    boxes = [at(hiding.path, f"/world/{name}/boxes", 1.2)["Boxes3D:colors"][0] >> 8 for name in ("PEM", "both")]
    assert known == boxes
    # One half of the mark stands out from the ground of any theme.
    halves = {(colour_of(name)["from here"] >> 8, colour_of(name)["from here it counts"] >> 8) for name in names}
    assert halves == {(0xFFFFFF, 0)}


def test_lanes_say_whose_they_are_and_how_soon(hiding: Made) -> None:
    """The name before what holds where the axis begins, the time where the object is first known."""

    def said(entity: str) -> list[str | None]:
        return [(row["StateChange:state"] or [None])[0] for row in rows(hiding.path, f"/lanes/{entity}")]

    assert said("2_pedestrian/1_PEM") == ["PEM: behind truck 3 (from ego)", "1.00 s known", None]
    assert said("2_pedestrian/2_both") == ["both: 0.00 s known", None]
    assert said("4_pedestrian/1_PEM") == ["PEM: behind obstacle 0 (from ego)"]


def test_a_flag_without_room_is_on_no_other_span(tmp_path: Path) -> None:
    """He is seen for 0.2 s between two trucks, then hidden until the end: lost. Beside the long name is no room."""
    scene = recording(
        [
            Thing("ego", "car", standing(0, 0)),
            Thing("2", "pedestrian", standing(-30, 0), there=lambda t: t > 5.99),
            Thing("1", "truck", standing(-15, 0.5), there=lambda t: t < 6.99),
            Thing("3", "truck", standing(-15, 0.5), there=lambda t: t > 7.19),
        ],
        until_s=10.0,
    )
    seen = [{"detection": {"kind": "visible_share"}}]
    both = {"PEM": {"units": ["ego"]}, "PEM of the ego and nobody": {"units": ["ego"]}}
    made = make(tmp_path / "x.rrd", scene, measure=PERSON, pems={"sure": seen}, configurations=both)
    assert set(made.table["time_to_detection_s"].round(6)) == {1.0}
    for place, (name, beside) in enumerate(
        [("PEM", "PEM, 1.00 s, lost"), ("PEM of the ego and nobody", "PEM of the ego and nobody")]
    ):
        path = f"/lanes/2_pedestrian/{place + 1}_{name.replace(' ', '_')}"
        style = static(made.path, path)
        label_of = dict(zip(style["StateConfiguration:values"], style["StateConfiguration:labels"], strict=True))
        said = [(row["elapsed"] / 1e9, *row["StateChange:state"]) for row in rows(made.path, path)]
        assert [label_of[text[0]] for _, *text in said if text] == [beside, "behind 1", " ", "behind 3"]
        assert [at for at, *_ in said[-3:]] == pytest.approx([6.0, 7.0, 7.2])


def test_lines_from_units_to_what_they_listed(hiding: Made) -> None:
    # Only from the unit that listed each first: the pole, and the ego when it alone sees the second one.
    ends = [line.tolist() for line in lines(at(hiding.path, "/world/both/listings", 0.5))]
    pole = [0, 50, 6]
    first = hiding.table[hiding.table["configuration"] == "both"].set_index("object_id")["first_unit"]
    assert first.to_dict() == {"2": "pole", "4": "pole"}
    assert sorted(ends) == [[pole, [-30, 0, pytest.approx(0.9)]], [pole, [30, 0, pytest.approx(0.9)]]]
    later = [line.tolist() for line in lines(at(hiding.path, "/world/both/listings", 1.2))]
    assert sorted(later) == sorted(ends), "not from the ego, which sees the second one, too"
    [line] = lines(at(hiding.path, "/world/PEM/listings", 1.2))
    assert line.tolist() == [[0, 0, pytest.approx(1.8)], [-30, 0, pytest.approx(0.9)]]
    assert lines(at(hiding.path, "/world/PEM/listings", 1.8)) == []


def test_the_words_say_how_much_is_seen(tmp_path: Path) -> None:
    # Half as far as the pedestrian, a wall reaches 1 m up; seen from 2 m, it covers his lower part: he is 1.8 m high,
    # the ray over the wall meets the ground at his face.
    low = WALL | {"polygon_m": [[14.5, -9], [14.9, -9], [14.9, 9], [14.5, 9]], "ground_z_m": 0.0, "height_m": 1.5}
    scene = recording([Thing("ego", "car", standing(0, 0)), Thing("9", "pedestrian", standing(30, 0))], until_s=1.0)
    half = [{"when": {"visible_share": [0.5, 1]}, "detection": {"kind": "constant", "probability": 1.0}}]
    made = make(
        tmp_path / "x.rrd", scene, obstacles=[low], measure=PERSON, pems={"sure": half},
        units={"ego": EGO_UNIT | {"height_m": 2.0}},
    )  # fmt: skip
    # From 2 m over 1.5 m at 14.9 m: 1 m up at 29.75 m, give or take the wall's thickness: 0.8 m of 1.8 m are seen.
    assert told(made.path, "PEM", 0.0) == ["9 hidden from ego by obstacle 0 (share 0.44)"]


def test_out_of_range_beside_the_field_and_seen_but_not_listed(tmp_path: Path) -> None:
    scene = recording(
        [
            Thing("ego", "car", standing(0, 0)),
            Thing("6", "pedestrian", standing(90, 0)),
            Thing("7", "pedestrian", standing(0, 30)),
            Thing("8", "pedestrian", standing(30, 0)),
        ],
        until_s=1.0,
    )
    unlucky = [SECTOR[0] | {"detection": {"kind": "constant", "probability": 1e-9}}]
    made = make(tmp_path / "x.rrd", scene, pems={"sure": unlucky}, measure=PERSON)
    assert told(made.path, "PEM", 0.5) == ["6 out of range", "7 outside fields of view", "8 seen by ego, not listed"]
    assert [lane(made.path, f"{k} pedestrian", 0) for k in (6, 7, 8)] == [
        [(0, "out of range or view")],
        [(0, "out of range or view")],
        [(0, "seen by ego, not listed")],
    ]


# ------------------------------------------------------------------------------- under way, stale


def test_lists_under_way_and_what_is_stale(tmp_path: Path) -> None:
    # Half a second late, four lists a second; the pedestrian walks north at 2 m/s and leaves at 1 s.
    scene = recording(
        [
            Thing("ego", "car", standing(0, 0)),
            Thing("9", "pedestrian", driving(30, 0, 0, 2), there=lambda t: t < 1.01),
        ],
        until_s=2.0,
    )
    pole = POLE | {"rate_hz": 4}
    made = make(
        tmp_path / "x.rrd", scene, units={"pole": pole}, measure=PERSON | {"distance_to": "pole"},
        configurations={"late": {"units": ["pole"], "latency_s": 0.5}},
    )  # fmt: skip
    assert told(made.path, "late", 0.0) == ["9 listed by pole, arrives in 0.5 s"]
    assert told(made.path, "late", 0.3) == ["9 listed by pole, arrives in 0.2 s"]
    assert told(made.path, "late", 0.5) == ["9 known, 0.5 s old"]
    assert told(made.path, "late", 0.7) == ["9 known, 0.7 s old"]
    # The words are below where he is, the box is where he was half a second before. North is up in the picture of a
    # site that is longer from west to east; he is 0.5 m long and 1.8 m tall.
    below_m = 0.25 + 1.8 * np.tan(np.deg2rad(27.5 + 78 - 90))
    [word] = at(made.path, "/world/late/status", 0.7, "Points3D:positions")["Points3D:positions"]
    assert word == pytest.approx([30, 1.4 - below_m, 0])
    [box] = at(made.path, "/world/late/boxes", 0.7)["Boxes3D:centers"]
    assert box[:2] == pytest.approx([30, 0])
    # Gone at 1.1 s, still believed until the list of 1.25 s, which has him no more, arrives.
    assert told(made.path, "late", 1.5) == ["9 known, 0.5 s old"]
    [word] = at(made.path, "/world/late/status", 1.5, "Points3D:positions")["Points3D:positions"]
    assert word == pytest.approx([30, 2 - below_m, 0])
    assert lane(made.path, "9 pedestrian", 0) == [(0, "on its way from pole"), (0.5, "known"), (1.75, None)]


# ------------------------------------------------------------------------------- GOSPA, what is left out


def test_gospa_is_of_the_measured_objects(tmp_path: Path) -> None:
    # Three pedestrians, one hidden from the ego: exact, he is missed, √(3² / 2). Half a second late the two that walk
    # at 2 m/s are 1 m off: √(1 + 1). Cars do not count.
    scene = recording(
        [
            Thing("ego", "car", standing(0, 0)),
            Thing("5", "car", standing(0, 9)),
            Thing("7", "pedestrian", driving(5, 15, 2, 0)),
            Thing("8", "pedestrian", driving(5, -15, 2, 0)),
            Thing("9", "pedestrian", standing(30, 0)),
        ],
        until_s=1.0,
    )
    near = [{"when": {"visible_share": [0.5, 1]}, "detection": {"kind": "constant", "probability": 1.0}}]
    alike: dict[str, Any] = {"obstacles": [WALL], "measure": PERSON, "pems": {"sure": near}}
    truths = {"GT": {"units": "truth"}, "late": {"units": "truth", "latency_s": 0.5}}
    make(tmp_path / "x.rrd", scene, **alike, configurations={"PEM": {"units": ["ego"]}})
    make(tmp_path / "truths.rrd", scene, **alike, configurations=truths)

    def values(name: str) -> list[float]:
        path = tmp_path / ("truths.rrd" if name in truths else "x.rrd")
        return [row["Scalars:scalars"][0] for row in rows(path, f"/plots/gospa/{name}")]

    assert values("GT") == [0.0] * 11
    assert values("PEM") == pytest.approx([np.sqrt(4.5)] * 11)
    # Lists that arrive after the end are about nobody: three entries too many.
    assert values("late") == pytest.approx([np.sqrt(2)] * 6 + [np.sqrt(3 * 4.5)] * 5)


def test_seven_configurations_a_file_and_nothing_dropped() -> None:
    names = [f"c{k}" for k in range(1, 19)]
    parts = split_into_files(names)
    assert [part.path(Path("out/replay_4.rrd")).name for part in parts] == [
        "replay_4.rrd",
        "replay_4.configurations_8-14.rrd",
        "replay_4.configurations_15-18.rrd",
    ]
    assert [name for part in parts for name in part.configurations] == names
    assert [part.infix for part in split_into_files(names[:7])] == [""]
    assert [part.infix for part in split_into_files(names[:8])] == ["", ".configurations_8"]
    beside = split_into_files(["base", *names[:8]], dict.fromkeys(names[:8], "base"))
    assert [part.configurations for part in beside] == [("base", *names[:6]), ("base", *names[6:8])]
    assert [part.infix for part in beside] == ["", ".configurations_8-9"]


def test_further_configurations_are_in_further_files(tmp_path: Path) -> None:
    from copem_replay.api.run import list_exporters
    from copem_replay.viewer import write_rrd

    scene = recording([Thing("ego", "car", standing(0, 0)), Thing("9", "pedestrian", standing(30, 0))], until_s=1.0)
    many = {f"GT{k}": {"units": "truth", "latency_s": k / 10} for k in range(8)}
    made = make(tmp_path / "x.rrd", scene, measure=PERSON, configurations=many)
    said = write_rrd(tmp_path / "y.rrd", made.replay, made.given, [made.run_tracks], made.table, SUMMARY, 3)
    assert said == ["y.rrd: GT7 in y.configurations_8.rrd"]
    first, second = tmp_path / "y.rrd", tmp_path / "y.configurations_8.rrd"
    assert [name for kind in list_exporters() for name in kind.files("y", 8)] == ["y.mcap", first.name, second.name]
    assert "In further files: y.configurations_8.rrd." in static(first, "/summary")["TextDocument:text"][0]
    assert [bool(list(chunks(path, "/world/GT6/boxes"))) for path in (first, second)] == [True, False]
    assert [bool(list(chunks(path, "/world/GT7/boxes"))) for path in (first, second)] == [False, True]
    every = list(configuration_colours(many, ()).values())
    for path, name, place in ((first, "GT6", 6), (second, "GT7", 7)):
        red, green, blue = every[place]
        drawn = at(path, f"/world/{name}/boxes", 0.95)["Boxes3D:colors"][0] >> 8
        assert drawn == red << 16 | green << 8 | blue, "by its place among all"


# ------------------------------------------------------------------------------- names, pieces


def test_long_ids_are_shortened_where_they_are_drawn(tmp_path: Path) -> None:
    ids = ("8d2f0c5e-aaaa-4444-9999-000000000001", "8d2f0c5e-bbbb-4444-9999-000000000002")
    scene = recording(
        [Thing("ego", "car", standing(0, 0)), *(Thing(i, "pedestrian", standing(30, k)) for k, i in enumerate(ids))],
        until_s=1.0,
    )
    made = make(tmp_path / "x.rrd", scene, measure=PERSON, configurations=EGO_ONLY)
    assert told(made.path, "PEM", 0.5) == ["8d2f0c5e-a known", "8d2f0c5e-b known"]
    assert lane(made.path, "8d2f0c5e-a pedestrian", 0) == [(0, "known")]


def test_pieces_are_whole_lists_and_together_all(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = recording(
        [Thing(str(k), "car", standing(k, 0), there=lambda t, k=k: t > k / 10 - 0.01) for k in range(5)], until_s=1.0
    )
    truth = scene.truth
    monkeypatch.setattr("copem_replay.viewer.sink.SLICE_ROWS", 7)
    pieces = list(slice_by_frame(truth, truth.valid[0]))
    assert np.concatenate([counts for _, counts, _ in pieces]).tolist() == [1, 2, 3, 4, *[5] * 7]
    assert [rows.size for rows, _, _ in pieces] == [6, 4, *[5] * 7], "as many lists as there is room for, one at least"
    together = np.concatenate([rows for rows, _, _ in pieces])
    assert sorted(together) == list(range(len(truth.frame_ix)))
    assert (np.diff(truth.frame_ix[together]) >= 0).all()
    assert np.concatenate([times for _, _, times in pieces]).tolist() == [k * 100_000_000 for k in range(11)]


def test_an_entry_that_no_object_is_matched_with(tmp_path: Path) -> None:
    """The ego lists the pedestrian 10 m east of where he is: the ideal fusion knows whom it is about, gnn does not.

    Its lists are 0.3 s late; while none has arrived, one is under way.
    """
    scene = recording([Thing("ego", "car", standing(0, 0)), Thing("2", "pedestrian", standing(20, 0))], until_s=1.0)
    wrong = {"kind": "gaussian", "covariance_m2": [[0.01, 0.0], [0.0, 0.01]], "mean_m": [10.0, 0.0]}
    made = make(
        tmp_path / "replay.rrd", scene, measure=PERSON,
        pems={"sure": [{"detection": {"kind": "constant", "probability": 1.0}, "error": wrong}]},
        configurations={
            name: {"units": ["ego"], "latency_s": 0.3, "fusion": {"kind": name}} for name in ("ideal", "gnn")
        },
    )  # fmt: skip
    for now_s in (0.35, 0.55, 0.95):
        assert told(made.path, "gnn", now_s) == ["2 listed by ego, no entry matched"]
        assert told(made.path, "ideal", now_s) == ["2 known, 0.3 s old"]
    assert told(made.path, "gnn", 0.05) == ["2 listed by ego, arrives in 0.3 s"]
    assert lane(made.path, "2 pedestrian", 1) == [(0.0, "on its way from ego"), (0.3, "unmatched")]


def test_false_entries_are_crossed_and_counted(tmp_path: Path) -> None:
    """The same pedestrian, listed 10 m off: no entry of gnn is matched with him."""
    scene = recording([Thing("ego", "car", standing(0, 0)), Thing("2", "pedestrian", standing(20, 0))], until_s=0.5)
    wrong = {"kind": "gaussian", "covariance_m2": [[0.01, 0.0], [0.0, 0.01]], "mean_m": [10.0, 0.0]}
    made = make(
        tmp_path / "replay.rrd", scene, measure=PERSON,
        pems={"sure": [{"detection": {"kind": "constant", "probability": 1.0}, "error": wrong}]},
        configurations={name: {"units": ["ego"], "fusion": {"kind": name}} for name in ("ideal", "gnn")},
    )  # fmt: skip
    assert not rows(made.path, "/world/ideal/false")
    assert {tuple(row["Boxes3D:centers"]) for row in rows(made.path, "/world/gnn/boxes")} == {()}
    drawn, fused = rows(made.path, "/world/gnn/false"), made.run_tracks["gnn"].fused
    assert len(drawn) == 6
    for frame, row in enumerate(drawn):
        [entry] = np.flatnonzero((fused.frame_ix == frame) & fused.valid[0])
        points = np.array([line.tolist() for line in lines(row)])
        assert points.shape == (6, 3, 3), "four corners, two lines across"
        corners, across = points[:4], points[4:]
        middle = [fused.x_m[0, entry], fused.y_m[0, entry], fused.z_m[0, entry] + fused.height_m[0, entry] / 2]
        assert across[:, 1].tolist() == [pytest.approx(middle, abs=1e-5)] * 2
        assert across[:, [0, 2]].mean(axis=1).tolist() == [pytest.approx(middle, abs=1e-5)] * 2
        length_m, width_m = fused.length_m[0, entry], fused.width_m[0, entry]
        across_m = np.linalg.norm(across[:, 2] - across[:, 0], axis=1)
        assert np.hypot(length_m, width_m) < 4.0
        assert across_m.tolist() == [pytest.approx(4.0, abs=1e-5)] * 2, (
            "a pedestrian alone would be too small to be seen"
        )
        from_middle_m = np.linalg.norm(corners[:, 1] - middle, axis=1)
        assert from_middle_m.tolist() == [pytest.approx(np.hypot(length_m, width_m) / 2, abs=1e-5)] * 4
        around_m = np.linalg.norm(np.diff(corners, axis=1), axis=2).sum()
        assert around_m == pytest.approx(0.6 * 2 * (length_m + width_m), abs=1e-5), "three fifths of the outline"
    assert titles(made.path) >= {
        "gnn · whole run: 0 of 1 known",
        "ideal · whole run: 1 of 1 known",
    }


def titles(path: Path) -> set[str]:
    from rerun.chunk import RrdReader

    reader = RrdReader(path)
    [blueprint] = reader.blueprints()
    batches = [chunk.to_record_batch() for chunk in reader.stream(store=blueprint)]
    column = "ViewBlueprint:display_name"
    return {batch.column(column)[0].as_py()[0] for batch in batches if column in batch.schema.names}


def test_a_list_that_never_arrives_is_lost(hiding: Made) -> None:
    fused_tracks = hiding.run_tracks["both"]
    # Pedestrian 4 is in the pole's lists only: those of the first half of a second never arrive.
    arrives = np.where(fused_tracks.received.captured_s < 0.45, np.inf, fused_tracks.received.arrives_s)
    silent = fused_tracks.fused.valid & (fused_tracks.fused.arrives_s[:, fused_tracks.fused.frame_ix] > 0.45)
    lossy = replace(
        fused_tracks,
        received=replace(fused_tracks.received, arrives_s=arrives),
        fused=replace(fused_tracks.fused, valid=silent),
    )
    seen = compute_sight(hiding.replay, hiding.given, [hiding.replay.scene.object_number["4"]])
    clock = read_episode_clocks(hiding.replay.scene, hiding.table, "both")
    made = compute_status(hiding.replay, hiding.given, "both", lossy, seen, clock)
    early = made.elapsed_ns < 450_000_000
    assert set(made.status[early, 0].tolist()) == {LOST}
    assert set(made.status[~early, 0].tolist()) == {KNOWN}
    assert UNDER_WAY not in made.status


def fused_by_nobody(hiding: Made, received: Tracks) -> Status:
    """The status of pedestrian 4 with `both`, which receives these lists and fuses nothing."""
    tracks, number = hiding.run_tracks["both"], hiding.replay.scene.object_number["4"]
    nothing = replace(tracks, received=received, fused=replace(tracks.fused, valid=np.zeros_like(tracks.fused.valid)))
    clock = read_episode_clocks(hiding.replay.scene, hiding.table.assign(detected=False, detection_s=np.nan), "both")
    sight = compute_sight(hiding.replay, hiding.given, [number])
    return compute_status(hiding.replay, hiding.given, "both", nothing, sight, clock)


def test_a_list_that_arrives_after_the_last_fused_one_is_on_its_way(hiding: Made) -> None:
    received = hiding.run_tracks["both"].received
    made = fused_by_nobody(hiding, replace(received, arrives_s=received.captured_s[None] + 10.0))
    there = made.elapsed_ns < 2_000_000_000
    assert set(made.status[there, 0].tolist()) == {UNDER_WAY}
    assert made.until_s[0, 0] == pytest.approx(10.0)


@pytest.mark.parametrize("arrives", [False, True])
def test_what_a_units_next_list_no_longer_holds_is_neither_lost_nor_unmatched(hiding: Made, arrives: bool) -> None:
    """Two lists of the pole hold pedestrian 4, at 0 and 0.1 s, the next ones do not; no fused list ever does."""
    received, number = hiding.run_tracks["both"].received, hiding.replay.scene.object_number["4"]
    late = received.captured_s[received.frame_ix] > 0.15
    received = replace(received, valid=received.valid & ~(late & (received.row_object_ix == number)))
    if not arrives:
        received = replace(received, arrives_s=np.full_like(received.arrives_s, np.inf))
    made = fused_by_nobody(hiding, received)
    early = made.elapsed_ns < 199_000_000
    assert {STATUSES[k] for k in made.status[early, 0]} == {STATUSES[UNMATCHED if arrives else LOST]}
    assert {STATUSES[k] for k in made.status[~early, 0]} == {STATUSES[IN_SIGHT]}


def test_nothing_that_is_written_is_nan(hiding: Made) -> None:
    from rerun.chunk import RrdReader

    def numbers(value: Any) -> list[float]:
        if isinstance(value, list):
            return [n for v in value for n in numbers(v)]
        return [value] if isinstance(value, float) else []

    for chunk in RrdReader(hiding.path).stream():
        batch = chunk.to_record_batch()
        columns = [batch.column(n).to_pylist() for n in batch.schema.names if ":" in n]
        assert np.isfinite(numbers(columns)).all(), chunk.entity_path
