"""Which objects a recording is about, and when it opens: near the ego's path, known at different times, seen enough."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest

from copem_replay.experiment.schema import Experiment
from copem_replay.pipeline.prepare import Replay, prepare_log
from copem_replay.results.shown_objects import choose_shown_objects, find_opening_s, pick_evenly
from copem_replay.viewer.blueprint import choose_pair
from copem_replay.viewer.events import _describe_others
from tests.helpers.scenes import Thing, driving, experiment, recording, standing
from tests.viewer.test_rrd import make, static

NAMES = {"GT": {"units": "truth"}, "x": {"units": ["ego"]}, "y": {"units": ["ego"], "latency_s": 0.5}}
PLACES = {
    "near": (30.0, 2.0),
    "beside": (30.0, 20.0),
    "far": (30.0, 60.0),
    "early": (30.0, -2.0),
    "short": (30.0, -3.0),
    "alike": (30.0, 5.0),
    "behind": (-40.0, 0.0),
}
"""The ego drives along y = 0 from x = 0 to 100 within 10 s."""


def ready(**things: tuple[float, float]) -> tuple[Replay, Experiment]:
    scene = recording(
        [
            Thing("ego", "car", driving(0, 0, 10)),
            *(Thing(name, "pedestrian", standing(*at)) for name, at in things.items()),
        ],
        until_s=10.0,
    )
    asked = experiment(configurations=NAMES)
    return prepare_log(scene, asked), asked


def table(*rows: tuple[str, float, float, float | None, float | None], uncounted: tuple[str, ...] = ()) -> pd.DataFrame:
    """Of each object id, onset and end, and when x and y know it; the truth knows it at once."""
    found: list[dict[str, Any]] = []
    for name, onset_s, ended_s, *known in rows:
        for configuration, known_s in zip(NAMES, (onset_s, *known), strict=True):
            found.append({
                "configuration": configuration, "object_id": name, "onset_s": onset_s, "ended_s": ended_s,
                "began": "log_start" if name in uncounted else "appeared",
                "detection_s": known_s, "detected": known_s is not None,
                "time_to_detection_s": None if known_s is None else known_s - onset_s,
            })  # fmt: skip
    columns = ["onset_s", "ended_s", "detection_s", "time_to_detection_s"]
    return pd.DataFrame(found).astype(dict.fromkeys(columns, float))


def shown(rows: pd.DataFrame) -> tuple[list[str], list[str]]:
    replay, asked = ready(**PLACES)
    counts = asked.model_copy(update={"measure": asked.measure.model_copy(update={"began": ("appeared", "crossed")})})
    chosen = choose_shown_objects(replay.scene, replay.truth, counts, rows)
    return [replay.scene.object_ids[k] for k in chosen.object_ix], list(chosen.too_short)


def test_difference_times_nearness() -> None:
    """2 m, 20 m and 60 m from the path: 1.04, 5 and 37 times less than on it; y is 2, 4 and 8 s later than x."""
    on_time = (("early", 2.0, 10.0, 2.0, 2.0), ("alike", 2.0, 10.0, 2.2, 2.2), ("short", 2.0, 10.0, 2.5, 2.5))
    rows = table(
        ("near", 2.0, 10.0, 2.0, 4.0), ("beside", 2.0, 10.0, 2.0, 6.0), ("far", 2.0, 10.0, 2.0, None), *on_time
    )
    assert shown(rows)[0] == ["near", "beside", "far", "early", "short", "alike"]
    rows = rows.replace({"detection_s": {4.0: 2.8}, "time_to_detection_s": {2.0: 0.8}})
    assert shown(rows)[0][:3] == ["beside", "near", "far"], "(4 − 0.5) s / 5 is more than (0.8 − 0.5) s / 1.04"


def test_what_a_configuration_is_late_everywhere_decides_nothing() -> None:
    """y is 0.5 s late by its latency. Of `near` it is nothing more, of `beside` 0.7 s, of `far` x and y know alike."""
    usual = [(name, 2.0, 10.0, 2.0, 2.5) for name in ("near", "early", "short")]
    rows = table(*usual, ("beside", 2.0, 10.0, 2.0, 2.7), ("far", 2.0, 10.0, 4.0, 4.0))
    assert shown(rows)[0] == ["beside", "near", "early", "short", "far"], "the rest by the difference with the latency"
    swapped = rows.assign(configuration=rows["configuration"].map({"GT": "GT", "x": "y", "y": "x"}))
    assert shown(swapped) == shown(rows), "whoever it is"
    assert shown(table(("near", 2.0, 10.0, 2.0, 2.1), ("beside", 2.0, 10.0, 2.0, 2.0)))[0][0] == "near", "of two"


def test_objects_that_do_not_count_are_left_out_unless_none_does() -> None:
    rows = (("near", 2.0, 10.0, 2.0, 9.0), ("early", 1.0, 10.0, 2.0, 9.0), ("beside", 2.0, 10.0, 2.0, 2.0))
    assert shown(table(*rows, uncounted=("near", "early"))) == (["beside"], []), "nor too short to judge"
    every = table(*rows, uncounted=("near", "early", "beside"))
    assert shown(every) == (["near", "beside"], ["early"])


def test_the_path_is_that_of_the_next_three_seconds() -> None:
    """An object that the ego has passed 60 m ago, and one it will pass after 10 s, are not on its way."""
    rows = table(("behind", 2.0, 10.0, 2.0, 6.0), ("beside", 2.0, 10.0, 2.0, 6.0))
    assert shown(rows)[0] == ["beside", "behind"]


def test_two_seconds_before_and_after() -> None:
    rows = table(
        ("early", 1.9, 10.0, 2.0, 9.0), ("short", 5.0, 6.9, 5.0, None), ("near", 2.0, 4.0, 2.0, 2.1),
    )  # fmt: skip
    assert shown(rows) == (["near"], ["early", "short"])
    assert shown(rows[rows["object_id"] != "near"]) == (["early", "short"], ["early", "short"]), "better than none"


def test_six_at_most_and_none_of_none() -> None:
    replay, asked = ready(**PLACES)
    seven, none = table(*((n, 2.0, 9.0, 2.0, 3.0) for n in PLACES)), table(("near", 2.0, 9.0, 2.0, 3.0))[:0]
    assert len(choose_shown_objects(replay.scene, replay.truth, asked, seven).object_ix) == 6
    assert choose_shown_objects(replay.scene, replay.truth, asked, none).object_ix == ()


def test_with_one_configuration_the_difference_is_to_the_truth() -> None:
    rows = table(("alike", 2.0, 10.0, 2.2, 0.0), ("near", 2.0, 10.0, 4.0, 0.0))
    assert shown(rows[rows["configuration"] != "y"])[0] == ["near", "alike"]


def test_it_opens_while_some_know_and_others_do_not() -> None:
    _, asked = ready()
    slow, alike = table(("a", 3.0, 9.0, 3.4, 5.0)), table(("b", 2.0, 9.0, 4.0, 4.0))
    assert find_opening_s(asked, [slow]) == pytest.approx(3.9), "half a second after the first"
    assert find_opening_s(asked, [alike, slow]) == pytest.approx(3.9)
    assert find_opening_s(asked, [table(("a", 3.0, 9.0, 3.4, 3.6))]) == pytest.approx(3.5), "in the middle"
    assert find_opening_s(asked, [table(("a", 3.0, 9.0, None, 4.0))]) == pytest.approx(4.5), "one never"
    assert find_opening_s(asked, [alike]) == pytest.approx(1.5), "no difference: just before the onset"
    assert find_opening_s(asked, []) is None


@pytest.mark.parametrize(
    ("colours", "kept", "picked"),
    [
        ({}, (), "adgj"),
        ({}, ("x",), "xaej"),
        ({"d": 1, "g": 1}, (), "adfj"),
        ({"a": 1, "j": 1, "i": 1}, (), "adgh"),
        (dict.fromkeys("abcdefghij", 1), (), "adgj"),
        ({"x": 1, "a": 1}, ("x",), "xbej"),
    ],
)
def test_names_are_picked_evenly_with_colours_that_differ(
    colours: dict[str, int], kept: tuple[str, ...], picked: str
) -> None:
    """The nearest one with another colour instead of one whose colour is taken; the first and the last one first."""
    assert "".join(pick_evenly(list("abcdefghij"), 4, kept, colours)) == picked


@pytest.mark.parametrize(
    ("detections_s", "pair"),
    [
        ({"ideal": 2.0, "gnn": 2.0, "alone": 4.0, "late": 2.5}, ("gnn", "alone")),
        ({"ideal": 2.0, "gnn": 2.0, "alone": 2.0, "late": None}, ("gnn", "late")),
        ({"ideal": 2.0, "gnn": None, "alone": None, "late": None}, ("ideal", "gnn")),
        ({"ideal": 2.0, "gnn": 2.0, "alone": 2.0, "late": 2.0}, ("ideal", "gnn")),
        ({"alone": 2.0}, ()),
    ],
)
def test_the_scene_with_two_has_what_differs_where_it_opens_by_fewest_keys(
    detections_s: dict[str, float | None], pair: tuple[str, ...]
) -> None:
    """It opens at 3.0 s; the first object is known alike. `gnn` and `alone` differ in units, `late` in its latency."""
    gnn = {"units": ["ego", "pole"], "fusion": {"kind": "gnn"}}
    asked = experiment(
        units={"pole": {"at": [20, -10], "height_m": 6.0, "ground_z_m": 0.0, "pem": "sure"}},
        configurations={
            "GT": {"units": "truth"}, "ideal": {"units": ["ego", "pole"]},
            "gnn": gnn, "alone": gnn | {"units": ["ego"]}, "late": gnn | {"latency_s": 0.5},
        },
    )  # fmt: skip
    alike, apart = (
        pd.DataFrame({"configuration": list(of), "detection_s": pd.Series(list(of.values()), dtype=float)})
        for of in (dict.fromkeys(detections_s, 1.0), detections_s)
    )
    content = SimpleNamespace(
        experiment=asked,
        configurations=["GT", *detections_s],
        opens_s=3.0,
        objects=[1, 2],
        episodes={1: alike, 2: apart},
    )
    assert choose_pair(content) == pair  # type: ignore[arg-type]


def test_what_is_too_short_is_listed(tmp_path: Path) -> None:
    scene = recording(
        [
            Thing("ego", "car", standing(0, 0)),
            Thing("7", "car", standing(30, 5), there=lambda t: t > 2.95),
            Thing("8", "car", standing(30, -5)),
        ],
        until_s=6.0,
    )
    made = make(tmp_path / "x.rrd", scene, measure={"onset": {"kind": "appears"}})
    [text] = static(made.path, "/difference")["TextDocument:text"]
    assert (
        "Shown: 1 of 2 that count.\n\nToo short to judge, seen for less than 2 s before or after it counts: 8." in text
    )
    assert "7 car" in text
    assert "8 car" not in text


def test_who_is_never_known_is_said_though_not_shown() -> None:
    """As many as titles count: here three, of whom x never knows the second, and nobody the third."""
    replay, _ = ready(**PLACES)
    rows = table(("near", 2.0, 9.0, 3.0, 4.0), ("beside", 2.0, 9.0, None, 3.0), ("far", 2.0, 9.0, None, None))
    rows = rows[rows["configuration"] != "GT"]
    number = replay.scene.object_number
    [line] = _describe_others(rows, replay.scene, {number["near"]: ""})
    assert line == "Shown: 1 of 3 that count. Of the others never known: objects beside with x, far."
    assert list(_describe_others(rows, replay.scene, {number[name]: "" for name in ("near", "beside", "far")})) == []


def test_what_is_shown_all_the_same_is_said_to_be_too_short(tmp_path: Path) -> None:
    scene = recording([Thing("ego", "car", standing(0, 0)), Thing("8", "car", standing(30, -5))], until_s=6.0)
    made = make(tmp_path / "x.rrd", scene, measure={"onset": {"kind": "appears"}})
    [text] = static(made.path, "/difference")["TextDocument:text"]
    assert "8 car" in text
    assert (
        "Too short to judge, seen for less than 2 s before or after it counts: 8; what is shown here is among them."
        in text
    )
