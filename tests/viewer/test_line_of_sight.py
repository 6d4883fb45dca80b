"""Recordings for the viewer, read back: fields of view, what is known, marks at onset and detection, the eye.

Mostly an ego that stands at the origin and looks east, and pedestrians who are measured from their first frame on.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from copem_replay.perception.pem.condition import Couple
from copem_replay.perception.sensor_poses import couple_outlines
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.sight import compute_sight
from copem_replay.viewer.sensors import choose_named_units
from tests.helpers.scenes import EGO_UNIT, SEES_60_M, SEES_ALL, Thing, driving, experiment, recording, standing
from tests.viewer.test_rrd import Made, at, chunks, make, rows, static

SURE = {"kind": "constant", "probability": 1.0}
SECTOR = [{"when": {"range_m": [0, 80], "azimuth_deg": [-60, 60]}, "detection": SURE}]
PERSON = {"objects": {"classes": ["pedestrian"]}, "onset": {"kind": "appears"}}
WALL = {"polygon_m": [[9, -5], [11, -5], [11, 5], [9, 5]], "height_m": 40.0, "ground_z_m": 1.0}


def pem(*conditions: dict[str, Any]) -> tuple[Couple, ...]:
    return tuple(Couple.model_validate({"when": when, "detection": SURE}) for when in conditions)


def lines(row: dict[str, Any]) -> list[Any]:
    return [np.array(strip) for strip in row["LineStrips3D:strips"]]


# ------------------------------------------------------------------------------- fields of view


def test_a_sector_is_an_arc_and_two_edges() -> None:
    [border] = couple_outlines(pem({"range_m": [0, 80], "azimuth_deg": [-60, 60]}))
    half, high = 40.0, 80 * np.sqrt(3) / 2
    assert border[[0, 1, -2, -1]] == pytest.approx(np.array([[0, 0], [half, -high], [half, high], [0, 0]]))
    assert np.hypot(*border[1:-1].T) == pytest.approx(80)
    assert len(border) == 120 / 3 + 1 + 2
    [band] = couple_outlines(pem({"range_m": [10, 20], "azimuth_deg": [0, 90]}))
    assert band[[0, 1]] == pytest.approx(np.array([[10, 0], [20, 0]]))
    assert band[-1] == pytest.approx(band[0])
    assert sorted({round(r, 6) for r in np.hypot(*band.T)}) == [10, 20]


def test_all_around_is_circles_and_without_a_range_nothing() -> None:
    inner, outer = couple_outlines(pem({"range_m": [5, 30]}))
    assert (inner[0], outer[0]) == (pytest.approx([-5, 0]), pytest.approx([-30, 0]))
    assert inner[-1] == pytest.approx(inner[0])
    assert len(couple_outlines(pem({"range_m": [0, 30], "azimuth_deg": [-180, 180]}))) == 1
    assert couple_outlines(pem({}, {"azimuth_deg": [-60, 60]}, {"visible_share": [0.5, 1]})) == []
    # Through 180°: an arc behind, of 60°.
    [behind] = couple_outlines(pem({"range_m": [0, 10], "azimuth_deg": [150, -150]}))
    assert behind[:, 0].max() == pytest.approx(0)
    assert len(behind) == 60 / 3 + 1 + 2
    # Couples that differ in something else have the same border once.
    one, other = {"range_m": [0, 10], "classes": ["car"]}, {"range_m": [0, 10], "visible_share": [0.5, 1.0]}
    assert len(couple_outlines(pem(one, other))) == 1


@pytest.fixture(scope="module")
def passing(tmp_path_factory: pytest.TempPathFactory) -> Made:
    scene = recording(
        [
            Thing("ego", "car", driving(0, 0, 10)),
            Thing("7", "car", standing(0, 20), there=lambda t: 0.99 < t < 2.01 or t > 2.99, yaw_rad=np.pi / 2),
            Thing("9", "pedestrian", standing(60, 0)),
        ],
        until_s=4.0,
    )
    return make(
        tmp_path_factory.mktemp("passing") / "replay.rrd", scene,
        pems={"sector": SECTOR, "sure": SEES_60_M, "all": SEES_ALL},
        units={
            "ego": EGO_UNIT | {"pem": "sector"},
            "obu": {"on": "7", "height_m": 1.5, "pem": "sure", "yaw_deg": 90},
            "pole": {"at": [30, 5], "yaw_deg": -90, "height_m": 6.0, "ground_z_m": 1.0, "pem": "sector"},
            "eyes": {"at": [30, 9], "height_m": 6.0, "ground_z_m": 1.0, "pem": "all"},
        },
        configurations={"GT": {"units": "truth"}, "PEM": {"units": ["ego"]}, "pole": {"units": ["pole"]}},
        measure=PERSON,
    )  # fmt: skip


def test_fields_move_with_their_units(passing: Made) -> None:
    moved = at(passing.path, "/world/fields/ego", 2.0)
    assert moved["Transform3D:translation"] == [pytest.approx([20, 0, 1.8])]
    assert moved["Transform3D:quaternion"] == [[0, 0, 0, 1]]
    [first] = [row for row in rows(passing.path, "/world/fields/ego") if row.get("LineStrips3D:strips")]
    assert (first["elapsed"], len(lines(first))) == (0, 1)
    # On the ground, which is a sensor's height under it.
    assert lines(first)[0][:, 2] == pytest.approx(0.05 - 1.8)
    assert np.hypot(*lines(first)[0][1:-1, :2].T) == pytest.approx(80, abs=1e-4)
    fixed = static(passing.path, "/world/fields/pole")
    assert fixed["Transform3D:translation"] == [[30, 5, 7]]
    assert fixed["Transform3D:quaternion"] == [pytest.approx([0, 0, -np.sqrt(0.5), np.sqrt(0.5)])]
    assert lines(fixed)[0][:, 2] == pytest.approx(0.05 - 6)
    assert not list(chunks(passing.path, "/world/fields/eyes"))


def test_fields_come_and_go_with_the_carrier(passing: Made) -> None:
    found = rows(passing.path, "/world/fields/obu")
    drawn = [(row["elapsed"] / 1e9, len(lines(row))) for row in found if row.get("LineStrips3D:strips") is not None]
    assert drawn == [(1.0, 1), (2.1, 0), (3.0, 1)]
    turned = [row["Transform3D:quaternion"] for row in found if row.get("Transform3D:quaternion")]
    assert turned == [[pytest.approx([0, 0, 1, 0], abs=1e-6)]] * 22  # north, and a quarter turn more


# ------------------------------------------------------------------------------- known, marks


def test_how_many_are_known_and_there(tmp_path: Path) -> None:
    # One pedestrian is in the log to 2 s, the other from 1 s on; lists are half a second late. Cars do not count.
    scene = recording(
        [
            Thing("ego", "car", standing(0, 0)),
            Thing("7", "car", standing(0, 9)),
            Thing("8", "pedestrian", standing(30, 3), there=lambda t: t < 2.01),
            Thing("9", "pedestrian", standing(30, -3), there=lambda t: t > 0.99),
        ],
        until_s=4.0,
    )
    made = make(tmp_path / "x.rrd", scene, measure=PERSON, configurations={"GT": {"units": "truth", "latency_s": 0.5}})

    def steps(name: str) -> list[tuple[float, float]]:
        return [(row["elapsed"] / 1e9, *row["Scalars:scalars"]) for row in rows(made.path, f"/plots/known/{name}")]

    # A row where it changes, and one at the end.
    assert steps("truth") == [(0, 1), (1, 2), (2.1, 1), (4, 1)]
    assert steps("GT") == [(0.5, 1), (1.5, 2), (2.6, 1), (4.5, 1)]


def test_marks_stay_where_objects_were(passing: Made) -> None:
    """The pedestrian, 60 m ahead at 0 s: seen at once by the ego, never by the pole."""
    [begin] = rows(passing.path, "/world/truth/onsets")
    assert begin["elapsed"] == 0
    assert begin["Points3D:labels"] == ["onset 9"]
    assert begin["Points3D:positions"] == [[60, 0, 0]]
    [there] = rows(passing.path, "/world/PEM/marks")
    assert there["Points3D:positions"] == [[60, 0, pytest.approx(1.8)]]
    [told] = rows(passing.path, "/world/PEM/marks/from")
    assert told["Points3D:labels"] == ["9 detected +0.00 s, 60.0 m"]
    assert told["Points3D:positions"] == [[30, 0, 0]]
    assert static(passing.path, "/world/PEM/marks/from")["Points3D:show_labels"] == [False], "when it is selected"
    assert not rows(passing.path, "/world/pole/marks")  # he is not in its sector


def test_marks_gather(tmp_path: Path) -> None:
    # Two at once, two later; the configuration learns half a second later, when one has walked on.
    scene = recording(
        [
            Thing("ego", "car", standing(0, 0)),
            Thing("6", "pedestrian", standing(10, 0), there=lambda t: t > 0.99),
            Thing("7", "pedestrian", driving(20, 0, 0, 2), there=lambda t: t > 0.99),
            Thing("8", "pedestrian", standing(30, 0)),
            Thing("9", "pedestrian", standing(40, 0)),
        ],
        until_s=2.0,
    )
    made = make(tmp_path / "x.rrd", scene, measure=PERSON, configurations={"GT": {"units": "truth", "latency_s": 0.5}})
    begin = rows(made.path, "/world/truth/onsets")
    assert [row["elapsed"] / 1e9 for row in begin] == [0, 1]
    assert [row["Points3D:labels"] for row in begin] == [
        ["onset 8", "onset 9"],
        ["onset 8", "onset 9", "onset 6", "onset 7"],
    ]
    assert begin[1]["Points3D:positions"] == [[30, 0, 0], [40, 0, 0], [10, 0, 0], [20, 2, 0]]
    last = rows(made.path, "/world/GT/marks")[-1]
    assert last["elapsed"] / 1e9 == 1.5
    assert last["Points3D:positions"][-1] == [20, 3, pytest.approx(1.8)]
    told = rows(made.path, "/world/GT/marks/from")
    assert [len(row["Points3D:labels"]) for row in told] == [2, 4]
    assert told[-1]["Points3D:labels"][-1] == "7 detected +0.50 s, 20.2 m"  # √(20² + 3²)
    # More than three: words under the pointer, and no lines.
    assert static(made.path, "/world/GT/marks/from")["Points3D:show_labels"] == [False]
    assert not list(chunks(made.path, "/world/GT/marks/from/line"))


def test_marks_on_the_curves(tmp_path: Path) -> None:
    # The wall hides the pedestrian from the ego, the pole sees him: a mark is on the curve of those who detected him.
    scene = recording([Thing("ego", "car", standing(0, 0)), Thing("9", "pedestrian", standing(30, 0))], until_s=1.0)
    units = {"ego": EGO_UNIT | {"pem": "all"}, "pole": {"at": [30, 9], "height_m": 6.0, "ground_z_m": 0, "pem": "all"}}
    configurations = {
        "blind": {"units": ["ego"]},
        "pole": {"units": "all", "latency_s": 0.3},
        "late": {"units": "all", "latency_s": 0.2},
    }
    made = make(tmp_path / "x.rrd", scene, units=units, configurations=configurations, obstacles=[WALL], measure=PERSON)
    layers = [rows(made.path, f"/plots/visible_share/9_pedestrian/mark_{k}") for k in (1, 2, 3)]
    assert [len(layer) for layer in layers] == [3, 1, 0]
    # Two at one instant are on two entities; on one spot, the second is smaller.
    assert layers[1][0]["SeriesPoints:marker_sizes"] < layers[0][0]["SeriesPoints:marker_sizes"]
    found = [layers[0][0], layers[1][0], *layers[0][1:]]
    # The `all` model lists what it cannot see, too: the ego's own detection is at a share of 0.
    assert [(row["elapsed"] // 10**6, *row["Scalars:scalars"]) for row in found] == [(0, 0), (0, 0), (200, 1), (300, 1)]
    colours = [row["SeriesPoints:colors"][0] for row in found]
    assert len(set(colours)) == 4
    own = [static(made.path, f"/world/{name}/marks")["Points3D:colors"][0] for name in ("blind", "late", "pole")]
    assert colours[1:] == own
    assert [row["SeriesPoints:markers"][0] for row in found] == [2, 1, 1, 1]


# ------------------------------------------------------------------------------- names, the eye


def test_six_units_are_named_in_their_view_and_apart(tmp_path: Path) -> None:
    from rerun.chunk import RrdReader

    scene = recording([Thing("ego", "car", standing(0, 0)), Thing("9", "pedestrian", standing(30, 0))], until_s=1.0)
    poles = {f"p{k}": {"at": [4 * k, 9], "height_m": 6.0, "ground_z_m": 0, "pem": "all"} for k in range(24)}
    units = {"ego": EGO_UNIT, **poles}
    made = make(tmp_path / "x.rrd", scene, units=units, configurations={"all": {"units": "all"}}, measure=PERSON)
    assert {static(made.path, f"/world/units/{name}")["Points3D:show_labels"][0] for name in units} == {False}
    reader = RrdReader(made.path)
    [blueprint] = reader.blueprints()
    overrides = [
        chunk
        for chunk in reader.stream(store=blueprint)
        if "Points3D:show_labels" in chunk.to_record_batch().schema.names
    ]
    named = list(choose_named_units(made.replay, made.given, np.array([30.0, 0.0, 0.0]), 0.0))
    of_views = Counter(str(chunk.entity_path).split("/")[2] for chunk in overrides)
    assert len(named) == max(of_views.values()) == 6
    assert sorted(of_views.values())[-2] <= 2, "others name those that told first"
    assert named[0] == "ego"
    numbers = sorted(int(name[1:]) for name in named if name != "ego")
    assert min(np.diff(numbers)) >= 3, "12 m"


def test_no_nan_anywhere(passing: Made) -> None:
    from rerun.chunk import RrdReader

    def numbers(value: Any) -> list[float]:
        if isinstance(value, list):
            return [n for v in value for n in numbers(v)]
        return [value] if isinstance(value, float) else []

    for chunk in RrdReader(passing.path).stream():
        batch = chunk.to_record_batch()
        columns = [batch.column(n).to_pylist() for n in batch.schema.names if ":" in n]
        assert np.isfinite(numbers(columns)).all(), chunk.entity_path


POLE_5_HZ = {"at": [9, 9], "height_m": 2.0, "ground_z_m": 0.0, "pem": "sure", "rate_hz": 5, "phase_s": 0.05}


def test_what_is_known_and_what_is_near_a_line_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shares that units have captured are not computed again, and bodies far from a line of sight are left out."""
    from copem_replay.pipeline import sight as line_of_sight

    turn = np.random.default_rng(5)
    things = [Thing("ego", "car", driving(0, 0, 3, 0))]
    for k in range(25):
        x, y, vx, vy = turn.normal(0, [14, 14, 3, 3])
        things.append(Thing(str(k), "car" if k % 3 else "pedestrian", driving(x, y, vx, vy), yaw_rad=float(k)))
    given = experiment(units={"ego": EGO_UNIT, "pole": POLE_5_HZ}, obstacles=[WALL], measure=PERSON)
    replay = prepare_log(recording(things, until_s=1.0), given)
    shown = list(range(1, 13))
    quick = compute_sight(replay, given, shown, replay.rows_of(np.array(shown)))
    monkeypatch.setattr(line_of_sight, "is_own", lambda _: True)  # as a model that has to see the whole world
    whole = compute_sight(replay, given, shown)
    np.testing.assert_allclose(quick.share, whole.share, rtol=0, atol=1e-12)  # summed in another order
    for name in ("state", "in_range", "body_ix", "body_m", "place_m"):
        assert np.array_equal(getattr(quick, name), getattr(whole, name), equal_nan=True), name
    assert (quick.body_ix != 0).sum() > 15, "many are hidden"
