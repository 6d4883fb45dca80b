"""The file: everything put together, complete under its name or not there."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from copem_replay.core.colours import Rgb, configuration_colours
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import TRUTH
from copem_replay.experiment.schema import Experiment
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.visibility_curves import share_curves
from copem_replay.viewer import (
    blueprint,
    boxes,
    curves,
    differences,
    event_markers,
    sensors,
    status_drawing,
    text_panels,
)
from copem_replay.viewer.camera import eye_on, follow
from copem_replay.viewer.kept import Kept
from copem_replay.viewer.line_of_sight import sight
from copem_replay.viewer.selection import SHOWN_OBJECTS, VIEWED, telling, viewed
from copem_replay.viewer.sink import Out, digest, part_of
from copem_replay.viewer.status import clock_of, status_of
from copem_replay.viewer.stream import Live, file_stream
from copem_replay.viewer.unit_faults import FaultsShown

if TYPE_CHECKING:  # a second to import: only where something is written
    from rerun import blueprint as rrb


def write_rrd(
    path: Path,
    replay: Replay,
    experiment: Experiment,
    run_tracks: Iterable[Mapping[str, FusedTracks]],
    table: pd.DataFrame,
    summary: pd.DataFrame,
    run: int,
    *,
    run_is: str = "",
    baseline: str | None = None,
    viewer: str | None = None,
) -> list[str]:
    """Write one run of one log, and send it to a viewer, too. Returns notes for the user. Raises OutputError.

    `run_tracks`: one time chunk after the other, per configuration the receiver's fused tracks in this run, a frame per
    list it issued (one unit, values (1, P)). `table`: the rows of `detections.parquet` of this log and run. `summary`:
    of all logs and runs. `run_is`: why it is this run, part of the recording's name. `baseline`: the configuration
    differences to which are marked.
    """
    rest = iter(run_tracks)
    first = next(rest)
    chosen = viewed(experiment, list(first), baseline)
    left_out = [name for name in first if name not in chosen]
    of_chosen = table["configuration"].isin(chosen)
    truths = [name for name in chosen if experiment.configurations[name].units == TRUTH]
    shown = [replay.scene.object_number[name] for name in telling(table[of_chosen], truths, SHOWN_OBJECTS)]
    eye = eye_on(replay, experiment, table, blueprint.aspect(len(chosen)))
    panels, appearance = blueprint.blueprint(replay, experiment, table, chosen, shown, eye, baseline)
    # The viewer takes two files of one identity for one recording.
    ids = f"copem_replay:{appearance}", digest(experiment.model_dump_json(), replay.scene.log, str(run), run_is)
    every = configuration_colours(first)  # as in the MCAP, which has all of them
    colours = {name: every[name] for name in chosen}
    with _streams(path, ids, replay.scene.t0_ns, viewer) as out:
        _send_blueprint(out, panels)
        follow(out, replay, experiment, eye)
        _properties(out, replay, experiment, chosen, run, run_is)
        _world(out, replay, experiment, table[of_chosen], summary, run, shown, left_out, colours)
        if baseline is not None:  # of all objects at once: such a log is not long
            kept = {name: first[name] for name in colours}
            differences.differences(out, replay, experiment, kept, table[of_chosen], baseline, shown, colours)
        faults = FaultsShown(out, replay, experiment)
        told, chunks = Kept(shown), chain(iter([first]), rest)
        del first  # one chunk's is held at a time
        for chunk in chunks:
            _believed(out, replay, experiment, chunk, table[of_chosen], shown, colours)
            faults.add(chunk)
            told.add({name: chunk[name] for name in colours})
        _knowledge(out, replay, experiment, told.whole(), table[of_chosen], shown, colours)
    return list(_notes(path.name, left_out, out.live))


@contextmanager
def _streams(path: Path, ids: tuple[str, str], t0_ns: int, viewer: str | None) -> Iterator[Out]:
    """The file, and the viewer if there is one, for as long as a recording is written. Raises OutputError."""
    import rerun as rr

    live = None
    strict = rr.strict_mode()
    rr.set_strict_mode(True)  # else a column that does not fit is left out with a warning
    try:
        with file_stream(path, *ids) as rec:
            live = Live(viewer, *ids) if viewer is not None else None
            yield Out(rec, t0_ns, live)
    finally:
        rr.set_strict_mode(strict)
        if live is not None:
            live.close()


def _send_blueprint(out: Out, panels: rrb.Blueprint) -> None:
    """Active, so that neither the heuristics of a viewer apply nor, in a browser, a layout of its own."""
    out.rec.send_blueprint(panels, make_active=True)
    if out.live is not None:
        out.live.send(lambda rec: rec.send_blueprint(panels, make_active=True))


def _notes(name: str, left_out: Sequence[str], live: Live | None) -> Iterator[str]:
    if left_out:
        yield f"{name}: without {', '.join(left_out)}; `show: {{configurations: […]}}` chooses up to {VIEWED}"
    if live is not None and live.gone:
        yield f"{name}: the viewer at {live.url} went before it had everything; the file is complete"


def _world(
    out: Out, replay: Replay, experiment: Experiment, table: pd.DataFrame, summary: pd.DataFrame, run: int,
    shown: Sequence[int], left_out: Sequence[str], colours: Mapping[str, Rgb],
) -> None:  # fmt: skip
    """What was there, and what came of it."""
    import rerun as rr

    scene = replay.scene
    out.static([], rr.ViewCoordinates.RIGHT_HAND_Z_UP, boxes.names_and_colours(scene))
    text_panels.differences(out, replay, table, shown, left_out)
    text_panels.summary(out, replay, experiment, summary, run, left_out)
    text_panels.legend(out)
    text_panels.onsets(out, scene, table)
    boxes.statics(out, replay.placed.static)
    boxes.lane_boundaries(out, replay.lane_boundaries)
    sensors.units(out, replay, experiment)
    event_markers.onsets(out, replay, experiment, table, shown)
    boxes.truth(out, scene, replay.truth, shown)
    for name, colour in colours.items():
        text_panels.events(out, scene, name, table[table["configuration"] == name])
        event_markers.detections(out, replay, experiment, table, name, shown, colour)
    rows = replay.rows_of(np.array(shown, dtype=np.int64))
    for k in shown:
        shares = share_curves(replay, rows, k)
        curves.visible_share(out, scene.object_ids[k], shares)
        event_markers.on_curves(out, replay, experiment, table, scene.object_ids[k], shares, colours)
    if len(replay.episodes.object_ix):
        curves.known(out, replay, "truth", replay.truth)


def _knowledge(
    out: Out, replay: Replay, experiment: Experiment, run_tracks: Mapping[str, FusedTracks], table: pd.DataFrame,
    shown: Sequence[int], colours: Mapping[str, Rgb],
) -> None:  # fmt: skip
    """Why, and since when. `run_tracks`: of the shown objects, over all of the log."""
    seen = sight(replay, experiment, shown)
    made = {}
    for name, colour in colours.items():
        clock = clock_of(replay.scene, table, name)
        made[name] = status_of(replay, experiment, name, run_tracks[name], seen, clock)
        status_drawing.words(out, name, replay, experiment, seen, made[name], clock)
        status_drawing.hiding(out, name, seen, made[name])
        asked = experiment.configurations[name]
        status_drawing.listings(out, name, replay, experiment, asked, run_tracks[name], seen, colour)
    if shown:  # their onsets and ends are the same in all configurations
        status_drawing.lanes(out, replay.scene, seen, made, colours, clock)


def _believed(
    out: Out, replay: Replay, experiment: Experiment, run_tracks: Mapping[str, FusedTracks], table: pd.DataFrame,
    shown: Sequence[int], colours: Mapping[str, Rgb],
) -> None:  # fmt: skip
    """What each configuration knew in a time chunk, and how far off that was."""
    for name, colour in colours.items():
        boxes.fused_boxes(out, ["world", part_of(name)], replay.scene, run_tracks[name], colour)
        curves.position_errors(out, replay, experiment, name, run_tracks[name].fused, shown, colour)
        if len(replay.episodes.object_ix):
            curves.gospas(out, replay, experiment, name, run_tracks[name], colour)
            since_ns = clock_of(replay.scene, table, name).known_ns
            curves.known(out, replay, name, run_tracks[name].fused, colour, since_ns)


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
