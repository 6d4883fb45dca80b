"""Stories: what happened to the objects that the viewer shows: known at different times, near the way of the ego.

Each is of one object in the run of the recordings for viewers: the plan at its onset, when the first configuration
knows it and when the last does, the lanes of all, and a sentence of why. Plans need the recording.
"""

from __future__ import annotations

import pandas as pd

from copem_replay.core.errors import RecordingError
from copem_replay.core.tracks import SAME_INSTANT_S
from copem_replay.extras.stories.story_facts import (
    ObjectStory,
    explain_story,
    find_spans,
    format_seconds,
)
from copem_replay.extras.stories.story_pictures import draw_story
from copem_replay.extras.why.report import read_why, why_late
from copem_replay.metrics.detections_table import first_episodes
from copem_replay.report.figures.paths import Drive, find_latest_log, read_drive
from copem_replay.report.html.markup import Html, link_player, make_tag, story_id
from copem_replay.report.html.study import NO_RECORDING, ReportData
from copem_replay.results.remedy import tell_what_helps
from copem_replay.results.shown_objects import choose_shown_objects

_NAMED = 6
"""Most ids in a sentence."""


def write_section(study: ReportData) -> tuple[str, list[Html]] | None:
    """Title and stories of the objects that the viewer shows; None: no object is measured."""
    return ("Stories of single objects", story_parts(study)) if len(study.results.known) else None


def story_parts(study: ReportData) -> list[Html]:
    """Stories of the objects that the viewer shows, of the drive on which objects stay unknown longest."""
    log = find_latest_log(study.results)
    run = study.results.provenance.run_shown.get(log, 0)
    table, rows = _rows_of_run(study, log, run)
    if not (rows["unknown_s"] > SAME_INSTANT_S).any():
        return [make_tag("p", f"Every configuration knows every object of {log} at once (run {run}).")]
    try:
        drive = read_drive(study.results, log)
    except RecordingError:
        return [make_tag("p", f"No plans of {log}: {NO_RECORDING}.")]
    chosen, too_short = choose_stories(drive, table, rows)
    episodes_of = {name: first_episodes(rows[rows["object_id"] == name]) for name in chosen}
    spans = find_spans(study, drive, run, episodes_of)
    intro = (
        f"Run {run} of {log}: the objects that copem-replay view shows. First are those that configurations know at "
        "the most different times, near the way of the ego."
    )
    named = ", ".join(too_short[:_NAMED]) + (", …" if len(too_short) > _NAMED else "")
    short = f" Too short to judge, seen for less than 2 s before or after it counts: {named}" if too_short else ""
    short += "." if short and not short.endswith("…") else ""
    parts = [make_tag("p", intro + short)]
    if episodes_of and not any(spans.values()):
        parts.append(make_tag("p", "What becomes of lists is not told: the run cannot be replayed again as it was."))
    for name, of in episodes_of.items():
        parts.append(_story_element(ObjectStory(study, drive, of, spans[name])))
    return parts


def _rows_of_run(study: ReportData, log: str, run: int) -> tuple[pd.DataFrame, pd.DataFrame]:
    """All rows of one run, and those that count, without the truth, with the seconds that objects stay unknown."""
    (table,) = study.results.each(log=log, every=True)
    table = table[table["run"] == run]
    rows = study.results.counted(table)
    rows = rows[rows["configuration"].isin(study.contenders)]
    unknown_s = rows["time_to_detection_s"].fillna(rows["ended_s"] - rows["onset_s"]).clip(lower=0.0)
    return table, rows.assign(unknown_s=unknown_s)


def choose_stories(drive: Drive, table: pd.DataFrame, rows: pd.DataFrame) -> tuple[list[str], tuple[str, ...]]:
    """Ids of the objects whose stories are told, by the rule of the viewer, and of those that are too short to judge.

    `table`: all rows of one run. `rows`: those that count, with `unknown_s`; what all know at its onset has no story.
    """
    shown = choose_shown_objects(drive.scene, drive.truth, drive.experiment, table)
    late = set(rows["object_id"][rows["unknown_s"] > SAME_INSTANT_S])
    ids = [drive.scene.object_ids[k] for k in shown.object_ix]
    return [name for name in ids if name in late], shown.too_short


def _name_difference(story: ObjectStory) -> str:
    """What tells configurations apart, in words: `known with rsu 2.30 s before PEM`, `never known`."""
    first, last, missed = story.first, story.last, story.rows[~story.rows["detected"]]
    if len(missed) == len(story.rows):
        return "never known"
    if len(missed):
        others = "every configuration but one" if len(missed) == len(story.rows) - 1 and len(missed) > 1 else ""
        names = [str(name) for name in missed["configuration"]]
        return f"never known with {others or ', '.join(names[:3]) + (', …' if len(names) > 3 else '')}"
    apart_s = last["unknown_s"] - first["unknown_s"]
    if apart_s <= SAME_INSTANT_S:
        return f"every configuration needs {format_seconds(first['unknown_s'])}"
    return f"known with {first['configuration']} {format_seconds(apart_s)} before {last['configuration']}"


def _story_element(story: ObjectStory) -> Html:
    """The HTML of a story: its title, words, links, causes, what helps, and its pictures."""
    hider, words = story.hider, explain_story(story)
    title = make_tag("h3", f"{story.name}: {_name_difference(story)}")
    log, command = story.drive.log, story.study.view_command(story.drive.log, story.object_id)
    links = [" ", link_player(log, story.object_id), *([" ", make_tag("code", command)] if command else [])]
    figure = make_tag(
        "div", draw_story(story, hider, words), class_="scroll", tabindex="0", role="region", aria_label=story.name
    )
    helps = tell_what_helps(story.drive.experiment, story.rows)
    late_causes = why_late(read_why(story.study.results), story.drive.log, story.object_id, story.onset_s)
    named_configurations = dict.fromkeys(str(row["configuration"]) for row in (story.first, story.last))
    lines = [f"{name} {late_causes.get(name, 'is not late')}" for name in named_configurations]
    causes = [make_tag("p", "Mean over all runs: ", "; ".join(lines), ".")] if late_causes else []
    causes = [make_tag("p", helps), *causes] if helps else causes
    return make_tag(
        "div", title, make_tag("p", words, *links), *causes, figure, class_="told", id_=story_id(log, story.object_id),
        data_log=log, data_story=story.object_id,
    )  # fmt: skip
