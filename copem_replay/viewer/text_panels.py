"""Text panels: what happened when, and the summary."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from copem_replay.core.tracks import Scene
from copem_replay.experiment.schema import Experiment
from copem_replay.metrics.end_reason import EndReason
from copem_replay.pipeline.prepare import Replay
from copem_replay.viewer.sink import Out, ns, part_of, short_ids, table_rows


def onsets(out: Out, scene: Scene, table: pd.DataFrame) -> None:
    """When the clock of each object began: the same for all configurations, and said once."""
    import rerun as rr

    episodes = table.drop_duplicates("object_id").sort_values("onset_s", kind="stable")
    text = [
        f"onset of {_named(episode, scene)}" + (", already at its first frame" if episode.onset_at_start else "")
        for episode in table_rows(episodes)
    ]
    out.columns(
        ["events", "onsets"], ns(episodes["onset_s"]), rr.TextLog.columns(text=text, level=["INFO"] * len(text))
    )


def events(out: Out, scene: Scene, name: str, part: pd.DataFrame) -> None:
    """How each episode ended. `part`: the rows of one configuration."""
    import rerun as rr

    told = sorted((_ending(episode, scene) for episode in table_rows(part)), key=lambda event: event[0])
    text = [f"{name}: {sentence}" for _, _, sentence in told]
    columns = rr.TextLog.columns(text=text, level=[level for _, level, _ in told])
    out.columns(["events", part_of(name)], ns([time_s for time_s, _, _ in told]), columns)


def _named(episode: Any, scene: Scene) -> str:
    return f"{short_ids(scene)[scene.object_number[episode.object_id]]} {episode.object_class}"


def _ending(episode: Any, scene: Scene) -> tuple[float, str, str]:
    """When, how serious, what: of one row of the detections."""
    named, verdict = _named(episode, scene), verdict_of(episode)
    then = f"; the ego {verdict}" if verdict else ""
    if not episode.detected:
        why = EndReason(episode.ended_by)
        ending = f"undetected when {why.past}" if why.censors else "left undetected"
        return episode.ended_s, "WARN", f"{named} {ending}{then}"
    late_s, far_m = episode.time_to_detection_s, episode.distance_at_detection_m
    when = f"{abs(late_s):.2f} s {'before' if late_s < 0 else 'after'} the onset"
    where = "" if np.isnan(far_m) else f", at {far_m:.1f} m"
    passed = verdict is None or episode.braking_pass
    return (
        episode.detection_s,
        "INFO" if passed else "WARN",
        f"{named} detected by {episode.first_unit} {when}{where}{then}",
    )


def verdict_of(episode: Any) -> str | None:
    """What becomes of a row of the detections that is in conflict: “stops” is to stay clear by braking; else None."""
    if not getattr(episode, "conflict", False):
        return None
    return "stays clear" if episode.braking_pass else "does not stay clear"


def differences(out: Out, replay: Replay, table: pd.DataFrame, shown: Sequence[int], left_out: Sequence[str]) -> None:
    """What difference it made in this run: of several objects one table of all first, then one of each."""
    import rerun as rr

    of_each = [table[table["object_id"] == replay.scene.object_ids[k]] for k in shown]
    tables = [_difference(episodes, replay.scene) for episodes in of_each]
    if len(shown) > 1:
        tables.insert(0, _overview(of_each, replay.scene))
    text = "\n\n".join([*tables, *_left_out(left_out)])
    out.static(["difference"], rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))


def _difference(episodes: pd.DataFrame, scene: Scene) -> str:
    first = table_rows(episodes)[0]
    braking = bool(getattr(first, "conflict", False))
    head = ["configuration", "known after", "at", *(["verdict", "closest"] if braking else []), "by"]
    lines = [f"| {' | '.join(head)} |", "| --- |" + " ---: |" * (len(head) - 1)]
    for episode in table_rows(episodes):
        cells = [
            f"{episode.time_to_detection_s:.2f} s" if episode.detected else "never",
            _metres(episode.distance_at_detection_m),
        ]
        if braking:
            verdict = "pass" if episode.braking_pass else "**fail**"
            if not episode.braking_pass and episode.impact_speed_mps > 0:
                verdict += f" at {episode.impact_speed_mps:.1f} m/s"
            cells += [verdict, _metres(episode.min_distance_m)]
        unit = episode.first_unit if episode.detected else "–"
        lines.append(f"| {_cell(episode.configuration)} | {' | '.join(cells)} | {unit} |")
    return f"**{_named(first, scene)}**, onset at {first.onset_s:.2f} s\n\n" + "\n".join(lines)


def _overview(of_each: Sequence[pd.DataFrame], scene: Scene) -> str:
    """A row per configuration, a column per object: known how long after its onset, and a verdict that is a failure."""
    ids = [short_ids(scene)[scene.object_number[episodes["object_id"].iloc[0]]] for episodes in of_each]
    lines = [f"| known after onset of | {' | '.join(map(_cell, ids))} |", "| --- |" + " ---: |" * len(ids)]
    of = [{episode.configuration: episode for episode in table_rows(episodes)} for episodes in of_each]
    for name in of_each[0]["configuration"]:
        cells = []
        for episodes in of:
            after = f"{episodes[name].time_to_detection_s:.2f} s" if episodes[name].detected else "never"
            cells.append(after + {None: "", "stays clear": ""}.get(verdict_of(episodes[name]), " **fail**"))
        lines.append(f"| {_cell(name)} | {' | '.join(cells)} |")
    return "\n".join(lines)


def legend(out: Out, links: bool) -> None:
    """What colours and lines mean, in words; `links`: whether there are lanes of lists."""
    import rerun as rr

    text = LEGEND + LINKS if links else LEGEND
    out.static(["words"], rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))


def _cell(text: object) -> str:
    return str(text).replace("|", "\\|")


def _metres(value: Any) -> str:
    return "–" if value is None or pd.isna(value) else f"{value:.1f} m"


def _left_out(names: Sequence[str]) -> list[str]:
    if not names:
        return []
    return [f"In further files: {', '.join(names)}."]


LEGEND = """A configuration has one colour in every file and figure of its experiment.

- grey outlines: what was there, and the ways of those we look at; the white body: the ego; grey bodies: obstacles
- filled in colour: what is believed, where it is believed to be, paler the older it is (0 to 1 s); ellipses: 2σ of the
  position
- words over an object we look at: only its name, it is known; else why it is not: `58 behind 41`; a
  sentence, when it is selected
- red lines: from the unit that sees most of an object to what hides it
- lines of sight: from the unit that listed an object first, where it was at capture, to where it listed the object
- strong lines on the ground: distance when an object was first known
- white points: units; pale ground with an outline: their fields of view
- lanes: in full colour *known*, from the time of detection in the table on; at half its strength *listed*, which does
  not count: before the onset, not confirmed, or too late; grey and brown: why not; the white mark ends at the onset
- compared with a baseline: a large white dot, only the baseline holds it; a small one, the baseline does not"""
LINKS = """
- lanes `lists/…` under those of an object: a unit that sends by a link; from the capture of a list to that of the next,
  if it was *lost*, *late* (longer on its way than `max_age_s`, or by an interval of its lists longer than usual) or
  *overtaken* by a newer one, which fusions of the newest lists then go by alone; else it came in time"""


def summary(
    out: Out, replay: Replay, experiment: Experiment, table: pd.DataFrame, run: int, left_out: Sequence[str]
) -> None:
    """Which run this is, and the table over all runs and logs, configurations side by side."""
    import rerun as rr

    what = f"Run {run} of {replay.scene.log}, seed {experiment.seed}, visibility `{experiment.visibility.label}`"
    text = f"{what}. The table is over all runs and logs.\n\n{_markdown(table)}"
    text = "\n\n".join([text, *_left_out(left_out)])
    out.static(["summary"], rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))


def _markdown(frame: pd.DataFrame) -> str:
    """A table with a column per row of `frame`: configurations side by side."""

    def cell(value: object) -> str:
        if value is None or value is pd.NA or (isinstance(value, float) and np.isnan(value)):
            return "–"
        text = f"{value:.4g}" if isinstance(value, float) else str(value)
        return _cell(text)

    lines = [[name, *(cell(value) for value in frame[name])] for name in frame.columns]
    lines.insert(1, ["---"] + ["---:"] * len(frame))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
