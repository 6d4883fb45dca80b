"""MCAP out: the input's channels with their messages untouched, and what each configuration believed.

For each configuration three channels: `copem/<configuration>/objects` (osi3.SensorData), `…/scene`
(foxglove.SceneUpdate) and `…/detail` (JSON: what SensorData cannot carry), one message per fused list, log_time =
publish_time = the instant it was available. The same input gives the same bytes; the file appears under its name when
it is complete, or not at all.
"""

from __future__ import annotations

import heapq
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from mcap.records import Message
from mcap.writer import Writer

from copem_replay.atomic import atomic_file
from copem_replay.colours import configuration_colours
from copem_replay.formats import detail, foxglove, sensor_data
from copem_replay.fusion.belief import Belief
from copem_replay.passthrough import Catalogue, Original
from copem_replay.tracks import Scene, Tracks

OSI_RECORD = "net.asam.osi.trace"
"""The one metadata record of an OSI trace file (OSI 3.8, trace file formats)."""
RUN_RECORD = "org.copem_replay.run"
"""Our own record: what made the file."""
OSI_CHANNEL = "net.asam.osi.trace.channel."


def write_mcap(
    path: Path,
    source: Path,
    scene: Scene,
    beliefs: Mapping[str, Belief],
    table: pd.DataFrame,
    manifest: Mapping[str, str],
) -> list[str]:
    """`source` with the fused lists of one run added: `beliefs[configuration]` has values (1, P).

    `table`: the rows of the detections table of this log and run, by which detections are told beside the lists.
    `manifest`: what made the file, kept as a metadata record.

    Returns what has to be said of what could not be copied, or was replaced.

    Raises OutputError when the file cannot be written, RecordingError when `source` can no longer be read.
    """
    original = Original(source)
    colours = configuration_colours(beliefs)
    osi_version = ".".join(map(str, sensor_data.OSI_VERSION))
    protobuf = version("protobuf")
    with atomic_mcap(path, profile=original.profile) as writer:
        catalogue = Catalogue(writer)
        topics = {name: [f"copem/{name}/{kind}" for kind in ("objects", "scene", "detail")] for name in beliefs}
        ours = {topic for mine in topics.values() for topic in mine}
        streams = [original.messages(original.register(catalogue, without=ours))]
        list_schema = _schema(catalogue, sensor_data.message_class(), sensor_data.SCHEMA)
        scene_schema = _schema(catalogue, foxglove.message_class(), foxglove.SCHEMA)
        detail_schema = catalogue.schema(detail.SCHEMA, "jsonschema", json.dumps(detail.JSON_SCHEMA).encode())
        units = dict.fromkeys(unit for belief in beliefs.values() for unit in belief.heard.units)
        numbers = {unit: k + 1 for k, unit in enumerate(units)}
        for name, belief in beliefs.items():
            description = {
                f"{OSI_CHANNEL}description": f"fused object list of configuration {name}",
                f"{OSI_CHANNEL}osi_version": osi_version,
                f"{OSI_CHANNEL}protobuf_version": protobuf,
            }
            objects = catalogue.channel(topics[name][0], "protobuf", list_schema, description)
            scenes = catalogue.channel(topics[name][1], "protobuf", scene_schema, {})
            details = catalogue.channel(topics[name][2], "json", detail_schema, {})
            events = _events(belief.fused, table[table["configuration"] == name])
            writers = {
                objects: sensor_data.SensorDataWriter(scene, belief, numbers),
                scenes: foxglove.SceneWriter(scene, belief, name, colours[name]),
                details: detail.DetailWriter(scene, belief, events),
            }
            streams.append(_lists(scene, belief.fused, writers))
        for name, record in original.metadata.items():
            if name not in (OSI_RECORD, RUN_RECORD):
                writer.add_metadata(name, record)
        units_record = {f"unit.{number}": unit for unit, number in numbers.items()}
        writer.add_metadata(RUN_RECORD, dict(sorted({**manifest, **units_record}.items())))
        writer.add_metadata(OSI_RECORD, _osi_record(original, osi_version, protobuf))
        for message in heapq.merge(*streams, key=lambda m: m.log_time):
            writer.add_message(
                message.channel_id, message.log_time, message.data, message.publish_time, message.sequence
            )
    replaced = sorted(ours & {channel.topic for channel in original.channels.values()})
    notes = [f"{len(replaced)} topics of an earlier replay are replaced ({replaced[0]} …)"] if replaced else []
    return [*([original.damage] if original.damage else []), *notes]


def _lists(scene: Scene, fused: Tracks, writers: Mapping[int, Any]) -> Iterator[Message]:
    for frame, available_s in enumerate(fused.arrives_s[0].tolist()):
        available_ns = scene.t0_ns + round(available_s * 1e9)
        for channel, writer in writers.items():
            yield Message(channel, available_ns, writer.message(frame, available_ns), available_ns, 0)


def _events(fused: Tracks, table: pd.DataFrame) -> dict[int, list[detail.Event]]:
    """What was detected with each list: detections by the index of the list that was then available."""
    events: dict[int, list[detail.Event]] = {}
    for row in table[table["detected"]].to_dict("records"):
        frame = int(np.abs(fused.arrives_s[0] - row["detection_s"]).argmin())
        event = {"object": row["object_id"], "first_unit": row["first_unit"]}
        for name in ("onset_s", "captured_s", "time_to_detection_s", "distance_at_detection_m"):
            event[name] = None if row[name] != row[name] else float(row[name])
        events.setdefault(frame, []).append(event)
    return events


def _schema(catalogue: Catalogue, message_class: Any, name: str) -> int:
    from mcap_protobuf.schema import build_file_descriptor_set

    data = build_file_descriptor_set(message_class).SerializeToString(deterministic=True)
    return catalogue.schema(name, "protobuf", data)


def _osi_record(original: Original, osi_version: str, protobuf: str) -> dict[str, str]:
    """The input's record, its ranges of versions widened to ours; a new one where it had none."""
    record = dict(original.metadata.get(OSI_RECORD, {}))
    for what, ours in (("osi", osi_version), ("protobuf", protobuf)):
        key = f"{OSI_CHANNEL}{what}_version"
        seen = [ours, *(c.metadata[key] for c in original.channels.values() if key in c.metadata)]
        for end, pick in (("min", min), ("max", max)):
            name = f"{end}_{what}_version"
            record[name] = pick([*seen, *([record[name]] if record.get(name) else [])], key=_release)
    record["version"] = record.get("version") or osi_version
    return dict(sorted(record.items()))


def _release(text: str) -> tuple[int, ...]:
    return tuple(int(part) if part.isdigit() else 0 for part in text.split("."))


@contextmanager
def atomic_mcap(path: Path, *, profile: str) -> Iterator[Writer]:
    """A writer whose file gets its name when it is complete; whatever goes wrong before leaves nothing behind."""
    with atomic_file(path) as scratch, scratch.open("wb") as file:
        writer = Writer(file, enable_data_crcs=True)
        writer.start(profile=profile, library="copem_replay")
        yield writer
        writer.finish()  # type: ignore[no-untyped-call]
