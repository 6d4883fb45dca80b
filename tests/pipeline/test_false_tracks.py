"""False tracks: as the fusion numbers them, else linked within 2 m and 1 s; against a plain oracle, and by hand."""

from __future__ import annotations

import itertools
import math
from random import Random

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from copem_replay.core.object_list import entries_of
from copem_replay.core.tracks import CLASSES
from copem_replay.pipeline.false_tracks import describe_false_tracks, find_false_tracks

ISSUE_S = np.arange(40) * 0.1
CAR, PEDESTRIAN = CLASSES.index("car"), CLASSES.index("pedestrian")


def found(*entries: tuple[int, int, float, float], tracks: dict[int, int] | None = None) -> pd.DataFrame:
    """Of entries as (run, list, x, y), by the units a, b, a, b …; `tracks`: by place the fusion's number."""
    columns = entries_of(len(entries))
    columns["unit_ix"] = np.arange(len(entries)) % 2
    columns["existence"] = 0.1 * np.arange(1, len(entries) + 1)
    for name, k in (("x_m", 2), ("y_m", 3)):
        columns[name] = [entry[k] for entry in entries]
    for k, number in (tracks or {}).items():
        columns["track_id"][k] = number
    run_ix, list_ix = (np.array([entry[k] for entry in entries], dtype=np.int64) for k in (0, 1))
    classes = np.full(len(entries), PEDESTRIAN)
    return find_false_tracks(columns, classes, run_ix, list_ix, ISSUE_S, 0.3, ("a", "b"))


def test_one_that_walks_is_one_and_one_beside_it_another() -> None:
    """At 0, 0.1 and 0.3 s; the last list is held for 0.1 s, until the next one. 2.1 m away stands another."""
    table = found((0, 0, 0.0, 0.0), (0, 1, 1.9, 0.0), (0, 1, 0.0, 2.1), (0, 3, 3.8, 0.0))
    assert table["entries"].tolist() == [3, 1]
    assert table["begins_s"].tolist() == pytest.approx([0.0, 0.1])
    assert table["lasts_s"].tolist() == pytest.approx([0.4, 0.1])
    assert table[["x_m", "y_m", "to_x_m", "to_y_m"]].to_numpy().tolist() == [[0.0, 0.0, 3.8, 0.0], [0.0, 2.1, 0.0, 2.1]]
    assert table["units"].tolist() == ["b, a", "a"], "two of b, one of a"
    assert table["existence"].tolist() == pytest.approx([0.4, 0.3])
    assert table["object_class"].tolist() == ["pedestrian"] * 2
    assert table["track_id"].isna().all()


@pytest.mark.parametrize(("lists", "apart_m", "tracks"), [(10, 2.0, 1), (11, 2.0, 2), (10, 2.01, 2)])
def test_two_metres_and_one_second(lists: int, apart_m: float, tracks: int) -> None:
    assert len(found((0, 2, 5.0, 5.0), (0, 2 + lists, 5.0 + apart_m, 5.0))) == tracks


def test_the_nearest_pair_goes_first_and_runs_are_apart() -> None:
    """The second list has one between two: it is nearer to the right one, which leaves the left one to the other."""
    table = found((0, 0, 0.0, 0.0), (0, 0, 2.0, 0.0), (0, 1, 1.2, 0.0), (0, 1, 0.9, 0.0), (1, 1, 0.0, 0.0))
    assert table["run"].tolist() == [0, 0, 1]
    assert table[["x_m", "to_x_m"]].to_numpy().tolist() == [[0.0, 0.9], [2.0, 1.2], [0.0, 0.0]]


def test_the_fusion_numbers_its_own() -> None:
    """Far apart, for a long time, beside one without a number that is as near."""
    rows = (0, 0, 0.0, 0.0), (0, 30, 90.0, 0.0), (0, 30, 90.0, 0.5), (1, 0, 0.0, 0.0)
    table = found(*rows, tracks={0: 7, 1: 7, 3: 7})
    assert table[["run", "entries"]].to_numpy().tolist() == [[0, 2], [0, 1], [1, 1]]
    assert table["track_id"].fillna("none").tolist() == ["7", "none", "7"]
    assert table["lasts_s"].iloc[0] == pytest.approx(3.1)


def test_the_last_list_is_held_for_as_long_as_it_is_not_too_old() -> None:
    assert found((0, 39, 0.0, 0.0))["lasts_s"].tolist() == pytest.approx([0.3])


def test_none() -> None:
    assert not len(found())
    assert describe_false_tracks(found()) == "none"


def plainly(entries: list[tuple[int, int, float, float]]) -> list[list[int]]:
    """Places of the entries of each track: in each list the nearest pair of an entry and a track, again and again."""
    tracks: list[list[int]] = []
    for (run, number), group in itertools.groupby(range(len(entries)), key=lambda k: entries[k][:2]):
        free, taken = list(group), set()
        while True:
            pairs = [
                (math.dist(entries[k][2:], entries[track[-1]][2:]), k, t)
                for k in free
                for t, track in enumerate(tracks)
                if t not in taken and entries[track[-1]][0] == run and number - entries[track[-1]][1] <= 10
            ]
            pairs = [pair for pair in pairs if pair[0] <= 2.0]
            if not pairs:
                break
            _, k, t = min(pairs)
            tracks[t].append(k)
            taken.add(t)
            free.remove(k)
        for k in free:
            taken.add(len(tracks))
            tracks.append([k])
    return tracks


PLACES = st.tuples(st.integers(0, 1), st.integers(0, 30), st.floats(0, 6), st.floats(0, 3))


@given(st.lists(PLACES, max_size=25, unique=True), st.randoms())
def test_as_an_oracle_links_them_in_any_order(entries: list[tuple[int, int, float, float]], random: Random) -> None:
    # No two are exactly as far apart as linked ones are at most.
    entries = sorted(
        (run, number, round(x, 3) + 1e-5 * k, 0.997 * round(y, 2)) for k, (run, number, x, y) in enumerate(entries)
    )
    shuffled = entries.copy()
    random.shuffle(shuffled)
    table, expected = found(*shuffled), plainly(entries)
    ends = sorted((entries[t[0]][0], *entries[t[0]][2:], *entries[t[-1]][2:], len(t)) for t in expected)
    rows = table[["run", "x_m", "y_m", "to_x_m", "to_y_m", "entries"]].to_numpy(dtype=float)
    assert sorted(map(tuple, rows.tolist())) == [pytest.approx(end) for end in ends]
    assert int(table["entries"].sum()) == len(entries)


def test_in_words_the_longest_first_and_no_more_than_five() -> None:
    rows = [(0, k, 10.0 * k, 0.0) for k in range(7)]
    table = found(*rows, (0, 4, 30.0, 0.0))
    said = describe_false_tracks(table)
    assert said.split("; ")[:2] == [
        "pedestrian at (30, 0) m from 0.3 s on for 0.20 s, by b",
        "pedestrian at (0, 0) m from 0.0 s on for 0.10 s, by a",
    ]
    assert said.endswith("; and 2 more")
    assert said.count("pedestrian") == 5
