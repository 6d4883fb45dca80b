"""The file: everything put together, complete under its name or not there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pandas as pd

from copem_replay.atomic import atomic_file
from copem_replay.colours import configuration_colours
from copem_replay.errors import OutputError
from copem_replay.experiment import Experiment
from copem_replay.fusion.belief import Belief
from copem_replay.replay import Replay
from copem_replay.show import differences, layout, marks, plots, sight, units, words, world
from copem_replay.show.out import Out, digest, part_of

SHOWN_OBJECTS = 6
"""How many measured objects have names, lines of sight, marks and plots of their own (chosen)."""


def write_rrd(
    path: Path,
    replay: Replay,
    experiment: Experiment,
    beliefs: Mapping[str, Belief],
    table: pd.DataFrame,
    summary: pd.DataFrame,
    run: int,
    *,
    run_is: str = "",
    baseline: str | None = None,
) -> None:
    """Write one run of one log. Raises OutputError.

    `beliefs`: per configuration what the receiver believes in this run, a frame per list it issued (one unit, values
    (1, P)). `table`: the rows of `detections.parquet` of this log and run. `summary`: of all logs and runs. `run_is`:
    why it is this run, part of the recording's name. `baseline`: the configuration differences to which are marked.
    """
    import rerun as rr

    shown = [replay.scene.object_number[name] for name in latest_known(table, SHOWN_OBJECTS)]
    blueprint, appearance = layout.blueprint(replay, experiment, table, list(beliefs), shown, baseline)
    # The viewer takes two files of one identity for one recording.
    identity = digest(experiment.model_dump_json(), replay.scene.log, str(run), run_is)
    strict = rr.strict_mode()
    rr.set_strict_mode(True)  # else a column that does not fit is left out with a warning
    try:
        with rr.RecordingStream(f"copem_replay:{appearance}", recording_id=identity, send_properties=False) as rec:
            if not rr.is_enabled(rec):
                raise OutputError(f"{path}: not written, Rerun is switched off (RERUN=off in the environment?)")
            # Not `save`: on a full disk it waits for ever, or leaves half a file and says nothing.
            memory = rec.memory_recording()
            rec.send_blueprint(blueprint, make_active=False)
            _fill(
                Out(rec, replay.scene.t0_ns), replay, experiment, beliefs, table, summary, run, run_is, shown, baseline
            )
        with atomic_file(path) as scratch:
            scratch.write_bytes(memory.drain_as_bytes())
    finally:
        rr.set_strict_mode(strict)


def latest_known(table: pd.DataFrame, most: int) -> list[str]:
    """Ids of the objects that some configuration was last to know (never counts as last), in the table's order."""
    time_s = table["time_to_detection_s"].fillna(np.inf)
    worst = time_s.groupby(table["object_id"], sort=False).max()
    chosen = set(worst.sort_values(ascending=False, kind="stable").index[:most])
    return [name for name in worst.index if name in chosen]


def _fill(
    out: Out, replay: Replay, experiment: Experiment, beliefs: Mapping[str, Belief], table: pd.DataFrame,
    summary: pd.DataFrame, run: int, run_is: str, shown: Sequence[int],
    baseline: str | None,
) -> None:  # fmt: skip
    import rerun as rr

    scene = replay.scene
    colours = configuration_colours(beliefs)
    _properties(out, replay, experiment, list(beliefs), run, run_is)
    out.static([], rr.ViewCoordinates.RIGHT_HAND_Z_UP, world.class_colours())
    world.truth(out, scene, replay.truth, shown)
    world.statics(out, replay.placed.static)
    units.units(out, replay, experiment)
    sight.sight(out, replay, experiment, shown)
    marks.onsets(out, replay, experiment, table, shown)
    for k in shown:
        curves = plots.share_curves(replay, experiment, k)
        plots.visible_share(out, scene.object_ids[k], curves)
        marks.on_curves(out, replay, experiment, table, scene.object_ids[k], curves, colours)
    for name, colour in colours.items():
        world.believed(out, ["world", part_of(name)], scene, beliefs[name], colour)
        marks.detections(out, replay, experiment, table, name, shown, colour)
        plots.position_errors(out, replay, experiment, name, beliefs[name].fused, shown, colour)
        words.events(out, name, table[table["configuration"] == name])
    if len(replay.looks.object_ix):
        plots.known(out, replay, {name: belief.fused for name, belief in beliefs.items()}, colours)
    if baseline is not None:
        differences.differences(out, replay, experiment, beliefs, table, baseline, shown, colours)
    words.summary(out, replay, experiment, summary, run)


def _properties(
    out: Out, replay: Replay, experiment: Experiment, configurations: list[str], run: int, run_is: str
) -> None:
    import rerun as rr

    out.rec.send_recording_name(f"{replay.scene.log}: run {run}" + (f": {run_is}" if run_is else ""))
    out.rec.send_recording_start_time_nanos(replay.scene.t0_ns)
    values = rr.AnyValues(
        log=replay.scene.log,
        run=run,
        run_is=run_is,
        seed=experiment.seed,
        visibility=experiment.visibility,
        configurations=configurations,
        copem_replay=version("copem-replay"),
        rerun_sdk=version("rerun-sdk"),
    )
    out.rec.send_property("replay", values)
