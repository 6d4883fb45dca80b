"""Write one run of one log as a Rerun recording (`.rrd`), with all that the viewer shows of it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd

from copem_replay.core.colours import Rgb, configuration_colours
from copem_replay.core.errors import MOST_LISTED, InputError
from copem_replay.core.files import portable_name
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.object_list import Entries
from copem_replay.core.tracks import TRUTH, Bool, Float, Int, Tracks, splice_rows
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.experiment.schema import Experiment, Show
from copem_replay.io.open import list_recordings, sha256_of
from copem_replay.metrics.columns import FALSE_TRACKS, NEEDLESS
from copem_replay.metrics.detections_table import first_episodes
from copem_replay.metrics.onset import select_counted
from copem_replay.perception.observation import Observations
from copem_replay.pipeline.one_run import STEM, ShownRun, share_curves
from copem_replay.pipeline.prepare import Replay
from copem_replay.pipeline.sight import Sight, compute_sight, find_looked_at
from copem_replay.pipeline.status import EpisodeClocks, compute_status, read_episode_clocks
from copem_replay.results.again import replay_again
from copem_replay.results.read import Results
from copem_replay.results.shown_objects import ShownObjects, axis_s, choose_shown_objects, find_opening_s
from copem_replay.results.write import Exporter, RunToExport
from copem_replay.viewer import boxes, curves, lanes, sensors
from copem_replay.viewer.blueprint import (
    LARGE_ASPECT,
    NEAR_BY,
    RecordingContent,
    build_blueprint,
    digest_layout,
    view_aspect,
)
from copem_replay.viewer.camera import (
    BESIDE_ASPECTS,
    EYES,
    MovingPicture,
    camera_above,
    camera_following,
    camera_on_ego,
    find_up_rad,
    write_moving_origin,
)
from copem_replay.viewer.curves import write_differences
from copem_replay.viewer.events import (
    mark_curves,
    mark_detections,
    mark_onsets,
    write_difference_text,
    write_event_texts,
    write_false_tracks,
    write_legend_text,
    write_needless_braking,
    write_onset_texts,
    write_summary_text,
)
from copem_replay.viewer.lanes import UnitLists, find_linked_lists, write_list_fates, write_list_lanes
from copem_replay.viewer.legend import write_legend_bars
from copem_replay.viewer.map_view import NO_PLACE, asks_for_map, write_map
from copem_replay.viewer.recorded import RecordedSensors, find_recorded_sensors, write_recorded
from copem_replay.viewer.sensors import FaultsShown, choose_named_units
from copem_replay.viewer.sink import (
    NEAR_WORDS,
    OPENS,
    WORDS,
    RecordingPart,
    RecordingSink,
    ViewerStream,
    configuration_part,
    digest_texts,
    entity_names,
    file_stream,
    split_into_files,
)
from copem_replay.viewer.status import write_hiding_lines, write_listing_lines, write_status_words


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
    baselines: Mapping[str, str] = MappingProxyType({}),
    of_one: bool = True,
    colours: Mapping[str, Rgb] | None = None,
    needless: pd.DataFrame | None = None,
    false_tracks: pd.DataFrame | None = None,
    viewer: str | None = None,
    recorded: RecordedSensors | None = None,
) -> list[str]:
    """Write one run of one log to a file and, with an address, to a viewer. Returns notes. Raises OutputError.

    More than seven configurations go into several files, such as `replay.configurations_8-14.rrd`; the ground truth is
    none of them, unless it is alone or compared. Colours depend on all of the experiment's configurations, also on
    those that are not written; those of a file differ.

    `run_tracks`: by time chunk, the receiver's fused tracks of each configuration in this run, with a frame per issued
    list (one unit, values (1, P)). `table`: the rows of `detections.parquet` of this log and run. `summary`: over all
    logs and runs. `run_is`: why this run is shown, part of the recording's name. `baselines`: what configurations are
    held against, so that differences are marked. `colours`: by configuration; None: as in all files of the experiment.
    `of_one`: all configurations are of one experiment, so that nothing but their keys differs. `needless`,
    `false_tracks`: rows of these tables of this log and run; None: not asked for. `recorded`: what sensors recorded,
    which is in the first file.
    """
    counted, table = select_counted(table, experiment.measure.began), first_episodes(table)
    later_chunks = iter(run_tracks)
    first = next(later_chunks)
    truths = [name for name, asked in experiment.configurations.items() if asked.units == TRUTH]
    # The truth is in every view, so it needs none of its own; configurations that are compared were chosen.
    viewed = [name for name in first if name not in truths] if not baselines else []
    parts = split_into_files(viewed or list(first), baselines)
    shown = choose_shown_objects(replay.scene, replay.truth, experiment, table)
    objects = list(shown.object_ix)
    collector = TrackCollector(objects)
    with ExitStack() as stack:
        files = list[_RecordingFile]()
        for part in parts:
            content = replace(
                _build_content(replay, experiment, table, part.configurations, shown, first, baselines),
                of_one=of_one, counted=counted, false_tracks=false_tracks, needless=needless,
                recorded=None if files else recorded,
            )  # fmt: skip
            identity = (experiment.model_dump_json(), replay.scene.log, str(run), run_is, part.infix)
            # The viewer takes two files of one identity for one recording.
            ids = f"copem_replay:{digest_layout(content)}", digest_texts(*identity)
            out = stack.enter_context(_open_streams(part.path(path), ids, replay.scene.t0_ns, viewer))
            all_configurations = experiment.configurations
            by_name = colours or configuration_colours(all_configurations, truths, shown=part.configurations)
            files.append(_RecordingFile(out, content, {name: by_name[name] for name in part.configurations}))
            _begin_file(files[-1], summary, run, run_is, [p.path(path).name for p in parts if p != part])
        if baselines:  # of all objects at once: such a log is not long
            for file in files:
                compared = {name: first[name] for name in file.colours}
                write_differences(file.out, replay, experiment, compared, table, baselines, objects, file.colours)
        chunks = chain(iter([first]), later_chunks)
        for file in files:
            _write_brakes_and_false_tracks(file, replay, needless, false_tracks)
        del first  # so that only one chunk is held at a time
        _write_chunks(files, chunks, replay, experiment, collector)
        of_sensors = write_recorded(files[0].out, recorded) if recorded is not None else []
        for file in files:
            _send_layout(file)
    notes = [NO_PLACE] if asks_for_map(experiment) and replay.scene.frame is None else []
    return [*notes, *of_sensors, *_list_notes(path, parts, [file.out.live for file in files])]


@dataclass(frozen=True)
class _RecordingFile:
    """One of the files: its streams, its content, and the colours of its configurations, in order.

    By configuration, in the time chunks so far: `last_gospa` the last point of its curve, `beside` what it draws beside
    the objects.
    `brief`: as in the content, found at the end.
    """

    out: RecordingSink
    content: RecordingContent
    colours: dict[str, Rgb]
    last_gospa: dict[str, tuple[Int, Float]] = field(default_factory=dict)
    beside: dict[str, boxes.EntriesBeside] = field(default_factory=dict)
    brief: set[int] = field(default_factory=set)

    @cached_property
    def clocks(self) -> dict[str, EpisodeClocks]:
        """The clocks of all objects, by configuration."""
        scene, table = self.content.replay.scene, self.content.table
        return {name: read_episode_clocks(scene, table, name) for name in self.colours}

    @cached_property
    def picture(self) -> MovingPicture | None:
        """The picture of the camera on the ego; None: it stands still."""
        return self.content.follow(self.content.eye) if self.content.eye.turns else None


def _build_content(
    replay: Replay, experiment: Experiment, table: pd.DataFrame, configurations: Sequence[str], shown: ShownObjects,
    first: Mapping[str, FusedTracks], baselines: Mapping[str, str],
) -> RecordingContent:  # fmt: skip
    """What a file with these configurations shows. `first`: fused tracks of the first time chunk, with all lists."""
    by_name, scene, objects = experiment.configurations, replay.scene, shown.object_ix
    lists: dict[str, list[UnitLists]] = {
        name: find_linked_lists(first[name], k, name, by_name[name].max_age_s) for k, name in enumerate(configurations)
    }
    episodes = {k: table[table["object_id"] == scene.object_ids[k]] for k in objects}
    axes_s = {k: axis_s(rows, scene.end_s) for k, rows in episodes.items()}
    eye = camera_on_ego(replay, experiment, axes_s, view_aspect(experiment, configurations))
    large_eye = camera_on_ego(replay, experiment, axes_s, LARGE_ASPECT)
    if eye.turns and eye.aspect != LARGE_ASPECT:
        large_eye = replace(large_eye, path=(*EYES, "large"))
    aspect = BESIDE_ASPECTS[len(objects) > 1]
    eyes = [camera_following(replay, experiment, table, k, aspect) for k in objects[:NEAR_BY]]
    onset_s = float(episodes[objects[0]]["onset_s"].iloc[0]) if objects else 0.0
    named_units = choose_named_units(replay, experiment, eye.at_m, onset_s)
    above = camera_above(np.stack([*named_units.values(), eye.at_m], axis=1), eye.heading_rad)
    compared = [rows[rows["configuration"].isin(list(configurations))] for rows in episodes.values()]
    return RecordingContent(
        replay, experiment, table, episodes, configurations, objects, axes_s, eye, large_eye, eyes, above,
        list(named_units), lists, tuple(dict.fromkeys(baselines.values())), shown.too_short,
        find_opening_s(experiment, compared),
    )  # fmt: skip


@contextmanager
def _open_streams(path: Path, ids: tuple[str, str], t0_ns: int, viewer: str | None) -> Iterator[RecordingSink]:
    """A sink into the file and, with the address `viewer`, into the viewer; closed at the end. Raises OutputError."""
    import rerun as rr

    viewer_stream = None
    was_strict = rr.strict_mode()
    rr.set_strict_mode(True)  # otherwise a wrong column is left out with a warning
    try:
        with file_stream(path, *ids) as rec:
            viewer_stream = ViewerStream(viewer, *ids) if viewer is not None else None
            yield RecordingSink(rec, t0_ns, viewer_stream)
    finally:
        rr.set_strict_mode(was_strict)
        if viewer_stream is not None:
            viewer_stream.close()


def _begin_file(file: _RecordingFile, summary: pd.DataFrame, run: int, run_is: str, further: Sequence[str]) -> None:
    """Write what is written once, before fused tracks; `run_is`: the run in words, `further`: names of other files."""
    import rerun as rr

    out, content = file.out, file.content
    replay, experiment, scene = content.replay, content.experiment, content.replay.scene
    if out.live is not None:
        out.live.send(lambda rec: rec.send_blueprint(build_blueprint(content), make_active=True))
    if file.picture is not None:
        write_moving_origin(out, replay, file.picture)
    for eye in (*content.eyes, content.large):
        if eye.object_ix is not None and eye.path != content.eye.path:
            write_moving_origin(out, replay, content.follow(eye))
    _write_properties(out, content, run, run_is)
    out.static([], rr.ViewCoordinates.RIGHT_HAND_Z_UP, boxes.names_and_colours(scene))
    rows = content.table[content.table["configuration"].isin(list(content.configurations))]
    helps = {k: content.helps(k) for k in content.objects}
    counted = content.counted if content.counted is not None else rows
    counted = counted[counted["configuration"].isin(list(content.configurations))]
    write_difference_text(out, replay, rows, helps, further, content.too_short, counted)
    write_summary_text(out, replay, experiment, summary, run, further)
    out.static(["false"], rr.TextDocument(content.tell_false(), media_type=rr.MediaType.MARKDOWN))
    write_legend_text(out, any(content.lists.values()))
    write_legend_bars(out, file.colours)
    shown_rows = content.table[content.table["object_id"].isin([scene.object_ids[k] for k in content.objects])]
    write_onset_texts(out, scene, shown_rows)
    boxes.write_grid(out, replay.truth)
    boxes.write_solids(out, replay.placed)
    boxes.write_lane_boundaries(out, replay.lane_boundaries)
    if scene.frame is not None and asks_for_map(experiment):
        write_map(out, replay, experiment, scene.frame)
    sensors.write_units(out, replay, experiment)
    mark_onsets(out, replay, experiment, content.table, content.objects)
    boxes.write_truth(out, scene, replay.truth, content.objects)
    for name, colour in file.colours.items():
        if (
            experiment.configurations[name].units != TRUTH or len(file.colours) == 1
        ):  # what is known at once is no event
            write_event_texts(out, scene, name, shown_rows[shown_rows["configuration"] == name])
        mark_detections(out, replay, experiment, content.table, name, content.objects, colour)
        write_list_fates(out, name, content.lists[name])
    if len(replay.episodes.object_ix):
        curves.write_known_count(out, replay, "truth", replay.truth)


def _write_brakes_and_false_tracks(
    file: _RecordingFile, replay: Replay, needless: pd.DataFrame | None, false_tracks: pd.DataFrame | None
) -> None:
    """Write when the driver brakes for nothing, and when lists begin to hold a false track, of each configuration."""
    for name, colour in file.colours.items():
        if needless is not None and len(rows := needless[needless["configuration"] == name]):
            write_needless_braking(file.out, replay, name, rows, colour)
        if false_tracks is not None and len(rows := false_tracks[false_tracks["configuration"] == name]):
            write_false_tracks(file.out, replay, name, rows)


def _send_layout(file: _RecordingFile) -> None:
    """Write the layout; active, so that no viewer replaces it by a guess."""
    panels = build_blueprint(replace(file.content, brief=file.brief))
    file.out.send(lambda rec: rec.send_blueprint(panels, make_active=True))


def _write_chunks(
    files: Sequence[_RecordingFile], chunks: Iterable[Mapping[str, FusedTracks]], replay: Replay,
    experiment: Experiment, collector: TrackCollector,
) -> None:  # fmt: skip
    """Write every time chunk, then what needs the whole log: status, reasons and curves of the shown objects."""
    faults = [FaultsShown(file.out, replay, experiment) for file in files]
    for chunk in chunks:
        for file, shown in zip(files, faults, strict=True):
            _write_fused(file, chunk)
            shown.add(chunk)
        collector.add(chunk)
    fused_tracks, observed = collector.whole(), replay.rows_of(collector.object_ix)
    sight = compute_sight(replay, experiment, collector.object_ix.tolist(), observed)
    for file in files:
        _write_knowledge(file, fused_tracks, sight)
        _write_shares(file, observed, sight)


def _write_fused(file: _RecordingFile, run_tracks: Mapping[str, FusedTracks]) -> None:
    """Write boxes, GOSPA and number of known objects of each configuration in a time chunk."""
    out, content = file.out, file.content
    for name, colour in file.colours.items():
        path = ["world", configuration_part(name)]
        boxes.write_fused_boxes(out, path, content.replay.scene, run_tracks[name], colour)
        beside = file.beside.setdefault(name, boxes.EntriesBeside(out, name, colour, file.picture))
        beside.add(run_tracks[name], curves.find_false_rows(content.replay, content.experiment, run_tracks[name]))
        if len(content.replay.episodes.object_ix):
            before = file.last_gospa.get(name, curves.NO_LIST)
            file.last_gospa[name] = curves.write_gospa(
                out, content.replay, content.experiment, name, run_tracks[name], colour, before
            )
            since_ns = file.clocks[name].known_ns
            curves.write_known_count(out, content.replay, name, run_tracks[name].fused, colour, since_ns)


def _write_knowledge(file: _RecordingFile, run_tracks: Mapping[str, FusedTracks], sight: Sight) -> None:
    """Write status, reasons and position errors. `run_tracks`: of the shown objects, over the whole log."""
    out, content = file.out, file.content
    replay, experiment, scene = content.replay, content.experiment, content.replay.scene
    near_up_rad = {eye.object_ix: eye.heading_rad for eye in content.eyes}
    statuses = {}
    for name, colour in file.colours.items():
        fused_tracks, clock = run_tracks[name], file.clocks[name]
        statuses[name] = compute_status(replay, experiment, name, fused_tracks, sight, clock)
        up_rad = {
            WORDS: find_up_rad(file.picture, content.eye, statuses[name].elapsed_ns)[:, None],
            NEAR_WORDS: np.array([[near_up_rad[k] for k in sight.object_ix.tolist()]]),
        }
        write_status_words(out, name, replay, experiment, sight, statuses[name], up_rad)
        write_hiding_lines(out, name, sight, statuses[name])
        detections = content.table[(content.table["configuration"] == name) & content.table["detected"]]
        first_unit = dict(zip(detections["object_id"].map(scene.object_number), detections["first_unit"], strict=True))
        write_listing_lines(out, name, replay, experiment, fused_tracks, sight, colour, first_unit)
        curves.write_position_errors(out, replay, experiment, name, fused_tracks.fused, content.objects, colour)
    for m, k in enumerate(sight.object_ix.tolist()):
        if lanes.is_briefly_known(statuses.values(), m, content.lanes_axis_s(k)):
            file.brief.add(k)
    axes = {k: replace(content, brief=file.brief).lanes_axis_s(k) for k in content.objects}
    lanes.write_lanes(out, scene, experiment, sight, statuses, file.colours, file.clocks, axes)
    for name in file.colours:
        write_list_lanes(out, content.lists[name], axes.values())


def _write_shares(file: _RecordingFile, observed: Observations, sight: Sight) -> None:
    """Write the visible share of each shown object, with marks."""
    out, content = file.out, file.content
    names = entity_names(content.replay.scene)
    for k in content.objects:
        shares = share_curves(content.replay, observed, k)
        curves.write_visible_share(out, names[k], shares, find_looked_at(content.replay, sight, k, shares))
        object_id = content.replay.scene.object_ids[k]
        mark_curves(out, content.replay, content.experiment, content.table, object_id, shares, file.colours)


def _list_notes(path: Path, parts: Sequence[RecordingPart], lives: Sequence[ViewerStream | None]) -> Iterator[str]:
    for part in parts[1:]:
        yield f"{path.name}: {', '.join(part.configurations)} in {part.path(path).name}"
    gone = next((live for live in lives if live is not None and live.gone), None)
    if gone is not None:
        yield f"{path.name}: the viewer at {gone.url} went before it had everything; the file is complete"


def _write_properties(out: RecordingSink, content: RecordingContent, run: int, run_is: str) -> None:
    """Write the recording's name, start and properties: log, run, seed, configurations, versions, where it opens."""
    import rerun as rr

    scene, experiment = content.replay.scene, content.experiment
    name = f"{scene.log}: run {run}" + (f": {run_is}" if run_is else "")
    out.send(lambda rec: rec.send_recording_name(name))
    out.send(lambda rec: rec.send_recording_start_time_nanos(scene.t0_ns))
    opening: dict[str, Any] = {} if content.opens_s is None else {OPENS: content.opens_s}
    values = rr.AnyValues(
        log=scene.log,
        run=run,
        run_is=run_is,
        seed=str(experiment.seed),  # 64 bits without a sign, too
        visibility=experiment.visibility.label,
        configurations=list(content.configurations),
        **opening,
        copem_replay=version("copem-replay"),
        rerun_sdk=version("rerun-sdk"),
    )
    out.send(lambda rec: rec.send_property("replay", values))


# Recordings of a results folder.


def make_rrd_exporter(viewer: str | None) -> Exporter:
    """The exporter of `.rrd` files; it also sends each recording to the Rerun viewer at this address, if any."""

    def write(path: Path, run: RunToExport) -> list[str]:
        """Write one run as a recording at `path`, and to the viewer if there is one. Returns notes for the user."""
        shown = run.replayed.experiment.configurations
        configurations = {name: shown.get(name, configuration) for name, configuration in run.every.items()}
        show = run.replayed.experiment.show
        asked = show is not None and show.with_recording
        with find_recorded_sensors(run.recording) if asked else nullcontext() as recorded:
            return write_rrd(
                path,
                run.replayed.replay,
                run.replayed.experiment.model_copy(update={"configurations": configurations}),
                run.replayed.run_tracks,
                run.table,
                run.summary,
                run.shown.run,
                run_is=run.shown.why,
                needless=run.needless,
                false_tracks=run.false_tracks,
                viewer=viewer,
                recorded=recorded,
            )

    return Exporter(".rrd", write, _list_file_names)


def write_with_recording(scratch: Path, results: Results, file: Path) -> tuple[Path, list[str]]:
    """Write the run shown in results again, with the recording's images and points, into a scratch folder.

    Returns the path, there as in the folder of results, and notes. Raises InputError where it is none of these results.
    """
    digest, study = sha256_of(file), results.provenance.logs
    logs = [log.name for log in study if log.sha256 == digest or file in list_recordings(results.log_place(log.name))]
    if not logs:
        known = ", ".join(f"{log.name} (SHA-256 {log.sha256[:12]}…)" for log in study[:MOST_LISTED])
        raise InputError(f"{file}: expected a recording of {results.place}: {known}; found SHA-256 {digest[:12]}…")
    log, experiment = logs[0], resolve_for_log(results.experiment, logs[0])
    (first, *_) = results.provenance.data["runs_shown"].get(log) or [{"run": 0}]
    run, shown = int(first["run"]), experiment.shown()
    replayed, table = replay_again(results, log, run, shown)
    show = (experiment.show or Show()).model_copy(update={"with_recording": True})
    replayed = replace(replayed, experiment=replayed.experiment.model_copy(update={"show": show}))
    events = []
    for name in (NEEDLESS, FALSE_TRACKS):
        rows = results.frame(name) if results.has(name) else None
        events.append(None if rows is None else rows[(rows["log"] == log) & (rows["run"] == run)])
    shown_run = ShownRun(run, first.get("run_is") or "", STEM)
    summary, recording = results.summary, results.recording(log, results.experiment)
    summary = summary[summary["configuration"].isin(list(shown))]
    exported = RunToExport(recording, shown_run, replayed, experiment.configurations, table, summary, {}, *events)
    path = scratch / (f"{STEM}.rrd" if len(study) == 1 else f"{STEM}/{portable_name(log)}.rrd")
    path.parent.mkdir(exist_ok=True)
    return path, make_rrd_exporter(None).write(path, exported)


def _list_file_names(stem: str, configurations: int) -> list[str]:
    path = Path(f"{stem}.rrd")
    return [part.path(path).as_posix() for part in split_into_files([str(k) for k in range(configurations)])]


# Fused tracks of a few objects over a whole log of any length: their rows of all time chunks, joined.


@dataclass
class _TrackPieces:
    """Rows of one configuration by time chunk: rows of units' lists (P,) with their keys, and fused rows (R,).

    `source_keys`: keys of the rows of units' lists that each fused row is made of, `count` (R,) of them.
    """

    received: list[Tracks] = field(default_factory=list)
    keys: list[Int] = field(default_factory=list)
    left_out: list[Bool] = field(default_factory=list)
    fused: list[Tracks] = field(default_factory=list)
    source_keys: list[Int] = field(default_factory=list)
    count: list[Int] = field(default_factory=list)
    said: list[Entries] = field(default_factory=list)


class TrackCollector:
    """Collects the fused tracks (1, P) of some objects in one run, chunk by chunk in order of time."""

    def __init__(self, object_ix: Sequence[int]) -> None:
        self.object_ix = np.array(object_ix, dtype=np.int64)
        self._pieces: dict[str, _TrackPieces] = {}

    def add(self, run_tracks: Mapping[str, FusedTracks]) -> None:
        """Add the next time chunk's fused tracks, by configuration; rows of the shown objects are copied."""
        for name, fused_tracks in run_tracks.items():
            pieces = self._pieces.setdefault(name, _TrackPieces())
            self._add_received(pieces, fused_tracks)
            rows = np.flatnonzero(self._is_of_objects(fused_tracks.fused))
            count = np.diff(fused_tracks.start)[rows]
            offset = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
            entries = fused_tracks.entries[np.repeat(fused_tracks.start[rows], count) + offset]
            pieces.fused.append(fused_tracks.fused.take_rows(rows))
            pieces.source_keys.append(self._key(fused_tracks.received)[entries])
            pieces.count.append(count)
            if fused_tracks.said is not None:
                pieces.said.append(fused_tracks.said[rows])

    def whole(self) -> dict[str, FusedTracks]:
        """By configuration, the fused tracks of all time chunks as those of one; without view geometry."""
        return {name: _join_pieces(pieces) for name, pieces in self._pieces.items()}

    def _add_received(self, pieces: _TrackPieces, fused_tracks: FusedTracks) -> None:
        """Add rows of units' lists that no earlier chunk had: rows captured before a chunk may be in it again."""
        received = fused_tracks.received
        of_objects, key = self._is_of_objects(received), self._key(received)
        before = np.concatenate([np.empty(0, dtype=np.int64), *pieces.keys])
        new_rows = np.flatnonzero(of_objects & ~np.isin(key, before))
        rows = received.take_rows(new_rows)  # every time chunk has the lists of the whole log: they are kept once
        pieces.received.append(rows.in_lists_of(pieces.received[0] if pieces.received else rows))
        pieces.keys.append(key[new_rows])
        if fused_tracks.left_out is not None:
            pieces.left_out.append(fused_tracks.left_out[new_rows])

    def _is_of_objects(self, tracks: Tracks) -> Bool:
        """(P,) whether each row is about one of the objects."""
        return np.asarray(np.isin(tracks.row_object_ix, self.object_ix))

    @staticmethod
    def _key(tracks: Tracks) -> Int:
        """(P,) a number per pair of list and object, for rows about an object."""
        return tracks.row_object_ix * len(tracks.stamp_ns) + tracks.frame_ix


def _join_pieces(pieces: _TrackPieces) -> FusedTracks:
    """The fused tracks of the shown objects over the whole log, from those of its time chunks."""
    received, order = splice_rows(pieces.received)
    keys = np.concatenate(pieces.keys)[order]
    left_out = np.concatenate(pieces.left_out)[order] if pieces.left_out else None
    fused, order = _concatenate_lists(pieces.fused)
    count = np.concatenate(pieces.count)
    begin = np.cumsum(count) - count
    start = np.concatenate([[0], np.cumsum(count[order])])
    offset = np.arange(start[-1]) - np.repeat(start[:-1], count[order])
    source_keys = np.concatenate(pieces.source_keys)[np.repeat(begin[order], count[order]) + offset]
    by_key = np.argsort(keys, kind="stable")
    entries = by_key[np.searchsorted(keys[by_key], source_keys)]
    said = np.concatenate(pieces.said)[order] if pieces.said else None
    return FusedTracks(fused, received, entries, start, said=said, left_out=left_out)


def _concatenate_lists(fused: Sequence[Tracks]) -> tuple[Tracks, Int]:
    """Tracks with the lists of all time chunks, and the order of their rows, as `splice_rows` gives it."""
    frames: dict[str, Any] = {
        name: np.concatenate([getattr(piece, name) for piece in fused], axis=-1)
        for name in ("stamp_ns", "captured_s", "frame_unit_ix", "arrives_s")
    }
    before = np.cumsum([0, *(len(piece.stamp_ns) for piece in fused)])
    return splice_rows([replace(piece, frame_ix=piece.frame_ix + before[k], **frames) for k, piece in enumerate(fused)])
