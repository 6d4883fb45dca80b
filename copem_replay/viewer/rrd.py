"""The `.rrd` file: complete under its name, or not there."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from copem_replay.core.colours import Rgb, configuration_colours
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import TRUTH, Float, Int
from copem_replay.experiment.schema import Experiment
from copem_replay.perception.observation import Observations
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.visibility_curves import share_curves
from copem_replay.viewer import (
    boxes,
    curves,
    differences,
    event_markers,
    lanes,
    legend,
    sensors,
    status_drawing,
    text_panels,
)
from copem_replay.viewer.axes import axis_s
from copem_replay.viewer.blueprint import aspect, blueprint
from copem_replay.viewer.camera import eye_above, eye_after, eye_on, follow
from copem_replay.viewer.kept import Kept
from copem_replay.viewer.line_of_sight import Sight, sight
from copem_replay.viewer.linked_lists import UnitLists, linked_lists, list_lanes, lists_in_words
from copem_replay.viewer.pages import NEAR_BY, Content
from copem_replay.viewer.selection import Part, in_parts, measured
from copem_replay.viewer.sensors import named_units
from copem_replay.viewer.sink import Out, digest, entity_names, part_of
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

    Of more than six configurations there are further files beside it, `replay.configurations_7-12.rrd`. Colours go by
    the place among the experiment's configurations, whichever of them are written.

    `run_tracks`: one time chunk after the other, per configuration the receiver's fused tracks in this run, a frame per
    list it issued (one unit, values (1, P)). `table`: the rows of `detections.parquet` of this log and run. `summary`:
    of all logs and runs. `run_is`: why it is this run, part of the recording's name. `baseline`: the configuration
    differences to which are marked.
    """
    rest = iter(run_tracks)
    first = next(rest)
    parts = in_parts(list(first), baseline)
    asked = experiment.configurations
    every = configuration_colours(experiment.configurations)  # by place, so the same in all files of the experiment
    told = Kept(_measured(replay, experiment, table))
    with ExitStack() as stack:
        files = []
        for part in parts:
            lists = {
                name: linked_lists(first[name], k, name, asked[name].max_age_s)
                for k, name in enumerate(part.configurations)
            }
            objects = told.object_ix.tolist()
            content = _content(replay, experiment, table, part.configurations, objects, lists, baseline)
            panels, appearance = blueprint(content)
            what = (experiment.model_dump_json(), replay.scene.log, str(run), run_is, part.infix)
            # The viewer takes two files of one identity for one recording.
            ids = f"copem_replay:{appearance}", digest(*what)
            out = stack.enter_context(_streams(part.path(path), ids, replay.scene.t0_ns, viewer))
            files.append(_File(out, content, {name: every[name] for name in part.configurations}))
            _begin(files[-1], panels, summary, run, run_is, [p.path(path).name for p in parts if p != part])
        chunks = chain(iter([first]), rest)
        if baseline is not None:  # of all objects at once: such a log is not long
            for file in files:
                of = file.content
                kept = {name: first[name] for name in file.colours}
                differences.differences(file.out, replay, experiment, kept, table, baseline, of.objects, file.colours)
        faults = [FaultsShown(file.out, replay, experiment) for file in files]
        del first  # one chunk's is held at a time
        for chunk in chunks:
            for file, shown in zip(files, faults, strict=True):
                _fused(file, chunk)
                shown.add(chunk)
            told.add(chunk)
        whole, found = told.whole(), replay.rows_of(told.object_ix)
        seen = sight(replay, experiment, told.object_ix.tolist(), found)
        for file in files:
            _knowledge(file, whole, seen)
            _shares(file, found)
    return list(_notes(path, parts, [file.out.live for file in files]))


@dataclass(frozen=True)
class _File:
    """One of the files: where it goes, what it shows, and the colours of its configurations, in order.

    `last_gospa`: by configuration the last point of its curve in the time chunks so far.
    """

    out: Out
    content: Content
    colours: dict[str, Rgb]
    last_gospa: dict[str, tuple[Int, Float]] = field(default_factory=dict)


def _measured(replay: Replay, experiment: Experiment, table: pd.DataFrame) -> list[int]:
    """Indices of the objects that words, lanes and curves are about: the same in all files."""
    truths = [name for name, asked in experiment.configurations.items() if asked.units == TRUTH]
    return [replay.scene.object_number[name] for name in measured(table, truths)]


def _content(
    replay: Replay, experiment: Experiment, table: pd.DataFrame, configurations: Sequence[str], shown: Sequence[int],
    lists: Mapping[str, Sequence[UnitLists]], baseline: str | None,
) -> Content:  # fmt: skip
    wide = aspect(len(configurations))
    eye = eye_on(replay, experiment, table, shown[0] if len(shown) else None, wide)
    eyes = [eye_after(replay, experiment, table, k) for k in shown[:NEAR_BY]]
    scene = replay.scene
    episodes = {k: table[table["object_id"] == scene.object_ids[k]] for k in shown}
    onset_s = float(episodes[shown[0]]["onset_s"].iloc[0]) if len(shown) else 0.0
    axes_s = {k: axis_s(of_one, scene.end_s) for k, of_one in episodes.items()}
    named = named_units(replay, experiment, eye.at_m, onset_s)
    above = eye_above(np.stack([*named.values(), eye.at_m], axis=1), eye)
    return Content(
        replay, experiment, table, episodes, configurations, shown, axes_s, eye, eyes, above, list(named), lists,
        baseline,
    )  # fmt: skip


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


def _begin(
    file: _File, panels: rrb.Blueprint, summary: pd.DataFrame, run: int, run_is: str, further: Sequence[str]
) -> None:
    """The layout, made active so that no viewer puts its own guess in its place, and what holds for all of the log."""
    import rerun as rr

    out, of = file.out, file.content
    replay, experiment, scene = of.replay, of.experiment, of.replay.scene
    out.send(lambda rec: rec.send_blueprint(panels, make_active=True))
    for eye in (of.eye, *of.eyes):
        follow(out, replay, eye)
    _properties(out, replay, experiment, list(of.configurations), run, run_is)
    out.static([], rr.ViewCoordinates.RIGHT_HAND_Z_UP, boxes.names_and_colours(scene))
    mine = of.table[of.table["configuration"].isin(list(of.configurations))]
    text_panels.differences(out, replay, mine, of.objects, further)
    text_panels.summary(out, replay, experiment, summary, run, further)
    text_panels.legend(out, any(of.lists.values()))
    legend.bars(out, file.colours)
    text_panels.onsets(out, scene, of.table)
    boxes.grid(out, replay.truth)
    boxes.solids(out, replay.placed)
    boxes.lane_boundaries(out, replay.lane_boundaries)
    sensors.units(out, replay, experiment)
    event_markers.onsets(out, replay, experiment, of.table, of.objects)
    boxes.truth(out, scene, replay.truth, of.objects)
    for name, colour in file.colours.items():
        text_panels.events(out, scene, name, of.table[of.table["configuration"] == name])
        event_markers.detections(out, replay, experiment, of.table, name, of.objects, colour)
        lists_in_words(out, name, of.lists[name])
        list_lanes(out, of.lists[name])
    if len(replay.episodes.object_ix):
        curves.known(out, replay, "truth", replay.truth)


def _fused(file: _File, run_tracks: Mapping[str, FusedTracks]) -> None:
    """What each configuration knew in a time chunk, of all objects."""
    out, of = file.out, file.content
    for name, colour in file.colours.items():
        boxes.fused_boxes(out, ["world", part_of(name)], of.replay.scene, run_tracks[name], colour)
        if len(of.replay.episodes.object_ix):
            before = file.last_gospa.get(name, curves.NO_LIST)
            file.last_gospa[name] = curves.gospas(out, of.replay, of.experiment, name, run_tracks[name], colour, before)
            since_ns = clock_of(of.replay.scene, of.table, name).known_ns
            curves.known(out, of.replay, name, run_tracks[name].fused, colour, since_ns)


def _knowledge(file: _File, run_tracks: Mapping[str, FusedTracks], seen: Sight) -> None:
    """Why, since when, and how far off. `run_tracks`: of the shown objects, over all of the log."""
    out, of = file.out, file.content
    replay, experiment, scene = of.replay, of.experiment, of.replay.scene
    made, clocks = {}, {}
    for name, colour in file.colours.items():
        fused_tracks, clock = run_tracks[name], clock_of(scene, of.table, name)
        made[name], clocks[name] = status_of(replay, experiment, name, fused_tracks, seen, clock), clock
        status_drawing.words(out, name, replay, experiment, seen, made[name], clock)
        status_drawing.hiding(out, name, seen, made[name])
        mine = of.table[(of.table["configuration"] == name) & of.table["detected"]]
        first_unit = dict(zip(mine["object_id"].map(scene.object_number), mine["first_unit"], strict=True))
        status_drawing.listings(out, name, replay, experiment, fused_tracks, seen, colour, first_unit)
        curves.position_errors(out, replay, experiment, name, fused_tracks.fused, of.objects, colour)
    lanes.lanes(out, scene, experiment, seen, made, file.colours, clocks, of.axes_s)


def _shares(file: _File, found: Observations) -> None:
    """How much is seen of each shown object."""
    out, of = file.out, file.content
    names = entity_names(of.replay.scene)
    for k in of.objects:
        shares = share_curves(of.replay, found, k)
        curves.visible_share(out, names[k], shares)
        object_id = of.replay.scene.object_ids[k]
        event_markers.on_curves(out, of.replay, of.experiment, of.table, object_id, shares, file.colours)


def _notes(path: Path, parts: Sequence[Part], lives: Sequence[Live | None]) -> Iterator[str]:
    for part in parts[1:]:
        yield f"{path.name}: {', '.join(part.configurations)} in {part.path(path).name}"
    gone = next((live for live in lives if live is not None and live.gone), None)
    if gone is not None:
        yield f"{path.name}: the viewer at {gone.url} went before it had everything; the file is complete"


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
