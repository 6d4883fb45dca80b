"""What became of the lists that units send by a link: in the events, and as lanes under those of the objects.

An ego, a pedestrian 30 m ahead, and a pole that lists him ten times a second for 5 s: at 0, 0.1, … 5 s, and by the link
each list arrives 50 ms after its capture. What arrives otherwise is written into the arrays by hand.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from copem_replay.pipeline import prepare as chunking
from copem_replay.pipeline.notes import measure_list_rates
from copem_replay.pipeline.one_run import RunTracks, tracks_of_run
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.viewer.lanes import FATES, LANES, UnitLists, find_linked_lists, group_fates, select_list_lanes
from tests.helpers.scenes import EGO_UNIT, SEES_ALL, Thing, experiment, recording, standing
from tests.viewer.test_line_of_sight import PERSON
from tests.viewer.test_rrd import Made, make, rerun, rows, static

MAST = {"at": [30, 5], "height_m": 6.0, "ground_z_m": 0.0, "pem": "all"}
AIR: dict[str, Any] = {
    "pems": {"sure": SEES_ALL, "all": SEES_ALL}, "units": {"ego": EGO_UNIT, "pole": MAST},
    "links": {"v2x": {"latency": 0.05}}, "measure": PERSON,
    "configurations": {"wired": {"units": ["pole"]}, "air": {"units": "all", "link": {"pole": "v2x"}}},
}  # fmt: skip


def standing_by() -> Any:
    return recording([Thing("ego", "car", standing(0, 0)), Thing("2", "pedestrian", standing(30, 0))], until_s=5.0)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return make(tmp_path_factory.mktemp("lists") / "replay.rrd", standing_by(), **AIR)


def arriving(made: Made, path: Path, way_s: dict[int, float], of: str = "air") -> Path:
    """The recording in which some lists of the pole have been so long on their way."""
    received = made.run_tracks[of].received
    arrives_s, pole = received.arrives_s.copy(), received.units.index("pole")
    for k, way in way_s.items():
        [frame] = np.flatnonzero((received.frame_unit_ix == pole) & (np.rint(received.captured_s * 10) == k))
        arrives_s[0, frame] = received.captured_s[frame] + way
    changed = replace(made.run_tracks[of], received=replace(received, arrives_s=arrives_s))
    made.write(path, run_tracks=made.run_tracks | {of: changed})
    return path


def events(path: Path, of: str = "air") -> list[tuple[float, str, str]]:
    return [
        (row["elapsed"] / 1e9, row["TextLog:level"][0], row["TextLog:text"][0])
        for row in rows(path, f"/events/{of}/lists")
    ]


def lane(path: Path, entity: str = "/lists/2_air/pole") -> list[tuple[float, str | None]]:
    return [(row["elapsed"] / 1e9, (row["StateChange:state"] or [None])[0]) for row in rows(path, entity)]


def entities(path: Path) -> set[str]:
    from rerun.chunk import RrdReader

    return {chunk.entity_path for chunk in RrdReader(path).stream()}


def shown(path: Path) -> set[str]:
    """Lanes of lists that views ask for."""
    from rerun.chunk import RrdReader

    reader, found = RrdReader(path), set()
    [blueprint] = reader.blueprints()
    for batch in (chunk.to_record_batch() for chunk in reader.stream(store=blueprint)):
        if "ViewContents:query" in batch.schema.names:
            found |= {line for line in batch.column("ViewContents:query")[0].as_py() if "lists" in line}
    return found


LOST = float("inf")


def test_lost_late_and_overtaken(made: Made, tmp_path: Path) -> None:
    """Lists 0 and 11 … 14 are lost. That of 2 s arrives after that of 2.1 s; those of 3 and 3.1 s as late, in order.

    Half of the lists take 0.05 s, and one comes every 0.1 s: 0.16 s is late, 0.14 s is not.
    """
    by_hand = {0: LOST} | dict.fromkeys(range(11, 15), LOST) | {20: 0.17, 30: 0.25, 31: 0.16, 32: 0.14}
    path = arriving(made, tmp_path / "x.rrd", by_hand)
    assert events(path) == [
        (0.0, "WARN", "air: pole: list lost, captured 0.00 s, next arrival 0.15 s"),
        (1.1, "WARN", "air: pole: 4 lists lost, captured 1.10 to 1.40 s, next arrival 1.55 s"),
        (2.0, "INFO", "air: pole: list overtaken, captured 2.00 s, arrived 2.17 s"),
        (3.0, "INFO", "air: pole: 2 lists late, captured 3.00 to 3.10 s, arrived 3.25 to 3.26 s"),
    ]
    assert lane(path) == [
        (0.0, "lost"), (0.1, None), (1.1, "4 lost"), (1.5, None), (2.0, "overtaken"), (2.1, None),
        (3.0, "2 late"), (3.2, None),
    ]  # fmt: skip
    values = static(path, "/lists/2_air/pole")
    assert values["StateConfiguration:values"] == ["lost", "4 lost", "overtaken", "2 late"]
    assert values["StateConfiguration:labels"] == [" ", "4 lost", " ", "2 late"], "no axis has those of 3 s"
    first, second, *others = values["StateConfiguration:colors"]
    assert first == second
    assert len({first, *others}) == 3
    assert shown(path) == {"+ /lists/2_air/pole"}
    assert "`lists/…`" in static(path, "/words")["TextDocument:text"][0]
    # The ego's own lists go by no link, and the other configuration has none.
    assert {entity for entity in entities(path) if "lists" in entity} == {"/lists/2_air/pole", "/events/air/lists"}


def test_how_long_lists_usually_take_is_of_those_that_arrive(made: Made) -> None:
    """Most are lost; of the others one takes .30 s where .05 s is usual: late, though a list counts for 1 s."""
    of = made.run_tracks["air"]
    arrives_s, pole = np.full_like(of.received.arrives_s, LOST), of.received.units.index("pole")
    frames = np.flatnonzero(of.received.frame_unit_ix == pole)
    frames = frames[np.argsort(of.received.captured_s[frames])]
    for k, way_s in enumerate((0.05, 0.05, 0.05, 0.30)):
        arrives_s[0, frames[k]] = of.received.captured_s[frames[k]] + way_s
    [lists] = find_linked_lists(replace(of, received=replace(of.received, arrives_s=arrives_s)), 1, "air", 1.0)
    fates = [FATES[fate] for fate in lists.fate]
    assert fates == ["in time"] * 3 + ["late"] + ["lost"] * 47


def test_lists_that_arrive_together_are_not_overtaken(made: Made, tmp_path: Path) -> None:
    """Those of 2.0 to 2.3 s arrive at 2.35 s, within a microsecond: two of them are late."""
    path = arriving(made, tmp_path / "x.rrd", {20: 0.35 + 0.9e-6, 21: 0.25, 22: 0.15})
    said = [text for _, _, text in events(path)]
    assert said == ["air: pole: 2 lists late, captured 2.00 to 2.10 s, arrived 2.35 s"]
    assert lane(path) == [(2.0, "2 late"), (2.2, None)]


def test_lists_that_follow_soon_are_told_together_and_the_last_one_has_no_next(made: Made, tmp_path: Path) -> None:
    """Every third list until 2.4 s: a row. Then one more, 1.1 s later; and all from 4.5 s on."""
    by_hand = dict.fromkeys([*range(0, 25, 3), 35, *range(46, 51)], LOST)
    path = arriving(made, tmp_path / "x.rrd", by_hand)
    assert [text for _, _, text in events(path)] == [
        "air: pole: 9 of 25 lists lost, captured 0.00 to 2.40 s, next arrival 2.55 s",
        "air: pole: list lost, captured 3.50 s, next arrival 3.65 s",
        "air: pole: 5 lists lost, captured 4.60 to 5.00 s, none arrives after",
    ]
    assert lane(path)[-2:] == [(4.6, "5 lost"), (5.1, None)]
    # Not for longer than 5 s in one row, unless no other list is between them.
    assert [text for _, _, text in events(arriving(made, path, dict.fromkeys(range(51), LOST)))] == [
        "air: pole: 51 lists lost, captured 0.00 to 5.00 s, none arrives after"
    ]
    long = UnitLists("pole", (), np.arange(120) / 10, np.full(120, np.inf), np.arange(120) % 2, 0.1)
    assert [len(some) for some in group_fates(long, 1)] == [26, 26, 8]


def test_older_than_what_counts_is_late_however_usual(made: Made, tmp_path: Path) -> None:
    """All lists take 1.2 s, more than `max_age_s`."""
    path = arriving(made, tmp_path / "x.rrd", dict.fromkeys(range(51), 1.2))
    assert [text for _, _, text in events(path)] == [
        "air: pole: 51 lists late, captured 0.00 to 5.00 s, arrived 1.20 to 6.20 s"
    ]
    path = arriving(made, path, dict.fromkeys(range(51), 0.9))
    assert events(path) == lane(path) == []


def test_without_a_link_nothing_is_told(made: Made, tmp_path: Path) -> None:
    """Nothing of lists that come in time either; the link `none` is as no link at all."""
    assert not any("lists" in entity for entity in entities(made.path))
    assert shown(made.path) == set()
    paths = []
    for name, link in (("none", "none"), ("without", None)):
        configurations = {"wired": {"units": ["pole"]}, "air": {"units": "all"} | ({"link": link} if link else {})}
        one = make(tmp_path / f"{name}.rrd", standing_by(), **AIR | {"configurations": configurations, "links": {}})
        assert one.run_tracks["air"].by_link is None
        paths.append(arriving(one, tmp_path / f"{name}_lost.rrd", {3: LOST}))
        assert not any("lists" in entity for entity in entities(paths[-1]))
        assert "`lists/…`" not in static(paths[-1], "/words")["TextDocument:text"][0]
    assert rerun("rrd", "compare", "--unordered", *paths).returncode == 0


DRAWN = AIR | {
    "runs": 4,
    "links": {
        "v2x": {"latency": {"kind": "gamma", "min_s": 0.02, "mean_s": 0.1, "shape": 1},
                "reception": {"kind": "constant", "probability": 0.8}},
    },
}  # fmt: skip


def test_shown_are_those_of_the_run_shown(tmp_path: Path) -> None:
    """Of each run what its arrays hold; all runs together what the summary has."""
    made = make(tmp_path / "x.rrd", standing_by(), **DRAWN)
    said, counts = {}, np.zeros(len(FATES), dtype=int)
    for run in range(4):
        received = tracks_of_run(made.replay, made.given, run)["air"].received
        pole = np.flatnonzero(received.frame_unit_ix == received.units.index("pole"))
        pole = pole[np.argsort(received.captured_s[pole])]
        arrives_s = received.arrives_s[0, pole]
        lost = np.isinf(arrives_s)
        overtaken = [not lost[k] and bool((arrives_s[k + 1 :] <= arrives_s[k]).any()) for k in range(len(pole))]
        tracks = tracks_of_run(made.replay, made.given, run)
        [of] = find_linked_lists(tracks["air"], 1, "air", 1.0)
        assert (of.fate == 1).tolist() == lost.tolist()
        assert (of.fate == 3).tolist() == overtaken
        made.write(tmp_path / f"{run}.rrd", run_tracks=tracks)
        states = dict(lane(tmp_path / f"{run}.rrd"))
        said[run] = tuple(at for at, state in states.items() if state is not None and state.endswith("lost"))
        assert set(said[run]) <= {round(float(s), 9) for s in received.captured_s[pole[lost]]}
        counts += np.bincount(of.fate, minlength=len(FATES))
    assert len(set(said.values())) == 4
    links = measure_list_rates(made.replay, made.given)["air"].links
    assert links is not None
    assert (counts.sum(), counts[1], counts[3]) == (links.sent, links.lost, links.overtaken)
    assert counts.min() > 0


def test_what_is_not_made_or_not_sent_is_not_lost(tmp_path: Path) -> None:
    """The pole is down a third of the time, and sends a message every 0.3 s at most; a link that loses nothing."""
    pole = MAST | {"outages": {"down_share": 0.3, "lasts_s": 0.5}, "sends": {"interval_s": 0.3}}
    made = make(tmp_path / "x.rrd", standing_by(), **AIR | {"units": {"ego": EGO_UNIT, "pole": pole}})
    [of] = find_linked_lists(made.run_tracks["air"], 1, "air", 1.0)
    assert 5 < len(of.fate) < 17
    assert not of.fate.any()
    lossy = AIR | {
        "units": {"ego": EGO_UNIT, "pole": pole},
        "links": {"v2x": {"reception": {"kind": "constant", "probability": 0.0}}},
    }
    [none] = find_linked_lists(make(tmp_path / "y.rrd", standing_by(), **lossy).run_tracks["air"], 1, "air", 1.0)
    assert none.captured_s.tolist() == of.captured_s.tolist()
    assert none.fate.tolist() == [1] * len(of.fate)


def test_a_carrier_that_is_not_equipped_loses_nothing(tmp_path: Path) -> None:
    fleet = {"on": {"classes": ["car"], "penetration_rate": 0.5}, "height_m": 1.6, "pem": "all"}
    cars = [Thing(f"c{k}", "car", standing(10 * k, 20)) for k in range(8)]
    log = recording(
        [Thing("ego", "car", standing(0, 0)), Thing("2", "pedestrian", standing(30, 0)), *cars], until_s=1.0
    )
    plan = experiment(**AIR | {
        "units": {"fleet": fleet}, "configurations": {"air": {"units": "all", "link": "v2x"}},
    })  # fmt: skip
    tracks = tracks_of_run(prepare_log(log, plan), plan, 0)["air"]
    lists = find_linked_lists(tracks, 0, "air", 1.0)
    assert 0 < len(lists) < 8
    assert not any(of.fate.any() for of in lists)
    # “fleet:c1” and its like need no escapes, and none has the lane of another.
    assert len({of.path for of in lists}) == len(lists)
    assert {of.path[-1] for of in lists} <= {f"fleet_c{k}" for k in range(8)}


def test_the_truth_by_a_link(tmp_path: Path) -> None:
    plan = AIR | {"configurations": {"GT": {"units": "truth", "link": "v2x"}}}
    made = make(tmp_path / "x.rrd", standing_by(), **plan)
    [of] = find_linked_lists(made.run_tracks["GT"], 0, "GT", 1.0)
    assert (of.unit, len(of.fate), of.fate.any()) == ("truth", 51, False)


def test_of_a_log_in_chunks_all_lists_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = experiment(**DRAWN)
    whole = tracks_of_run(prepare_log(standing_by(), plan), plan, 2)["air"]
    monkeypatch.setattr(chunking, "ROWS_AT_ONCE", 1)
    monkeypatch.setattr(chunking, "ROWS_A_CHUNK", 40)
    replay = prepare_log(standing_by(), plan)
    assert len(replay.chunks) > 2
    [expected] = find_linked_lists(whole, 1, "air", 1.0)
    for chunk in RunTracks(replay, plan, 2):
        [of] = find_linked_lists(chunk["air"], 1, "air", 1.0)
        assert of.fate.tolist() == expected.fate.tolist()
        assert of.arrives_s.tolist() == expected.arrives_s.tolist()


def test_under_an_object_are_the_units_with_the_most_marks_while_it_is_looked_at() -> None:
    """Unit k loses k lists from 2 s on, unit 0 none, and all of them all lists before."""
    at_s = np.arange(40) / 10
    fates = {k: (np.arange(40) < 20 + k).astype(int) for k in (3, 8, 0, 5, 1, 7, 2, 6)}
    units = [UnitLists(str(k), (str(k),), at_s, at_s, fate, 0.1) for k, fate in fates.items()]
    lists = {"a": units[:4], "b": units[4:], **{f"wired {k}": [] for k in range(LANES - 8)}}  # room for six
    assert select_list_lanes(lists, (2.0, 4.0)) == [("3",), ("8",), ("5",), ("7",), ("2",), ("6",)]
    assert len(select_list_lanes(lists, (0.0, 1.0))) == 6
    assert select_list_lanes(lists, (3.5, 4.0)) == []
