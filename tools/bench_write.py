"""What fused lists cost as messages, against the protobuf and JSON libraries one object after the other."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import Scene
from copem_replay.io.write.detail_json_writer import DetailWriter
from copem_replay.io.write.foxglove_scene import SceneWriter
from copem_replay.io.write.osi_sensor_data_writer import SensorDataWriter

sys.path.insert(0, str(Path(__file__).parents[1]))
from tests.oracles import messages as plain

_GREY = (128, 128, 128)


def encoding(
    best: Callable[..., float], scene: Scene, all_tracks: dict[str, FusedTracks], compared: str
) -> Iterator[dict[str, object]]:
    """Objects per second into the messages of the three channels; and how much faster than the libraries on one."""

    def ours(chosen: dict[str, FusedTracks]) -> list[bytes]:
        made = []
        for name, of in chosen.items():
            available_ns = scene.t0_ns + np.rint(of.fused.arrives_s[0] * 1e9).astype(np.int64)
            numbers = {unit: k + 1 for k, unit in enumerate(of.heard.units)}
            writers = (
                SensorDataWriter(scene, of, numbers),
                SceneWriter(scene, of, name, _GREY),
                DetailWriter(scene, of, {}),
            )
            made += [message for writer in writers for message in writer.messages(available_ns)]
        return made

    def theirs(name: str) -> list[bytes]:
        of = all_tracks[name]
        numbers = {unit: k + 1 for k, unit in enumerate(of.heard.units)}
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
    seconds = best(lambda: ours(all_tracks), 3)
    ratio = best(lambda: theirs(compared), 1) / best(lambda: ours(one), 3)
    yield {"encode_objects_per_s": round(listed / seconds), "encode_ratio_to_libraries": round(ratio, 1)}
