"""Slices: each group has the figures of its rows alone, and an interval only over logs, or objects of one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pandas as pd
import pytest
from hypothesis import given, settings

from copem_replay.metrics.config import parse_slice, parse_slices
from copem_replay.metrics.slices import (
    Group,
    SliceSettings,
    StudyRows,
    describe_chance,
    number_groups,
    sum_episodes,
    summarise_groups,
)
from copem_replay.metrics.summary import tally_rows
from tests.metrics.test_tally import tables
from tests.oracles import intervals
from tests.oracles.summary import figures

EVERY = ("log_start", "appeared", "crossed")


def study(rows: pd.DataFrame, tags: dict[str, dict[str, str]] | None = None, horizon_s: float = 7.3) -> StudyRows:
    given = {"began": "crossed", "distance_at_onset_m": 20.0, "object_class": "car"}
    rows = rows.assign(**{name: value for name, value in given.items() if name not in rows})
    settings = SliceSettings(tuple(dict.fromkeys(rows["configuration"])), horizon_s, EVERY)
    tags = {log: {} for log in rows["log"].unique()} | (tags or {})
    return StudyRows(settings, tags, tally_rows(rows), None, sum_episodes(rows, (), EVERY), None)


def drive(log: str, *found_s: float | None, runs: int = 1, **more: Any) -> list[dict[str, Any]]:
    """Rows of a log: an object for each of `found_s`, followed for 10 s from 0 s on, in one configuration."""
    return [
        {"log": log, "configuration": "a", "run": run, "object_id": str(k), "episode": 0, "onset_s": 0.0,
         "detected": s is not None, "detection_s": s, "time_to_detection_s": s, "distance_at_detection_m": s,
         "ended_s": 10.0, "ended_by": "object_left", **more}
        for k, s in enumerate(found_s) for run in range(runs)
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("entry", "label"),
    [
        ("log", "log"),
        (["log", "class"], "log*class"),
        ("class * tags.weather", "class*tags.weather"),
        ("range_at_onset", "range_at_onset"),
        (["range_at_onset:20:40.5", "began"], "range_at_onset:20:40.5*began"),
    ],
)
def test_an_entry_is_a_word_or_a_cross(entry: str | list[str], label: str) -> None:
    assert parse_slice(entry).label == label
    assert parse_slice(label) == parse_slice(entry)


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        (["clas"], "no slice is named 'clas'; did you mean class?"),
        (["tags."], "no slice is named 'tags.'"),
        (["log*log"], "expected each of a cross once, found log 2 times"),
        ([[]], "found an empty list"),
        (["range_at_onset:40:20"], "expected ascending edges above 0 in metres, range_at_onset:20:40, found 40:20"),
        (["range_at_onset:0:20"], "found 0:20"),
        (["range_at_onset:x"], "found x"),
        (["range_at_onset:nan"], "found nan"),
        (["log", "class", "log"], "expected each entry once, found log 2 times"),
    ],
)
def test_an_entry_that_is_none_is_refused(entries: list[str], said: str) -> None:
    with pytest.raises(ValueError, match=r"expected|no slice") as error:
        parse_slices(entries)
    assert said in str(error.value)


def test_groups_are_in_the_order_in_which_they_are_shown() -> None:
    table = pd.DataFrame(
        {
            "log": ["z", "z", "a", "a", "m"],
            "object_class": ["car", "pedestrian", "car", "car", "bicycle"],
            "began": ["crossed", "log_start", "appeared", "crossed", "crossed"],
            "distance_at_onset_m": [20.0, 19.999, 40.0, float("nan"), 0.0],
        }
    )
    tags = {"z": {"weather": "rain"}, "a": {"weather": "dry"}, "m": {}}

    def groups(entry: str) -> list[tuple[tuple[str, ...], list[int]]]:
        number, names = number_groups(table, parse_slice(entry), tags)
        return [(name, [i for i, k in enumerate(number) if k == n]) for n, name in enumerate(names)]

    assert groups("log") == [(("z",), [0, 1]), (("a",), [2, 3]), (("m",), [4])]  # as the logs are given
    assert groups("class") == [(("pedestrian",), [1]), (("bicycle",), [4]), (("car",), [0, 2, 3])]  # as classes are
    assert groups("tags.weather") == [(("dry",), [2, 3]), (("rain",), [0, 1]), (("(no tag)",), [4])]
    assert groups("range_at_onset:20:40") == [
        (("0 … 20 m",), [1, 4]), (("20 … 40 m",), [0]), (("from 40 m",), [2]), (("(no range)",), [3]),
    ]  # fmt: skip
    assert groups("began*tags.weather") == [
        (("log_start", "rain"), [1]), (("appeared", "dry"), [2]), (("crossed", "dry"), [3]), (("crossed", "rain"), [0]),
        (("crossed", "(no tag)"), [4]),
    ]  # fmt: skip


@settings(max_examples=25)
@given(tables())
def test_a_group_has_the_figures_of_its_rows_alone(table: pd.DataFrame) -> None:
    classes = ["pedestrian", "car", "truck"]
    table = table.assign(object_class=[classes[int(k) % 3] for k in table["object_id"]])
    found = summarise_groups(study(table), parse_slices(["log", "log*class"])).set_index(["by", "group"])
    expected = {("log", log): rows for log, rows in table.groupby("log")}
    expected |= {("log*class", ", ".join(of)): rows for of, rows in table.groupby(["log", "object_class"])}
    assert set(found.index) == set(expected)
    for key, rows_of_group in expected.items():
        for _, row in found.loc[[key]].iterrows():
            rows = rows_of_group[rows_of_group["configuration"] == row["configuration"]]
            for metric, value in figures(rows, 7.3).items():
                rounded = pytest.approx(value, abs=1e-12) if metric.startswith("unknown_") else value
                assert row[metric] == rounded or (value is None and pd.isna(row[metric])), metric
            assert (row["logs"], row["objects"], row["n"]) == (1, rows["object_id"].nunique(), len(rows))
            assert pd.isna(row["interval_over"])  # of three objects at most


def limits(table: pd.DataFrame, group: str) -> tuple[Any, ...]:
    row = table.set_index("group").loc[group]
    over, note = (None if pd.isna(row[name]) else row[name] for name in ("interval_over", "note"))
    return (row["detected_share_low"], row["detected_share_high"]), over, note


def test_intervals_are_over_three_logs_or_five_objects_of_one() -> None:
    rows = drive("a", 1, 1, None, 2, 1, runs=2)  # five objects
    rows += drive("b", 1, None, 1, 1)
    rows += drive("c", 1)
    found = summarise_groups(study(pd.DataFrame(rows)), parse_slices(["log"]))
    assert limits(found, "a")[0] == pytest.approx(intervals.share([(s, 1) for s in (1, 1, 0, 1, 1)]))
    assert limits(found, "a")[1:] == ("objects", None)
    assert limits(found, "b")[1:] == (None, "no interval of detected_share: 4 objects of one drive, fewer than 5")
    assert limits(found, "c")[1:] == (None, "no interval of detected_share: 1 object of one drive, fewer than 5")

    tags = {log: {"site": "X"} for log in "abc"}
    found = summarise_groups(study(pd.DataFrame(rows), tags), parse_slices(["tags.site"]))
    # Rows weigh so that together they are as many as the ten objects.
    of_logs = [(8 * 10 / 15, 10 * 10 / 15), (3 * 10 / 15, 4 * 10 / 15), (10 / 15, 10 / 15)]
    assert limits(found, "X")[0] == pytest.approx(intervals.share(of_logs))
    assert limits(found, "X")[1] == "logs"
    del tags["c"]
    found = summarise_groups(study(pd.DataFrame(rows), tags), parse_slices(["tags.site"]))
    assert limits(found, "X")[1:] == (None, "no interval of detected_share: 2 logs, fewer than 3")


def test_the_horizon_is_that_of_the_study_and_a_group_followed_less_long_says_so() -> None:
    rows = drive("a", 1, 1, 1, 1, 1, 1) + drive("b", 1, 1, 1, 1, 1, ended_s=4.0, ended_by="log_end")
    found = summarise_groups(study(pd.DataFrame(rows), horizon_s=7.0), parse_slices(["log"]))
    assert found["ttd_rmst_horizon_s"].tolist() == [7.0, 7.0]
    assert found["note"].fillna("").tolist() == ["", "0 of 5 episodes that count (0 %) last 7 s"]


def by_began(words: Sequence[str]) -> list[Group]:
    rows = [*drive("a", 1, 2, began="log_start"), *drive("b", 3, began="crossed")]
    made = study(pd.DataFrame(rows))
    settings = SliceSettings(made.settings.configurations, 7.3, tuple(words))
    return StudyRows(settings, made.tags, made.tally, None, made.sums, None).split(parse_slice("began"))


def test_by_how_they_began_also_those_are_seen_that_do_not_count() -> None:
    assert [(group.label, len(group.rows.detections)) for group in by_began(["crossed"])] == [
        ("log_start", 2), ("crossed", 1),
    ]  # fmt: skip


def test_how_many_groups_stand_out_is_said_with_how_many_would_by_chance() -> None:
    none, every = [None] * 20, [1.0] * 20
    rows = drive("a", *none) + drive("b", *every) + drive("c", *none[:10], *every[:10]) + drive("d", 1)
    found = summarise_groups(study(pd.DataFrame(rows)), parse_slices(["log"]))
    assert found["apart"].tolist() == [True, True, False, None]
    assert describe_chance(found) == [
        "by log: 4 groups looked at in 1 configuration; of 3 intervals of detected_share 2 exclude the share of all "
        "groups, by chance alone at least 0.15 would"
    ]
    # Where all are detected no group can stand out.
    alike = summarise_groups(study(pd.DataFrame(drive("a", *every) + drive("b", *every))), parse_slices(["log"]))
    assert alike["apart"].tolist() == [None, None]
