"""Recordings for the viewer, read back: what each configuration knows of whom we look at, and why not.

Mostly an ego that stands at the origin and looks east, and pedestrians who are measured from their first frame on.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from copem_replay.viewer.rrd import viewed
from copem_replay.viewer.sink import slices
from copem_replay.viewer.status import STATUSES
from tests.helpers.scenes import EGO_UNIT, Thing, driving, experiment, recording, standing
from tests.viewer.test_line_of_sight import PERSON, SECTOR, WALL, lines
from tests.viewer.test_rrd import SUMMARY, Made, at, chunks, make, rows, static

POLE = {"at": [0, 50], "height_m": 6.0, "ground_z_m": 0.0, "pem": "all"}
EGO_ONLY = {"GT": {"units": "truth"}, "PEM": {"units": ["ego"]}}


def told(path: Path, configuration: str, elapsed_s: float) -> list[str]:
    found: list[str] = at(path, f"/world/{configuration}/status", elapsed_s)["Points3D:labels"]
    return found


def lane(path: Path, who: str, number: int) -> list[tuple[float, str]]:
    """When a configuration's lane changes, and to what."""
    found = [
        (row["elapsed"] / 1e9, row["StateChange:state"][number])
        for row in rows(path, f"/lanes/{who}".replace(" ", "\\ "))
    ]
    return [now for k, now in enumerate(found) if k == 0 or now[1] != found[k - 1][1]]


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


def test_who_is_hidden_and_by_whom(hiding: Made) -> None:
    assert told(hiding.path, "PEM", 0.5) == [
        "2 hidden from ego by 3 (share 0.00)",
        "4 hidden from ego by obstacle 0 (share 0.00)",
    ]
    # To the middle of the truck, and of the wall, 1 m to 41 m high.
    ego = [0, 0, pytest.approx(1.8)]
    ends = [line.tolist() for line in lines(at(hiding.path, "/world/PEM/hiding", 0.5))]
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


def test_lanes_tell_when_a_configuration_knew(hiding: Made) -> None:
    assert lane(hiding.path, "2 pedestrian", 0) == [(0, "GT known"), (1.6, "GT absent")]
    assert lane(hiding.path, "2 pedestrian", 1) == [(0, "PEM hidden"), (1.0, "PEM known"), (1.6, "PEM absent")]
    assert lane(hiding.path, "4 pedestrian", 1) == [(0, "PEM hidden")]
    assert lane(hiding.path, "4 pedestrian", 2) == [(0, "both known")]
    style = static(hiding.path, "/lanes/2\\ pedestrian")
    colour_of = dict(zip(style["StateConfiguration:values"], style["StateConfiguration:colors"], strict=True))
    assert len(colour_of) == 3 * len(STATUSES) + 3, "and before, since and after the look"
    known = [colour_of[f"{name} known"] >> 8 for name in ("GT", "PEM", "both")]
    boxes = [at(hiding.path, f"/world/{name}/boxes", 1.2)["Boxes3D:colors"][0] >> 8 for name in ("GT", "PEM", "both")]
    assert known == boxes
    assert len({colour_of[f"{name} hidden"] for name in ("GT", "PEM", "both")}) == 1


def test_lines_from_units_to_what_they_listed(hiding: Made) -> None:
    ends = [line.tolist() for line in lines(at(hiding.path, "/world/both/listings", 0.5))]
    pole = [0, 50, 6]
    assert ends == [[pole, [-30, 0, pytest.approx(0.9)]], [pole, [30, 0, pytest.approx(0.9)]]]
    [line] = lines(at(hiding.path, "/world/PEM/listings", 1.2))
    assert line.tolist() == [[0, 0, pytest.approx(1.8)], [-30, 0, pytest.approx(0.9)]]
    assert lines(at(hiding.path, "/world/PEM/listings", 1.8)) == []


def test_the_words_say_how_much_is_seen(tmp_path: Path) -> None:
    # Half as far as the pedestrian, a wall reaches 1 m up; seen from 2 m, it covers his lower part: he is 1.8 m high,
    # the ray over the wall meets the ground at his face.
    low = WALL | {"polygon_m": [[14.5, -9], [14.9, -9], [14.9, 9], [14.5, 9]], "ground_z_m": 0.0, "height_m": 1.5}
    scene = recording([Thing("ego", "car", standing(0, 0)), Thing("9", "pedestrian", standing(30, 0))], until_s=1.0)
    blind = [{"detection": {"kind": "constant", "probability": 0.0}}]
    made = make(
        tmp_path / "x.rrd", scene, obstacles=[low], measure=PERSON, pems={"sure": blind},
        units={"ego": EGO_UNIT | {"height_m": 2.0}},
    )  # fmt: skip
    # From 2 m over 1.5 m at 14.9 m: 1 m up at 29.75 m, give or take the wall's thickness: 0.8 m of 1.8 m are seen.
    assert told(made.path, "PEM", 0.0) == ["9 hidden from ego by obstacle 0 (share 0.44)"]
    assert told(made.path, "GT", 0.0) == ["9 known"]


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
    blind = [SECTOR[0] | {"detection": {"kind": "constant", "probability": 0.0}}]
    made = make(tmp_path / "x.rrd", scene, pems={"sure": blind}, measure=PERSON)
    assert told(made.path, "PEM", 0.5) == ["6 out of range", "7 outside fields of view", "8 seen by ego, not listed"]
    assert [lane(made.path, f"{k} pedestrian", 1) for k in (6, 7, 8)] == [
        [(0, "PEM out of view")],
        [(0, "PEM out of view")],
        [(0, "PEM visible")],
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
    # The words are where he is, the box where he was half a second before.
    assert at(made.path, "/world/late/status", 0.7)["Points3D:positions"][0][:2] == pytest.approx([30, 1.4])
    [box] = at(made.path, "/world/late/boxes", 0.7)["Boxes3D:centers"]
    assert box[:2] == pytest.approx([30, 0])
    # Gone at 1.1 s, still believed until the list of 1.25 s, which has him no more, arrives.
    assert told(made.path, "late", 1.5) == ["9 known, 0.5 s old"]
    assert at(made.path, "/world/late/status", 1.5)["Points3D:positions"][0][:2] == pytest.approx([30, 2])
    assert lane(made.path, "9 pedestrian", 0) == [(0, "late captured"), (0.5, "late known"), (1.75, "late absent")]


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
    made = make(
        tmp_path / "x.rrd", scene, obstacles=[WALL], measure=PERSON,
        pems={"sure": [{"when": {"visible_share": [0.5, 1]}, "detection": {"kind": "constant", "probability": 1.0}}]},
        configurations=EGO_ONLY | {"late": {"units": "truth", "latency_s": 0.5}},
    )  # fmt: skip

    def values(name: str) -> list[float]:
        return [row["Scalars:scalars"][0] for row in rows(made.path, f"/plots/gospa/{name}")]

    assert values("GT") == [0.0] * 11
    assert values("PEM") == pytest.approx([np.sqrt(4.5)] * 11)
    # Lists that arrive after the end are about nobody: three entries too many.
    assert values("late") == pytest.approx([np.sqrt(2)] * 6 + [np.sqrt(3 * 4.5)] * 5)


def test_of_many_configurations_the_baselines_and_the_first_others_are_shown(tmp_path: Path) -> None:
    real = {f"g{k}": {"units": "all", "fusion": {"kind": "gnn"}} for k in range(9)}
    ideal = {f"i{k}": {"units": "all"} for k in range(2)}
    given = experiment(configurations={**real, **ideal, "GT": {"units": "truth"}})
    names = list(given.configurations)
    assert viewed(given, names) == ["g0", "g1", "g2", "i0", "i1", "GT"]
    assert viewed(given, names[:6]) == names[:6]
    ten = experiment(configurations={f"i{k}": {"units": "all"} for k in range(10)} | {"g": real["g0"]})
    assert viewed(ten, list(ten.configurations)) == ["i0", "i1", "i2", "i3", "i4", "g"]


def test_what_is_left_out_is_said(tmp_path: Path) -> None:
    from copem_replay.viewer import write_rrd

    scene = recording([Thing("ego", "car", standing(0, 0)), Thing("9", "pedestrian", standing(30, 0))], until_s=1.0)
    many = {f"GT{k}": {"units": "truth", "latency_s": k / 10} for k in range(8)}
    made = make(tmp_path / "x.rrd", scene, measure=PERSON, configurations=many)
    said = write_rrd(tmp_path / "y.rrd", made.replay, made.given, [made.run_tracks], made.table, SUMMARY, 3)
    assert said == ["y.rrd: without GT6, GT7; `show: {configurations: […]}` chooses up to 6"]
    text = static(made.path, "/summary")["TextDocument:text"][0]
    assert "Not in this file: GT6, GT7." in text
    assert not list(chunks(made.path, "/world/GT6/boxes"))
    assert list(chunks(made.path, "/world/GT5/boxes"))


# ------------------------------------------------------------------------------- names, pieces


def test_long_ids_are_shortened_where_they_are_drawn(tmp_path: Path) -> None:
    ids = ("8d2f0c5e-aaaa-4444-9999-000000000001", "8d2f0c5e-bbbb-4444-9999-000000000002")
    scene = recording(
        [Thing("ego", "car", standing(0, 0)), *(Thing(i, "pedestrian", standing(30, k)) for k, i in enumerate(ids))],
        until_s=1.0,
    )
    made = make(tmp_path / "x.rrd", scene, measure=PERSON, configurations=EGO_ONLY)
    assert told(made.path, "GT", 0.5) == ["8d2f0c5e-a known", "8d2f0c5e-b known"]
    assert lane(made.path, "8d2f0c5e-a pedestrian", 0) == [(0, "GT known")]


def test_pieces_are_whole_lists_and_together_all(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = recording(
        [Thing(str(k), "car", standing(k, 0), there=lambda t, k=k: t > k / 10 - 0.01) for k in range(5)], until_s=1.0
    )
    truth = scene.truth
    monkeypatch.setattr("copem_replay.viewer.sink.SLICE_ROWS", 7)
    pieces = list(slices(truth, truth.valid[0]))
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
    assert lane(made.path, "2 pedestrian", 1) == [(0.0, "gnn captured"), (0.3, "gnn unmatched")]


def test_a_list_that_never_arrives_is_lost(hiding: Made) -> None:
    from dataclasses import replace

    from copem_replay.viewer.line_of_sight import sight
    from copem_replay.viewer.status import CAPTURED, KNOWN, LOST, clock_of, status_of

    fused_tracks = hiding.run_tracks["both"]
    # Pedestrian 4 is in the pole's lists only: those of the first half of a second never arrive.
    arrives = np.where(fused_tracks.heard.captured_s < 0.45, np.inf, fused_tracks.heard.arrives_s)
    silent = fused_tracks.fused.valid & (fused_tracks.fused.arrives_s[:, fused_tracks.fused.frame_ix] > 0.45)
    lossy = replace(
        fused_tracks,
        heard=replace(fused_tracks.heard, arrives_s=arrives),
        fused=replace(fused_tracks.fused, valid=silent),
    )
    seen = sight(hiding.replay, hiding.given, [hiding.replay.scene.object_number["4"]])
    clock = clock_of(hiding.replay.scene, hiding.table, "both")
    made = status_of(hiding.replay, hiding.given, "both", lossy, seen, clock)
    early = made.elapsed_ns < 450_000_000
    assert set(made.status[early, 0].tolist()) == {LOST}
    assert set(made.status[~early, 0].tolist()) == {KNOWN}
    assert CAPTURED not in made.status


@pytest.mark.parametrize("arrives", [False, True])
def test_what_a_units_next_list_no_longer_holds_is_neither_lost_nor_unmatched(hiding: Made, arrives: bool) -> None:
    """Two lists of the pole hold pedestrian 4, at 0 and 0.1 s, the next ones do not; no fused list ever does."""
    from dataclasses import replace

    from copem_replay.viewer.line_of_sight import sight
    from copem_replay.viewer.status import LOST, UNMATCHED, VISIBLE, clock_of, status_of

    fused_tracks, number = hiding.run_tracks["both"], hiding.replay.scene.object_number["4"]
    heard = fused_tracks.heard
    late = heard.captured_s[heard.frame_ix] > 0.15
    heard = replace(heard, valid=heard.valid & ~(late & (heard.row_object_ix == number)))
    if not arrives:
        heard = replace(heard, arrives_s=np.full_like(heard.arrives_s, np.inf))
    nothing = replace(fused_tracks.fused, valid=np.zeros_like(fused_tracks.fused.valid))
    seen = sight(hiding.replay, hiding.given, [number])
    clock = clock_of(hiding.replay.scene, hiding.table.assign(detected=False, detection_s=np.nan), "both")
    made = status_of(
        hiding.replay, hiding.given, "both", replace(fused_tracks, heard=heard, fused=nothing), seen, clock
    )
    early = made.elapsed_ns < 199_000_000
    assert {STATUSES[k] for k in made.status[early, 0]} == {STATUSES[UNMATCHED if arrives else LOST]}
    assert {STATUSES[k] for k in made.status[~early, 0]} == {STATUSES[VISIBLE]}


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
