"""What fused lists cost as messages, against the protobuf and JSON libraries one object after the other."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from benches import common
from copem_replay.core.colours import configuration_colours
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import Scene
from copem_replay.io.encodings.column_bytes import encode_messages
from copem_replay.io.write.detail import DetailWriter
from copem_replay.io.write.mcap import write_mcap
from copem_replay.io.write.osi import SensorDataWriter
from copem_replay.io.write.scene import FRAME_ID, BoxWriter, Draw, draw_scenes
from copem_replay.metrics.summary import settle_horizon, summarise_rows
from copem_replay.pipeline.one_run import ReplayedRun, RunTracks
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.replay import replay_block
from copem_replay.results.truth_scene import draw_truth
from copem_replay.viewer import write_rrd
from tests.oracles import messages as plain

_GREY = (128, 128, 128)


def encoding(scene: Scene, all_tracks: dict[str, FusedTracks], compared: str) -> Iterator[common.Line]:
    """Objects per second into the messages of the three channels; and how much faster than the libraries on one."""

    def ours(chosen: dict[str, FusedTracks]) -> list[bytes]:
        made: list[bytes] = []
        draw: Draw = partial(draw_scenes, partial(encode_messages, SceneUpdate.DESCRIPTOR), FRAME_ID)
        for name, of in chosen.items():
            available_ns = scene.t0_ns + np.rint(of.fused.arrives_s[0] * 1e9).astype(np.int64)
            numbers = {unit: k + 1 for k, unit in enumerate(of.received.units)}
            writers = (
                SensorDataWriter(scene, of, numbers),
                BoxWriter(scene, of, name, _GREY, draw),
                DetailWriter(scene, of, {}),
            )
            made += [message for writer in writers for message in writer.messages(available_ns)]
        return made

    def theirs(name: str) -> list[bytes]:
        of = all_tracks[name]
        numbers = {unit: k + 1 for k, unit in enumerate(of.received.units)}
        every = list(enumerate((scene.t0_ns + np.rint(of.fused.arrives_s[0] * 1e9).astype(np.int64)).tolist()))
        sized = [False] * len(of.fused.frame_ix)
        return [
            *(plain.sensor_data(scene, of, numbers, k, at) for k, at in every),
            *(plain.scene_update(scene, of, name, _GREY, "global", k, at) for k, at in every),
            *(plain.detail(scene, of, (), sized, k, at) for k, at in every),
        ]

    one = {compared: all_tracks[compared]}
    assert ours(one) == theirs(compared)
    listed = sum(int(of.fused.valid.sum()) for of in all_tracks.values())
    seconds = common.best(lambda: ours(all_tracks), 3)
    ratio = common.best(lambda: theirs(compared), 1) / common.best(lambda: ours(one), 3)
    yield {"encode_objects_per_s": round(listed / seconds), "encode_ratio_to_libraries": round(ratio, 1)}


def writing() -> Iterator[common.Line]:
    """The crossing: objects per second into MCAP (lists and drawn truth), and lists into messages of three channels;
    boxes per second and bytes per box into .rrd, seconds to see it.
    """
    experiment, recordings = common.loaded("crossing")
    experiment = experiment.model_copy(update={"configurations": experiment.shown()})
    ready = prepare_log(recordings[0], experiment)
    replayed = ReplayedRun(ready, experiment, RunTracks(ready, experiment, 0))
    run_tracks = replayed.run_tracks.whole()
    table = replay_block(ready, experiment, np.arange(1))
    rates: dict[str, float | None] = dict.fromkeys(experiment.configurations)
    rows, _ = summarise_rows(table, list(experiment.configurations), rates, horizon_s=settle_horizon(table, 5.0)[0])
    listed = sum(int(lists.fused.valid.sum()) for lists in run_tracks.values())
    shown = listed + len(ready.truth.frame_ix)
    colours = configuration_colours(experiment.configurations, {"GT"})
    with common.scratch() as folder:
        mcap, rrd = folder / "w.mcap", folder / "w.rrd"

        def to_mcap() -> None:
            truth = draw_truth(replayed, table)
            chunks, log = [(run_tracks, ())], recordings[0].path
            write_mcap(mcap, log, ready.scene, chunks, table, {}, truth=truth, colours=colours)

        seconds, cpu_s = common.best(to_mcap, 3), common.interleaved([to_mcap], 3)[0]
        yield {"mcap_objects_per_s": round(shown / seconds), "mcap_objects_per_cpu_s": round(shown / cpu_s)}
        yield from encoding(ready.scene, run_tracks, "ideal")
        seconds = common.best(lambda: write_rrd(rrd, ready, experiment, [run_tracks], table, rows, 0), 3)
        yield {
            "rrd_boxes_per_s": round(shown / seconds),
            "rrd_bytes_per_box": round(rrd.stat().st_size / shown, 1),
            "boxes": shown,
        }
        yield first_picture(rrd)


def first_picture(rrd: Path) -> common.Line:
    """Seconds from a viewer that runs to the first picture of all its views; None: nothing to draw with."""
    from tests.helpers.viewer import headless_viewer, vulkan_missing

    if (reason := vulkan_missing()) is not None:
        return {"rrd_first_picture_s": None, "skipped": reason}
    with headless_viewer() as viewer:

        def open_it() -> np.ndarray:
            viewer.open(rrd)
            return viewer.picture()

        picture, seconds, _ = common.timed(open_it)
        assert picture.max() > 0
    return {"rrd_first_picture_s": round(seconds, 2)}
