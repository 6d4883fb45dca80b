"""OSI multi-channel traces (MCAP): the file that converters and the makers of sample recordings write.

The same content gives the same bytes: a trace has neither a creation time nor any other clock.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import osi3
from google.protobuf import __version__ as protobuf_version
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set
from osi3.osi_groundtruth_pb2 import GroundTruth

from copem_replay.core.files import atomic_file

NANOS_PER_SECOND: Final = 1_000_000_000
_TRACE: Final = "net.asam.osi.trace"


@dataclass(frozen=True)
class OsiTrace:
    """The content of one file."""

    description: str
    topics: Mapping[str, str]  # topic: what is on it
    messages: Iterable[tuple[str, Any]]  # (topic, message), in the order of their `timestamp`
    source: str  # where the content comes from
    records: Mapping[str, Mapping[str, str]] = field(default_factory=dict)  # further metadata; taken after the messages
    logged_after_ns: Mapping[str, int] = field(default_factory=dict)  # by topic: after the stamp; left out: at it


def empty_ground_truth(stamp_ns: int, host_id: int | None) -> GroundTruth:
    """Return the message of one instant without an object, `stamp_ns` in ns, with the version of OSI."""
    osi = GroundTruth()
    parts = (int(part) for part in osi3.__version__.split(".")[:3])
    osi.version.version_major, osi.version.version_minor, osi.version.version_patch = parts
    osi.timestamp.seconds, osi.timestamp.nanos = divmod(stamp_ns, NANOS_PER_SECOND)
    if host_id is not None:
        osi.host_vehicle_id.value = host_id
    return osi


def write_osi_trace(trace: OsiTrace, path: Path) -> None:
    """Write a trace; the file is complete, or not there. Raises OutputError, and what `messages` raises."""
    with atomic_file(path) as temporary, temporary.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(profile="", library="copem_replay")
        _write_content(writer, trace)
        writer.finish()  # type: ignore[no-untyped-call]


def _write_content(writer: Writer, trace: OsiTrace) -> None:
    osi_version = osi3.__version__
    about = {
        **dict.fromkeys(("version", "min_osi_version", "max_osi_version"), osi_version),
        **dict.fromkeys(("min_protobuf_version", "max_protobuf_version"), protobuf_version),
        "description": trace.description,
        "authors": "copem_replay",
        "data_sources": trace.source,
    }  # neither creation_time nor zero_time: the first would be a clock, and the scene has no date
    writer.add_metadata(_TRACE, dict(sorted(about.items())))
    prefix = f"{_TRACE}.channel."
    versions = {f"{prefix}osi_version": osi_version, f"{prefix}protobuf_version": protobuf_version}
    schema_ids: dict[str, int] = {}
    channel_ids: dict[str, int] = {}
    for topic, message in trace.messages:
        schema = message.DESCRIPTOR.full_name
        if schema not in schema_ids:
            files = build_file_descriptor_set(type(message)).SerializeToString(deterministic=True)
            schema_ids[schema] = writer.register_schema(schema, "protobuf", files)
        if topic not in channel_ids:
            metadata = {f"{prefix}description": trace.topics[topic]} | versions
            channel_ids[topic] = writer.register_channel(topic, "protobuf", schema_ids[schema], metadata)
        stamp_ns = message.timestamp.seconds * NANOS_PER_SECOND + message.timestamp.nanos
        data = message.SerializeToString(deterministic=True)
        logged_ns = stamp_ns + trace.logged_after_ns.get(topic, 0)
        writer.add_message(channel_ids[topic], logged_ns, data, publish_time=stamp_ns)
    for name, record in sorted(trace.records.items()):
        writer.add_metadata(name, dict(sorted(record.items())))
