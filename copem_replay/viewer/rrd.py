"""The file: everything put together, complete under its name or not there."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version
from itertools import chain
from pathlib import Path

import numpy as np
import pandas as pd

from copem_replay.core.colours import Rgb, configuration_colours
from copem_replay.core.fused_tracks import Belief
from copem_replay.core.tracks import TRUTH
from copem_replay.experiment.schema import Experiment
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.visibility_curves import share_curves
from copem_replay.viewer import (
    blueprint as layout,
)
from copem_replay.viewer import (
    boxes as world,
)
from copem_replay.viewer import (
    curves as plots,
)
from copem_replay.viewer import (
    differences,
)
from copem_replay.viewer import (
    event_markers as marks,
)
from copem_replay.viewer import (
    sensors as units,
)
from copem_replay.viewer import (
    status_drawing as knowledge,
)
from copem_replay.viewer import (
    text_panels as words,
)
from copem_replay.viewer.camera import eye_on, follow
from copem_replay.viewer.kept import Kept
from copem_replay.viewer.line_of_sight import sight
from copem_replay.viewer.selection import SHOWN_OBJECTS, VIEWED, telling, viewed
from copem_replay.viewer.sink import Out, digest, part_of
from copem_replay.viewer.status import clock_of, status_of
from copem_replay.viewer.stream import Live, file_stream


def write_rrd(
    path: Path,
    replay: Replay,
    experiment: Experiment,
    beliefs: Iterable[Mapping[str, Belief]],
    table: pd.DataFrame,
    summary: pd.DataFrame,
    run: int,
    *,
    run_is: str = "",
    baseline: str | None = None,
    viewer: str | None = None,
) -> list[str]:
    """Write one run of one log, and send it to a viewer, too. Returns what has to be said. Raises OutputError.

    `beliefs`: stretch by stretch, per configuration what the receiver believes in this run, a frame per list it issued
    (one unit, values (1, P)). `table`: the rows of `detections.parquet` of this log and run. `summary`: of all logs and
    runs. `run_is`: why it is this run, part of the recording's name. `baseline`: the configuration differences to which
    are marked.
    """
    import rerun as rr

    rest = iter(beliefs)
    first = next(rest)
    chosen = viewed(experiment, list(first), baseline)
    left_out = [name for name in first if name not in chosen]
    of_chosen = table["configuration"].isin(chosen)
    truths = [name for name in chosen if experiment.configurations[name].units == TRUTH]
    shown = [replay.scene.object_number[name] for name in telling(table[of_chosen], truths, SHOWN_OBJECTS)]
    eye = eye_on(replay, experiment, table, layout.aspect(len(chosen)))
    blueprint, appearance = layout.blueprint(replay, experiment, table, chosen, shown, eye, baseline)
    # The viewer takes two files of one identity for one recording.
    ids = f"copem_replay:{appearance}", digest(experiment.model_dump_json(), replay.scene.log, str(run), run_is)
    strict = rr.strict_mode()
    rr.set_strict_mode(True)  # else a column that does not fit is left out with a warning
    every = configuration_colours(first)  # as in the MCAP, which has all of them
    colours = {name: every[name] for name in chosen}
    live = None
    try:
        with file_stream(path, *ids) as rec:
            live = Live(viewer, *ids) if viewer is not None else None
            out = Out(rec, replay.scene.t0_ns, live)
            rec.send_blueprint(blueprint, make_active=False)  # whoever has changed the layout keeps it
            if live is not None:
                live.send(lambda rec: rec.send_blueprint(blueprint, make_active=True))  # else it makes up its own
            follow(out, replay, experiment, eye)
            _properties(out, replay, experiment, chosen, run, run_is)
            _world(out, replay, experiment, table[of_chosen], summary, run, shown, left_out, colours)
            if baseline is not None:  # of all objects at once: such a log is not long
                kept = {name: first[name] for name in colours}
                differences.differences(out, replay, experiment, kept, table[of_chosen], baseline, shown, colours)
            told, of_stretch = Kept(shown), chain(iter([first]), rest)
            del first  # one stretch's is held at a time
            for stretch in of_stretch:
                _believed(out, replay, experiment, stretch, table[of_chosen], shown, colours)
                told.add({name: stretch[name] for name in colours})
            _knowledge(out, replay, experiment, told.whole(), table[of_chosen], shown, colours)
    finally:
        rr.set_strict_mode(strict)
        if live is not None:
            live.close()
    said = []
    if left_out:
        said.append(
            f"{path.name}: without {', '.join(left_out)}; `show: {{configurations: […]}}` chooses up to {VIEWED}"
        )
    if live is not None and live.gone:
        said.append(f"{path.name}: the viewer at {viewer} went before it had everything; the file is complete")
    return said


def _world(
    out: Out, replay: Replay, experiment: Experiment, table: pd.DataFrame, summary: pd.DataFrame, run: int,
    shown: Sequence[int], left_out: Sequence[str], colours: Mapping[str, Rgb],
) -> None:  # fmt: skip
    """What was there, and what came of it."""
    import rerun as rr

    scene = replay.scene
    out.static([], rr.ViewCoordinates.RIGHT_HAND_Z_UP, world.names_and_colours(scene))
    words.differences(out, replay, table, shown, left_out)
    words.summary(out, replay, experiment, summary, run, left_out)
    words.legend(out)
    words.onsets(out, scene, table)
    world.statics(out, replay.placed.static)
    world.lane_boundaries(out, replay.lane_boundaries)
    units.units(out, replay, experiment)
    marks.onsets(out, replay, experiment, table, shown)
    world.truth(out, scene, replay.truth, shown)
    for name, colour in colours.items():
        words.events(out, scene, name, table[table["configuration"] == name])
        marks.detections(out, replay, experiment, table, name, shown, colour)
    rows = replay.rows_of(np.array(shown, dtype=np.int64))
    for k in shown:
        curves = share_curves(replay, rows, k)
        plots.visible_share(out, scene.object_ids[k], curves)
        marks.on_curves(out, replay, experiment, table, scene.object_ids[k], curves, colours)
    if len(replay.looks.object_ix):
        plots.known(out, replay, "truth", replay.truth)


def _knowledge(
    out: Out, replay: Replay, experiment: Experiment, beliefs: Mapping[str, Belief], table: pd.DataFrame,
    shown: Sequence[int], colours: Mapping[str, Rgb],
) -> None:  # fmt: skip
    """Why, and since when. `beliefs`: of the shown objects, over all of the log."""
    seen = sight(replay, experiment, shown)
    made = {}
    for name, colour in colours.items():
        clock = clock_of(replay.scene, table, name)
        made[name] = status_of(replay, experiment, name, beliefs[name], seen, clock)
        knowledge.words(out, name, replay, experiment, seen, made[name], clock)
        knowledge.hiding(out, name, seen, made[name])
        asked = experiment.configurations[name]
        knowledge.listings(out, name, replay, experiment, asked, beliefs[name], seen, colour)
    if shown:  # their onsets and ends are the same in all configurations
        knowledge.lanes(out, replay.scene, seen, made, colours, clock)


def _believed(
    out: Out, replay: Replay, experiment: Experiment, beliefs: Mapping[str, Belief], table: pd.DataFrame,
    shown: Sequence[int], colours: Mapping[str, Rgb],
) -> None:  # fmt: skip
    """What each configuration knew in a stretch, and how far off that was."""
    for name, colour in colours.items():
        world.believed(out, ["world", part_of(name)], replay.scene, beliefs[name], colour)
        plots.position_errors(out, replay, experiment, name, beliefs[name].fused, shown, colour)
        if len(replay.looks.object_ix):
            plots.gospas(out, replay, experiment, name, beliefs[name], colour)
            since_ns = clock_of(replay.scene, table, name).known_ns
            plots.known(out, replay, name, beliefs[name].fused, colour, since_ns)


def _properties(
    out: Out, replay: Replay, experiment: Experiment, configurations: list[str], run: int, run_is: str
) -> None:
    import rerun as rr

    name = f"{replay.scene.log}: run {run}" + (f": {run_is}" if run_is else "")
    out.send(lambda rec: rec.send_recording_name(name))
    out.send(lambda rec: rec.send_recording_start_time_nanos(replay.scene.t0_ns))
    values = rr.AnyValues(
        log=replay.scene.log,
        run=run,
        run_is=run_is,
        seed=experiment.seed,
        visibility=experiment.visibility.label,
        configurations=configurations,
        copem_replay=version("copem-replay"),
        rerun_sdk=version("rerun-sdk"),
    )
    out.send(lambda rec: rec.send_property("replay", values))
