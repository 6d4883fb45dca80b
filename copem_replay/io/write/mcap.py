"""Writing replay.mcap: the channels of a recording with their messages untouched, and each configuration's fused lists.

For each configuration there are three channels: `copem/<configuration>/objects` (the fused lists), `…/scene` (these
lists as boxes) and `…/detail` (JSON: what the objects have no fields for), in messages of the input's family
(`io/write/message_family.py`), one per fused list, log_time = publish_time = the instant it was available. Two more are
for viewers: `…/status` (what is known) and `…/uncertainty` (ellipses, paler with age). The truth is a scene of its own:
`copem/truth/scene` (moving objects), `…/static` (all else) and `…/transform` (the ego's frame of reference).

For each unit with a PEM there are two: `copem/units/<name>/objects` (its lists) and `…/detail`, one message per list,
log_time = publish_time = the instant the unit had it ready.

A given input gives the same bytes each time; the file appears under its name when it is complete, or not at all.
"""

from __future__ import annotations

import heapq
import struct
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from importlib.metadata import version
from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from mcap._chunk_builder import ChunkBuilder
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Message, MessageIndex, Statistics
from mcap.writer import Writer

from copem_replay.core.colours import Rgb
from copem_replay.core.files import atomic_file
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import SAME_INSTANT_S, TRUTH, Int, Scene, Tracks
from copem_replay.io.open import Local
from copem_replay.io.window import Window
from copem_replay.io.write.detail import Event, ReadyLists, Statuses
from copem_replay.io.write.message_family import (
    OSI,
    RUN_RECORD,
    TRUTH_TOPICS,
    Family,
    ListWriter,
    OpenedFamily,
    TruthWriter,
    list_extra_topics,
    list_topics,
    list_unit_topics,
)
from copem_replay.io.write.osi import OSI_VERSION
from copem_replay.io.write.scene import MovingEntities, TruthScene, draw_moving, transform_content
from copem_replay.io.write.source import OSI_CHANNEL, Catalogue, RecordingSource, open_source

OSI_RECORD = "net.asam.osi.trace"
"""The one metadata record of an OSI trace file (OSI 3.8, trace file formats)."""
CHUNK_BYTES = 1 << 20
"""Bytes of a chunk of the file before compression: the default of mcap's writer."""
CHUNKS_AHEAD = 16
"""Chunks that may be encoded before they are written: lists are encoded many at once, so that some take long."""
_EVENT_TIMES = ("onset_s", "captured_s", "time_to_detection_s", "distance_at_detection_m")
"""Columns of the detections table that are copied into each detection event."""
ROSBAG_RECORD, ROSBAG_COUNTS = "rosbag2", "serialized_metadata"
"""rosbag2's metadata record, and its key that counts messages: wrong in a copy with more of them."""
RunLists = tuple[Mapping[str, FusedTracks], Sequence[ReadyLists]]
"""The fused tracks of one run by configuration, and the lists of its units."""


def write_mcap(
    path: Path,
    source: Local,
    scene: Scene,
    run_chunks: Iterable[RunLists],
    table: pd.DataFrame,
    manifest: Mapping[str, str],
    family: Family | None = None,
    window: Window | None = None,
    truth: TruthScene | None = None,
    *,
    colours: Mapping[str, Rgb],
) -> list[str]:
    """Write `source` with the fused lists of one run added.

    `run_chunks`: time chunk by time chunk, the fused tracks by configuration; values (1, P); and the lists of the units
    that are to be written. `table`: the rows of the detections table of this log and run. `manifest`: what made the
    file, kept as a metadata record. `family`: of the messages, None: OSI's. `window`: the log time of `source` that was
    read, None: all. `truth`: drawn beside the lists unless it is None or a configuration has the name of its topics.
    `colours`: by configuration.

    MCAP has no times before 0. If a list or a frame of the truth is earlier, all added messages are logged later by the
    same time, so that the first of them is at 0; stamps in messages stay by the log's clock.

    Returns notes on what could not be copied, was replaced, or is logged later. Raises OutputError: the file cannot be
    written; RecordingError: `source` can no longer be read.
    """
    original = open_source(source, window)
    later_chunks = iter(run_chunks)
    first, of_units = next(later_chunks)  # names the configurations and the units
    units = [unit for fused_tracks in first.values() for unit in fused_tracks.received.units]
    units += [unit.name for unit in of_units]
    numbers = {unit: k for k, unit in enumerate(dict.fromkeys(units), start=1)}
    tables = {name: table[table["configuration"] == name] for name in first}
    with atomic_mcap(path, profile=original.profile) as writer:
        catalogue = Catalogue(writer)
        ours = {topic for name in first for topic in (*list_topics(name), *list_extra_topics(name))} | {*TRUTH_TOPICS}
        ours |= {topic for unit in of_units for topic in list_unit_topics(unit.name)}
        messages = original.messages(original.register(catalogue, left_out=ours))
        opened = (family or OSI)(catalogue, scene, numbers)
        encode = partial(_encode_chunk, opened, scene, tables, colours)
        begun = list(encode((first, of_units)))  # registers the channels, those of the lists first
        shown = [] if truth is None or TRUTH in first else [_encode_truth(opened.truth(), truth)]
        del first, of_units
        chunks = chain([begun], map(list, map(encode, later_chunks)))
        added, later_ns = _shift_to_zero(_merge_by_time([chain.from_iterable(map(_order_by_time, chunks)), *shown]))
        _add_records(writer, original, opened.osi, {**manifest, **{f"unit.{k}": unit for unit, k in numbers.items()}})
        for encoded in _encode_ahead(_merge_by_time([messages, added])):
            writer.add_messages(encoded)
    return list(_note_differences(path, original, ours, later_ns))


def _note_differences(path: Path, original: RecordingSource, ours: Set[str], later_ns: int) -> Iterator[str]:
    """Notes on what could not be copied, on topics of `ours` that were replaced, and on later log times."""
    if original.damage:
        yield original.damage
    replaced = sorted(ours & {channel.topic for channel in original.channels.values()})
    if replaced:
        yield f"{len(replaced)} topics of an earlier replay are replaced ({replaced[0]} …)"
    if later_ns:
        yield (
            f"times before 0 cannot be written: the messages of {path.name} that are added to the recording's are "
            f"logged {later_ns / 1e9:.9g} s later; their stamps are as they were"
        )


def _shift_to_zero(messages: Iterator[Message]) -> tuple[Iterator[Message], int]:
    """The messages, in order and none logged before 0, and by how many ns they are logged later."""
    begun = list(islice(messages, 1))
    later_ns = max([0, *(-message.log_time for message in begun)])
    whole = chain(begun, messages)
    return (_delay_log_times(message, later_ns) for message in whole) if later_ns else whole, later_ns


def _delay_log_times(m: Message, later_ns: int) -> Message:
    return Message(m.channel_id, m.log_time + later_ns, m.data, m.publish_time + later_ns, m.sequence)


def _add_records(writer: Writer, original: RecordingSource, osi: bool, manifest: Mapping[str, str]) -> None:
    """The input's metadata records, and those of this file."""
    for name, record in _keep_metadata(original).items():
        if name != RUN_RECORD and not (osi and name == OSI_RECORD):
            writer.add_metadata(name, record)
    writer.add_metadata(RUN_RECORD, dict(sorted(manifest.items())))
    if osi:
        writer.add_metadata(OSI_RECORD, _osi_record(original, OSI_VERSION, version("protobuf")))


def _encode_chunk(
    opened: OpenedFamily,
    scene: Scene,
    tables: Mapping[str, pd.DataFrame],
    colours: Mapping[str, Rgb],
    run_chunk: RunLists,
) -> Iterator[TimedMessages]:
    """The messages of a time chunk: the lists of configurations, what is beside them, then units' lists."""
    chunk, unit_lists = run_chunk
    for name, fused_tracks in chunk.items():
        events = _find_events(fused_tracks.fused, tables[name])
        yield _encode_lists(scene, fused_tracks.fused, opened.channels(name, fused_tracks, events, colours[name]))
    for name, fused_tracks in chunk.items():
        statuses = Statuses(scene, fused_tracks, tables[name])
        yield _encode_lists(scene, fused_tracks.fused, opened.seen_besides(name, fused_tracks, statuses, colours[name]))
    for unit in unit_lists:
        yield _encode_lists(scene, unit.lists.fused, opened.unit_channels(unit))


def _encode_truth(writer: TruthWriter, truth: TruthScene) -> Iterator[Message]:
    """The messages of the truth's scene: static entities once, then frame by frame what moves."""
    frame, encode = 0, writer.encode_transforms
    for part in truth.moving:
        poses = truth.followed[frame : frame + len(part.time_ns)]
        posed = np.array([pose is not None for pose in poses], dtype=bool)
        content = transform_content(
            writer.frame_id, truth.follow, [pose for pose in poses if pose is not None], part.time_ns[posed]
        )
        moves = iter(encode(content, int(posed.sum())))
        for time_ns, drawn, followed in zip(part.time_ns.tolist(), draw_moving(part, writer.draw), posed, strict=True):
            if frame == 0:
                (static,) = draw_moving(MovingEntities.at(time_ns, truth.static), writer.draw)
                yield Message(writer.static, time_ns, static, time_ns, 0)
            yield Message(writer.scene, time_ns, drawn, time_ns, 0)
            if followed:
                yield Message(writer.transform, time_ns, next(moves), time_ns, 0)
            frame += 1


def _merge_by_time(streams: Sequence[Iterator[Message]]) -> Iterator[Message]:
    return heapq.merge(*streams, key=lambda m: m.log_time)


class TimedMessages(NamedTuple):
    """Messages in the order of their log times, which are known before the messages are made."""

    log_time_ns: Int
    messages: Iterator[Message]


def _order_by_time(streams: Sequence[TimedMessages]) -> Iterator[Message]:
    """The messages of all streams by time; of those at one time the first stream's first."""
    times_ns = [one.log_time_ns for one in streams]
    stream_ix = np.repeat(np.arange(len(streams)), [len(of_one) for of_one in times_ns])
    order = np.argsort(np.concatenate(times_ns), kind="stable")
    return (next(streams[k].messages) for k in stream_ix[order].tolist())


def _encode_ahead(messages: Iterator[Message]) -> Iterator[list[Message]]:
    """The messages, many at once, encoded in a thread chunks ahead: compiled code and compression share no lock."""
    thread = ThreadPoolExecutor(1)
    try:
        encoding = deque(thread.submit(_next_messages, messages) for _ in range(CHUNKS_AHEAD))
        while encoded := encoding.popleft().result():
            encoding.append(thread.submit(_next_messages, messages))
            yield encoded
    finally:
        thread.shutdown(cancel_futures=True)


def _next_messages(messages: Iterator[Message]) -> list[Message]:
    messages_of_chunk, size = [], 0
    for message in messages:
        messages_of_chunk.append(message)
        size += len(message.data)
        if size > CHUNK_BYTES:
            break
    return messages_of_chunk


def _encode_lists(scene: Scene, fused: Tracks, writers: Mapping[int, ListWriter]) -> TimedMessages:
    available_ns = scene.t0_ns + np.rint(fused.common_arrives_s * 1e9).astype(np.int64)
    beside = zip(*(writer.messages(available_ns) for writer in writers.values()), strict=True)
    messages = (
        Message(channel, time_ns, data, time_ns, 0)
        for time_ns, of_list in zip(available_ns.tolist(), beside, strict=True)
        for channel, data in zip(writers, of_list, strict=True)
    )
    return TimedMessages(np.repeat(available_ns, len(writers)), messages)


def _find_events(fused: Tracks, table: pd.DataFrame) -> dict[int, list[Event]]:
    """The detections by the index of the list that was available at their instant (other chunks: none)."""
    events: dict[int, list[Event]] = {}
    issue_s, tolerance_s = fused.common_arrives_s, 2 * SAME_INSTANT_S
    if not len(issue_s):
        return events
    # Detections outside are those of other time chunks.
    is_in_chunk = table["detection_s"].between(issue_s[0] - tolerance_s, issue_s[-1] + tolerance_s)
    for row in table.loc[
        table["detected"] & is_in_chunk, ["object_id", "first_unit", "detection_s", *_EVENT_TIMES]
    ].to_dict("records"):
        frame = int(np.abs(issue_s - row["detection_s"]).argmin())
        times = {name: None if np.isnan(row[name]) else float(row[name]) for name in _EVENT_TIMES}
        events.setdefault(frame, []).append({"object": row["object_id"], "first_unit": row["first_unit"], **times})
    return events


def _keep_metadata(original: RecordingSource) -> dict[str, dict[str, str]]:
    """The input's metadata records, without the counts that new messages make wrong."""
    records = dict(original.metadata)
    rosbag = records.pop(ROSBAG_RECORD, {})
    rest = {key: value for key, value in rosbag.items() if key != ROSBAG_COUNTS}
    return records | ({ROSBAG_RECORD: rest} if rest else {})


def _osi_record(original: RecordingSource, osi_version: str, protobuf: str) -> dict[str, str]:
    """The input's OSI record, its ranges of versions widened to those written here; a new one where it had none."""
    record = dict(original.metadata.get(OSI_RECORD, {}))
    for package, ours in (("osi", osi_version), ("protobuf", protobuf)):
        key = f"{OSI_CHANNEL}{package}_version"
        seen = [ours, *(c.metadata[key] for c in original.channels.values() if key in c.metadata)]
        for end, pick in (("min", min), ("max", max)):
            name = f"{end}_{package}_version"
            record[name] = pick([*seen, *([record[name]] if record.get(name) else [])], key=_parse_release)
    record["version"] = record.get("version") or osi_version
    return dict(sorted(record.items()))


def _parse_release(text: str) -> tuple[int, ...]:
    return tuple(int(part) if part.isdigit() else 0 for part in text.split("."))


@contextmanager
def atomic_mcap(path: Path, *, profile: str) -> Iterator[BatchWriter]:
    """A writer whose file gets its name when it is complete; an error before that leaves no file."""
    with atomic_file(path) as scratch, scratch.open("wb") as file:
        writer = BatchWriter(file, enable_data_crcs=True)
        writer.start(profile=profile, library="copem_replay")
        yield writer
        writer.finish()  # type: ignore[no-untyped-call]


class BatchWriter(Writer):
    """The writer of `mcap`, which takes many messages at once, too: in a twentieth of the time, with the same bytes.

    It fills the chunk that the writer has begun, by names that are the writer's own: of `mcap` 1.6.
    """

    def add_messages(self, messages: Iterable[Message]) -> None:
        """Add messages, with the same bytes as `add_message` one by one, but faster."""
        batch: list[Message] = []
        offset, chunk_size = self._chunk.count, vars(self)["_Writer__chunk_size"]
        for message in messages:
            batch.append(message)
            offset += _MESSAGE_HEAD.size + len(message.data)
            if offset > chunk_size:
                self._fill_chunk(batch)
                batch, offset = [], 0
        if batch:
            self._fill_chunk(batch)

    @property
    def _chunk(self) -> ChunkBuilder:
        chunk: ChunkBuilder = vars(self)["_Writer__chunk_builder"]
        return chunk

    def _fill_chunk(self, messages: Sequence[Message]) -> None:
        """Add messages of which all but the last fit into the chunk, and close it if it is full."""
        chunk, parts = self._chunk, list[bytes]()
        offset = chunk.count
        for m in messages:
            index = chunk.message_indices.get(m.channel_id)
            if index is None:
                index = chunk.message_indices[m.channel_id] = _ChannelIndex(m.channel_id, [])
            index.records.append((m.log_time, offset))
            size = _MESSAGE_HEAD.size + len(m.data)
            head = (Opcode.MESSAGE, size - _RECORD_HEAD, m.channel_id, m.sequence, m.log_time, m.publish_time)
            parts += (_MESSAGE_HEAD.pack(*head), m.data)
            offset += size
        chunk.record_writer.write(b"".join(parts))
        times_ns = [m.log_time for m in messages]
        for one, count in ((chunk, chunk.num_messages), (self._counted, self._counted.message_count)):
            one.message_start_time = min([*times_ns, one.message_start_time] if count else times_ns)
            one.message_end_time = max(*times_ns, one.message_end_time)
        chunk.num_messages += len(messages)
        self._counted.message_count += len(messages)
        for channel, number in Counter(m.channel_id for m in messages).items():
            self._counted.channel_message_counts[channel] += number
        vars(Writer)["_Writer__maybe_finalize_chunk"](self)

    @property
    def _counted(self) -> Statistics:
        counted: Statistics = vars(self)["_Writer__statistics"]
        return counted


class _ChannelIndex(MessageIndex):
    """Where the messages of a channel are in a chunk, written at once."""

    def write(self, stream: RecordBuilder) -> None:
        """Write the record."""
        stream.start_record(Opcode.MESSAGE_INDEX)
        stream.write2(self.channel_id)
        stream.write4(16 * len(self.records))
        stream.write(np.array(self.records, dtype="<u8").tobytes())
        stream.finish_record()  # type: ignore[no-untyped-call]


_MESSAGE_HEAD = struct.Struct("<BQHIQQ")
"""A message up to its data: the kind and size of the record, channel, sequence, two times in ns."""
_RECORD_HEAD = 9
"""Bytes of the kind and size of a record."""
