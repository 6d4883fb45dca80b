"""In words: what happened when, and the summary."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from copem_replay.experiment import Experiment
from copem_replay.replay import Replay
from copem_replay.show.out import Out, ns, part_of

_ENDINGS = {
    "object_left": "left undetected",
    "ego_left": "undetected when the ego left",
    "log_end": "undetected when the log ended",
}


def events(out: Out, name: str, part: pd.DataFrame) -> None:
    """Onset of each object, and how its look ended. `part`: the rows of one configuration."""
    import rerun as rr

    told = sorted((event for look in part.itertuples() for event in _story(look)), key=lambda event: event[0])
    text = [f"{name}: {sentence}" for _, _, sentence in told]
    columns = rr.TextLog.columns(text=text, level=[level for _, level, _ in told])
    out.columns(["events", part_of(name)], ns([time_s for time_s, _, _ in told]), columns)


def _story(look: Any) -> list[tuple[float, str, str]]:
    """When, how serious, what: of one row of the detections."""
    who = f"{look.object_id} {look.object_class}"
    first = ", already at its first frame" if look.onset_at_start else ""
    begin = (look.onset_s, "INFO", f"onset of {who}{first}")
    if not look.detected:
        return [begin, (look.ended_s, "WARN", f"{who} {_ENDINGS[look.ended_by]}")]
    late_s, far_m = look.time_to_detection_s, look.distance_at_detection_m
    when = f"{abs(late_s):.2f} s {'before' if late_s < 0 else 'after'} the onset"
    where = "" if np.isnan(far_m) else f", at {far_m:.1f} m"
    return [begin, (look.detection_s, "INFO", f"{who} detected by {look.first_unit} {when}{where}")]


def summary(out: Out, replay: Replay, experiment: Experiment, table: pd.DataFrame, run: int) -> None:
    """Which run this is, and the table over all runs and logs, configurations side by side."""
    import rerun as rr

    what = f"Run {run} of {replay.scene.log}, seed {experiment.seed}, visibility `{experiment.visibility}`"
    text = f"{what}. The table is over all runs and logs.\n\n{_markdown(table)}"
    out.static(["summary"], rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))


def _markdown(frame: pd.DataFrame) -> str:
    """A table with a column per row of `frame`: configurations side by side."""

    def cell(value: object) -> str:
        if value is None or value is pd.NA or (isinstance(value, float) and np.isnan(value)):
            return "–"
        text = f"{value:.4g}" if isinstance(value, float) else str(value)
        return text.replace("|", "\\|")

    lines = [[name, *(cell(value) for value in frame[name])] for name in frame.columns]
    lines.insert(1, ["---"] + ["---:"] * len(frame))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
