"""One set of facts: lanes, stories, stages and causes name the same of an object and a configuration.

By hand in a scene where a car hides, one is beyond the range, one is missed, and lists are late, lost, taken in at
ticks or not confirmed; then over the objects that viewers show of recordings, with the experiment that `init` drafts.
"""

from __future__ import annotations

import re
from html import unescape
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pytest

import copem_replay as cr
from copem_replay.experiment.draft.survey import survey_recording
from copem_replay.experiment.draft.template import format_draft
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.extras.stories.stories import story_parts
from copem_replay.extras.why.causes import Counterfactuals, name_cause, share_lateness
from copem_replay.extras.why.triage import find_places, tabulate_episodes
from copem_replay.report.figures.latency_breakdown import HIDDEN, IN_SIGHT, LISTED, OUT_OF_VIEW, mean_stages
from copem_replay.report.html.study import load_study
from copem_replay.results.read import read_results
from tests.helpers.recordings import Obj, pedestrian, write_recording
from tests.viewer.test_status import lane

ROOT = Path(__file__).parents[2]
SHARED = ROOT.parent / "shared/data"
SAMPLES = ("tc016d", "crossing_units")
RECORDINGS = ("av2_3b3570b4", "nuscenes_scene0061", "nuscenes_scene0916", "ind_aah1")
SEEN = ("rate", "outages", "missed", "memory")
"""Causes of an object in sight that is not listed."""
AFTERWARDS = {
    "way": ("processing", "queue", "latency", "ticks"), "lost": ("loss",), "unsent": ("sends",),
    "unmatched": ("fusion", "pose", "ghosts"), "unconfirmed": ("confirmation", "fusion"),
}  # fmt: skip
"""Causes of an object that is listed and not yet known."""


class Part(NamedTuple):
    """A time in which one thing is named: `out`, `hidden`, `seen`, `unlisted`, or one of `AFTERWARDS`.

    Seconds after the onset, and by whom.
    """

    what: str
    begin_s: float
    end_s: float
    by: str = ""


def name_part(words: str) -> tuple[str, str]:
    """What words of a lane or a story name, and who hides it."""
    if hider := re.match(r"behind (.*) \(from .*\)", words):
        return "hidden", hider[1]
    if re.match("out of range or view|no unit there", words):
        return "out", ""
    said = {
        "seen by .*, not listed": "seen", "on its way": "way", "list lost": "lost", "unmatched": "unmatched",
        "not sent": "unsent",
        "listed, not confirmed": "unconfirmed", "not listed": "unlisted", "known": "known",
    }  # fmt: skip
    return next(what for pattern, what in said.items() if re.match(pattern, words)), ""


def read_lane(path: Path, who: str, number: int, onset_s: float, until_s: float) -> list[Part]:
    """The parts of a lane between two instants."""
    said = [
        (when, words) for when, words in lane(path, who, number) if words not in ("from here", "from here it counts")
    ]
    ends = [when for when, _ in said[1:]] + [np.inf]
    parts = []
    for (begin_s, words), end_s in zip(said, ends, strict=True):
        begin_s, end_s = max(begin_s, onset_s), min(end_s, until_s)
        if words is not None and end_s > begin_s:
            what, by = name_part(words)
            parts.append(Part(what, begin_s - onset_s, end_s - onset_s, by))
    return parts


def read_story(sentence: str, length_s: float) -> list[Part]:
    """The parts of a clause of a story: `behind car 5 (from ego) until 1.10 s, known after 1.40 s, by …`."""
    parts, begin_s = [], 0.0
    for words, until in re.findall(r"(.+?) (?:until (-?[0-9.]+) s|to the end)(?:, |$)", sentence):
        end_s = float(until) if until else length_s
        what, by = name_part(words)
        parts.append(Part(what, begin_s, end_s, by))
        begin_s = end_s
    return parts


def read_stories(folder: Path) -> dict[str, dict[str, str]]:
    """By object, `pedestrian 2`, and configuration what stories say."""
    told = {}
    for part in story_parts(load_study(folder))[1:]:
        text = unescape(re.sub(r"<svg.*</svg>", "", part, flags=re.DOTALL))
        title, said = re.search(r"<h3[^>]*>(.*?): [^<]*</h3>", text), re.search(r"<p>(.*?)\.(?: <a | <code|</p>)", text)
        assert title
        assert said
        told[title[1]] = dict(clause.split(": ", 1) for clause in said[1].split("; "))
    return told


def read_causes(folder: Path, names: list[str]) -> dict[tuple[str, str], dict[str, Any]]:
    """By object and configuration the seconds of `why`, and who hides it; of the one run."""
    results, found = read_results(folder), {}
    [log] = results.provenance.logs
    alone = resolve_for_log(results.experiment, log.name)
    for name in names:
        replays = Counterfactuals(results.recording(log.name, alone), alone, name)
        shares = share_lateness(replays)
        episodes = tabulate_episodes(replays, shares)
        bodies = [body for _, body in find_places(replays.replay, episodes)]
        for k, (_, row) in enumerate(episodes.iterrows()):
            seconds = {name_cause(one): float(row[f"added {name_cause(one)}"]) for one in shares}
            found[row["object_id"], name] = seconds | {"hidden_by": bodies[k], "unknown_s": row["unknown_s"]}
    return found


def sum_of(parts: list[Part], what: str) -> float:
    return sum(part.end_s - part.begin_s for part in parts if part.what == what)


TEXT = """\
version: 1
logs: [drive.mcap]
runs: 1
pems:
  eyes:
    - {when: {range_m: [0, 20]}, detection: {kind: visible_share}}
    - {when: {range_m: [20, 50]}, detection: {kind: constant, probability: 1.0e-12}}
  short: [{when: {range_m: [0, 10]}, detection: {kind: visible_share}}]
  sure: [{when: {range_m: [0, 20]}, detection: {kind: visible_share}}]
links:
  far: {reception: {kind: table, distance_m: [50, 50.001], probability: [1, 0]}, latency: {kind: constant, s: 0.5}}
units:
  ego: {on: ego, height_m: 1.6, pem: eyes}
  mast: {at: [0, 80], height_m: 5.0, ground_z_m: 0.0, pem: short}
  van: {on: "6", height_m: 2.5, pem: sure}
  slow: {on: ego, height_m: 1.6, pem: eyes, sends: {interval_s: 1.0}}
configurations:
  now: {units: [ego]}
  late: {units: [ego, mast], latency_s: 0.5}
  mast: {units: [mast]}
  radio: {units: [van], link: far}
  ticks: {units: [ego], issue_hz: 0.5}
  sends: {units: [slow]}
measure:
  objects: {classes: [pedestrian]}
  onset: {kind: at, time_s: 0.0}
show: {run: 0}
"""
BY_HAND = {
    "2": [Part("hidden", 0.0, 1.1, "car 5")],
    "3": [Part("out", 0.0, 1.0), Part("seen", 1.0, 4.0)],
    "4": [Part("seen", 0.0, 0.5)],
}
"""Until 1.1 s car 5 is before pedestrian 2, 15 m ahead. Pedestrian 3 comes from 60 m at 10 m/s: at 1 s it is 50 m away,
within range, where next to no draw lists it, and from 20 m on, at 4 s, every one; so it is with 4, which is 21 m away
at first and 20 m at .5 s. The mast, 80 m away, has none of them within its 10 m: what the ego has counts."""


def wait(name: str, object_id: str) -> list[Part]:
    """From the first list on until the object is known: latency, the next tick of 0.5 Hz, six lists of ten a second.

    Or the next message, of which there is one a second.
    """
    since_s = BY_HAND[object_id][-1].end_s
    tick_s, message_s = 2.0 * np.ceil(since_s / 2.0), np.ceil(since_s)
    return {
        "now": [], "late": [Part("way", since_s, since_s + 0.5)],
        "confirmed": [Part("unconfirmed", since_s, since_s + 0.5)],
        "ticks": [Part("way", since_s, tick_s)] if tick_s > since_s else [],
        "sends": [Part("unsent", since_s, message_s)] if message_s > since_s else [],
    }[name]  # fmt: skip


BY_RADIO = [Part("lost", 0.0, 1.5), Part("way", 1.5, 2.0)]
"""The van, which comes at 10 m/s, lists pedestrian 7 from the first frame on; at 1.5 s it is nearer than 50 m to the
ego (45 m ahead and 20 m aside: 49.2 m; at 1.4 s it is 50.1 m away), and what it sends arrives, half a second later."""


@pytest.fixture(scope="module")
def by_hand(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("facts")
    wide = Obj(id=5, x=8.0, length=2.0, width=8.0, height=4.0, z=2.0)
    frames = [
        (0.1 * k, [
            Obj(id=1, x=0.0), pedestrian(2, 15.0), pedestrian(3, -60.0 + k, vx=10.0),
            pedestrian(4, 0.0, 21.0 - 0.2 * k, vy=-2.0), *([wide] if k <= 10 else []),
            Obj(id=6, x=-20.0, y=-60.0 + k, vy=10.0), pedestrian(7, -24.0, -50.0),
        ])
        for k in range(51)
    ]  # fmt: skip
    write_recording(place / "drive.mcap", frames, host=1)
    (place / "e.yaml").write_text(TEXT)
    (place / "confirmed.yaml").write_text(TEXT.replace("measure:\n", "measure:\n  confirm: {hits: 6, of: 6}\n"))
    cr.run(place / "confirmed.yaml", jobs=1).save(place / "confirmed")
    return cr.run(place / "e.yaml", jobs=1).save(place / "results")


@pytest.mark.parametrize(
    ("case", "object_id"), [*product(("now", "late", "ticks", "confirmed", "sends"), BY_HAND), ("radio", "7")]
)
def test_by_hand(by_hand: Path, case: str, object_id: str) -> None:
    """`confirmed`: `now`, where six lists in a row are asked for."""
    name, by_hand = ("now", by_hand.parent / "confirmed") if case == "confirmed" else (case, by_hand)
    results = read_results(by_hand)
    row = results.detections.set_index(["configuration", "object_id"]).loc[(name, object_id)]
    before = [] if name == "radio" else BY_HAND[object_id]
    expected = [*before, *(BY_RADIO if name == "radio" else wait(case, object_id))]
    known_s = expected[-1].end_s
    assert row["detection_s"] == pytest.approx(known_s)
    assert [row["out_of_view_s"], row["hidden_s"]] == pytest.approx([sum_of(expected, k) for k in ("out", "hidden")])
    number = list(results.experiment.configurations).index(name)
    assert read_lane(by_hand / "replay.rrd", f"{object_id} pedestrian", number, 0.0, known_s) == [
        Part(part.what, pytest.approx(part.begin_s), pytest.approx(part.end_s), part.by) for part in expected
    ]
    seconds = read_causes(by_hand, [name])[object_id, name]
    added = {cause: of for cause, of in seconds.items() if isinstance(of, float) and of > 1e-9}
    causes = {"out": "range", "hidden": "hidden", "seen": "missed", "lost": "loss", "unconfirmed": "confirmation"}
    causes["unsent"] = "sends"
    causes["way"] = "ticks" if name == "ticks" else "latency"
    by_cause = {cause: sum_of(expected, what) for what, cause in causes.items()} | {"unknown_s": known_s}
    assert added == pytest.approx({cause: of for cause, of in by_cause.items() if of})
    assert seconds["hidden_by"] == expected[0].by
    stages = mean_stages(pd.DataFrame([row]), results.experiment, name)
    found = [stages.get(stage, 0.0) for stage in (OUT_OF_VIEW, HIDDEN, IN_SIGHT)]
    # Without the columns of the way it is not known when it was first listed: not confirmed is in sight.
    seen_s = sum_of(expected, "seen") + sum_of(expected, "unconfirmed")
    assert found == pytest.approx([sum_of(expected, "out"), sum_of(expected, "hidden"), seen_s])
    assert sum(stages.values()) == pytest.approx(known_s)
    assert stages.get(LISTED, 0.0) >= sum_of(expected, "lost") - 1e-9


def test_stories_by_hand(by_hand: Path) -> None:
    """The mast never has any of them in view, the van only 7, which all others never have."""
    told = read_stories(by_hand)
    assert told.pop("pedestrian 7") == {
        "now": "out of range or view to the end, never known",
        "radio": "list lost until 1.50 s, on its way from van until 2.00 s, known after 2.00 s, by the list of van, "
        "which arrives 0.50 s late",
    }
    assert {name: clauses["now"] for name, clauses in told.items()} == {
        "pedestrian 2": "behind car 5 (from ego) until 1.10 s, known after 1.10 s, by the ego's own list",
        "pedestrian 3": "out of range or view until 1.00 s, seen by ego, not listed until 4.00 s, known after 4.00 s, "
        "by the ego's own list",
        "pedestrian 4": "seen by ego, not listed until 0.50 s, known after 0.50 s, by the ego's own list",
    }
    assert {clauses["mast"] for clauses in told.values()} == {"out of range or view to the end, never known"}


LEAST_S, APART_S = 0.5, 0.15
"""Times that lanes show and stories tell, and how much two may be apart: a list and a bit."""


@pytest.mark.parametrize("name", [*SAMPLES, *(pytest.param(name, marks=pytest.mark.long) for name in RECORDINGS)])
def test_no_two_outputs_name_different_causes(name: str, tmp_path: Path) -> None:
    if name in RECORDINGS and not (SHARED / f"{name}.mcap").exists():
        pytest.skip("no shared/data beside the project")
    sample = ROOT / "logs" / f"{name}.yaml"
    text = sample.read_text() if sample.exists() else format_draft(survey_recording(SHARED / f"{name}.mcap"))
    text = re.sub(r"(?m)^logs: \[(?!/)", f"logs: [{ROOT}/logs/", re.sub(r"(?m)^runs: \d+", "runs: 1", text))
    (tmp_path / "e.yaml").write_text(text)
    folder = cr.run(tmp_path / "e.yaml", jobs=1).save(tmp_path / "results")
    results, told = read_results(folder), read_stories(folder)
    shown = [one for one in results.experiment.configurations if one != "GT"]
    [path] = folder.glob("replay.rrd")
    causes = read_causes(folder, list(dict.fromkeys(one for clauses in told.values() for one in clauses)))
    table = results.detections.set_index(["configuration", "object_id"])
    compared = 0
    for who, clauses in told.items():
        object_id = who.split(" ", 1)[1]
        for one, clause in clauses.items():
            row, why = table.loc[(one, object_id)], causes[object_id, one]
            row = row.iloc[0] if isinstance(row, pd.DataFrame) else row
            listed_s = np.nanmin([row.get("listed_s", np.nan), row["captured_s"], row["ended_s"]])
            known_s = row["detection_s"] if row["detected"] else row["ended_s"]
            entity = f"{object_id} {row['object_class']}"
            seen = read_lane(path, entity, shown.index(one), row["onset_s"], known_s)
            story = read_story(clause, row["ended_s"] - row["onset_s"])
            where = f"{name}, {who}, {one}: {seen}, {clause}, {why}"
            for part in (part for part in seen if part.end_s - part.begin_s >= LEAST_S):
                assert any(part.what == other.what and part.by == other.by for other in story), where
                compared += 1
            for part in (part for part in story if part.end_s - part.begin_s >= LEAST_S):
                assert any(part.what == other.what and part.by == other.by for other in seen), where
            before = read_lane(path, entity, shown.index(one), row["onset_s"], listed_s)
            for what, cause, column in (("out", "range", "out_of_view_s"), ("hidden", "hidden", "hidden_s")):
                assert abs(row[column] - why.get(cause, 0.0)) <= APART_S, where
                assert abs(sum_of(before, what) - row[column]) <= LEAST_S + APART_S, where
            if sum_of(before, "hidden") >= LEAST_S:
                assert why["hidden_by"] in {part.by for part in seen}, where
            spent = sum_of(before, "seen")
            if spent >= LEAST_S:
                assert sum(why.get(cause, 0.0) for cause in SEEN) >= spent - LEAST_S, where
            for what, possible in AFTERWARDS.items():
                spent = sum_of(seen, what)
                if spent >= LEAST_S:
                    assert sum(why.get(cause, 0.0) for cause in possible) >= spent - LEAST_S, where
                    assert known_s - listed_s >= spent - LEAST_S - APART_S, where
    assert told
    assert compared > 0 or name in ("tc016d", "nuscenes_scene0916"), "whose objects are in sight at once"
