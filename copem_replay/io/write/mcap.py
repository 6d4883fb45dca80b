"""MCAP out: the input's channels with their messages untouched, and each configuration's fused lists.

For each configuration three channels: `copem/<configuration>/objects` (the fused lists), `…/scene` (the same as
boxes) and `…/detail` (JSON: what the objects cannot carry), in messages of the input's family
(`io/write/message_family.py`), one per fused list, log_time = publish_time = the instant it was available. Two more are
for looking at: `…/status` (what is known) and `…/uncertainty` (ellipses, paler with age). The truth is a scene of its
own: `copem/truth/scene` (what moves), `…/static` (what does not) and `…/transform` (the ego's frame of reference). The
same input gives the same bytes; the file appears under its name when it is complete, or not at all.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib.metadata import version
from itertools import chain
from pathlib import Path

import numpy as np
import pandas as pd
from mcap.records import Message
from mcap.writer import Writer

from copem_replay.core.colours import Rgb, configuration_colours
from copem_replay.core.files import atomic_file
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import SAME_INSTANT_NS, TRUTH, Scene, Tracks
from copem_replay.io.together import Local
from copem_replay.io.window import Window
from copem_replay.io.write import detail_json as detail
from copem_replay.io.write.drawing import TruthScene
from copem_replay.io.write.message_family import (
    OSI,
    OSI_CHANNEL,
    TRUTH_TOPICS,
    Family,
    ListWriter,
    Opened,
    TruthWriter,
    more_topics_of,
    osi_version,
    topics_of,
)
from copem_replay.io.write.pass_through import Catalogue
from copem_replay.io.write.source import Source, source_of
from copem_replay.io.write.status import Statuses

OSI_RECORD = "net.asam.osi.trace"
"""The one metadata record of an OSI trace file (OSI 3.8, trace file formats)."""
RUN_RECORD = "org.copem_replay.run"
"""Our own record: what made the file."""
CHUNK_BYTES = 1 << 20
"""Of a file, before it is compressed (that of the library)."""
ROSBAG_RECORD, ROSBAG_COUNTS = "rosbag2", "serialized_metadata"
"""rosbag2's own record, and what in it counts the messages: no longer true of a copy with more of them."""


def write_mcap(
    path: Path,
    source: Local,
    scene: Scene,
    run_tracks: Iterable[Mapping[str, FusedTracks]],
    table: pd.DataFrame,
    manifest: Mapping[str, str],
    family: Family | None = None,
    window: Window | None = None,
    truth: TruthScene | None = None,
    colours: Mapping[str, Rgb] | None = None,
) -> list[str]:
    """Write `source` with the fused lists of one run added.

    `run_tracks`: one time chunk after the other, by configuration; values (1, P).

    `table`: the rows of the detections table of this log and run, by which detections are told beside the lists.
    `manifest`: what made the file, kept as a metadata record. `family`: in what messages, None: OSI's.
    `window`: of `source` that was read, None: all. `truth`: to be drawn beside them, None: not drawn; nor where a
    configuration has the name of its topics. `colours`: by configuration, None: by their places in `run_tracks`.

    Where lists or frames of the truth are from before 0, which MCAP cannot say, all messages that are added are logged
    so much later that the first of them is at 0; what is in messages goes by the log's clock.

    Returns notes on what could not be copied, was replaced, or is logged later.

    Raises OutputError when the file cannot be written, RecordingError when `source` can no longer be read.
    """
    original = source_of(source, window)
    rest = iter(run_tracks)
    first = next(rest)  # it tells the configurations and the units
    colours = colours or configuration_colours(first)
    units = dict.fromkeys(unit for fused_tracks in first.values() for unit in fused_tracks.heard.units)
    numbers = {unit: k + 1 for k, unit in enumerate(units)}
    with atomic_mcap(path, profile=original.profile) as writer:
        catalogue = Catalogue(writer)
        ours = {topic for name in first for topic in (*topics_of(name), *more_topics_of(name))} | {*TRUTH_TOPICS}
        messages = original.messages(original.register(catalogue, without=ours))
        opened = (family or OSI)(catalogue, scene, numbers)

        def lists_of(chunk: Mapping[str, FusedTracks]) -> list[Iterator[Message]]:
            return list(_lists_of(opened, scene, chunk, table, colours))

        def besides(chunk: Mapping[str, FusedTracks]) -> list[Iterator[Message]]:
            return list(_besides(opened, scene, chunk, table, colours))

        begun = [*lists_of(first), *besides(first)]  # registers the channels, those of the lists first
        shown = [] if truth is None or TRUTH in first else [_truth(opened.truth(), truth)]
        del first
        chunks = chain([begun], ([*lists_of(c), *besides(c)] for c in rest))
        added = _in_order([chain.from_iterable(_in_order(streams) for streams in chunks), *shown])
        added, later_ns = _from_zero_on(added)
        _add_records(writer, original, opened.osi, {**manifest, **{f"unit.{k}": unit for unit, k in numbers.items()}})
        for message in _made_ahead(_in_order([messages, added])):
            writer.add_message(
                message.channel_id, message.log_time, message.data, message.publish_time, message.sequence
            )
    replaced = sorted(ours & {channel.topic for channel in original.channels.values()})
    notes = [f"{len(replaced)} topics of an earlier replay are replaced ({replaced[0]} …)"] if replaced else []
    if later_ns:
        notes.append(
            f"times before 0 cannot be written: the messages of {path.name} that are added to the recording's are "
            f"logged {later_ns / 1e9:.9g} s later; their stamps are as they were"
        )
    return [*([original.damage] if original.damage else []), *notes]


def _from_zero_on(messages: Iterator[Message]) -> tuple[Iterator[Message], int]:
    """Messages in order, none of them logged before 0, and how many ns later than before they are logged."""
    first = next(messages, None)
    if first is None or first.log_time >= 0:
        return chain([] if first is None else [first], messages), 0
    later_ns = -first.log_time
    return (_logged_later(message, later_ns) for message in chain([first], messages)), later_ns


def _logged_later(m: Message, later_ns: int) -> Message:
    return Message(m.channel_id, m.log_time + later_ns, m.data, m.publish_time + later_ns, m.sequence)


def _add_records(writer: Writer, original: Source, osi: bool, manifest: Mapping[str, str]) -> None:
    """The input's metadata records, and those of this file."""
    for name, record in _kept(original).items():
        if name != RUN_RECORD and not (osi and name == OSI_RECORD):
            writer.add_metadata(name, record)
    writer.add_metadata(RUN_RECORD, dict(sorted(manifest.items())))
    if osi:
        writer.add_metadata(OSI_RECORD, _osi_record(original, osi_version(), version("protobuf")))


def _lists_of(
    opened: Opened, scene: Scene, chunk: Mapping[str, FusedTracks], table: pd.DataFrame, colours: Mapping[str, Rgb]
) -> Iterator[Iterator[Message]]:
    """Of each configuration the messages of one time chunk."""
    for name, fused_tracks in chunk.items():
        events = _events(fused_tracks.fused, table[table["configuration"] == name])
        yield _lists(scene, fused_tracks.fused, opened.channels(name, fused_tracks, events, colours[name]))


def _besides(
    opened: Opened, scene: Scene, chunk: Mapping[str, FusedTracks], table: pd.DataFrame, colours: Mapping[str, Rgb]
) -> Iterator[Iterator[Message]]:
    """Of each configuration what is only for looking at, of one time chunk."""
    for name, fused_tracks in chunk.items():
        statuses = Statuses(scene, fused_tracks, table[table["configuration"] == name])
        yield _lists(scene, fused_tracks.fused, opened.seen_besides(name, fused_tracks, statuses, colours[name]))


def _truth(writer: TruthWriter, truth: TruthScene) -> Iterator[Message]:
    """The truth as a scene of its own: what does not move once, at the start."""
    for k, frame in enumerate(truth.frames):
        time_ns = frame.time_ns
        if k == 0:
            yield Message(writer.static, time_ns, writer.drawn(truth.static, time_ns), time_ns, 0)
        yield Message(writer.scene, time_ns, writer.drawn(frame.entities, time_ns), time_ns, 0)
        if frame.followed is not None:
            placed = writer.followed(frame.followed, time_ns, truth.follow)
            yield Message(writer.transform, time_ns, placed, time_ns, 0)


def _in_order(streams: Sequence[Iterator[Message]]) -> Iterator[Message]:
    return heapq.merge(*streams, key=lambda m: m.log_time)


def _made_ahead(messages: Iterator[Message]) -> Iterator[Message]:
    """The same, a chunk of the file ahead in a thread of their own: compiled code and compression share no lock."""
    with ThreadPoolExecutor(1) as thread:
        next_ones = thread.submit(_some, messages)
        while made := next_ones.result():
            next_ones = thread.submit(_some, messages)
            yield from made


def _some(messages: Iterator[Message]) -> list[Message]:
    made, size = [], 0
    for message in messages:
        made.append(message)
        size += len(message.data)
        if size > CHUNK_BYTES:
            break
    return made


def _lists(scene: Scene, fused: Tracks, writers: Mapping[int, ListWriter]) -> Iterator[Message]:
    available_ns = scene.t0_ns + np.rint(fused.common_arrives_s * 1e9).astype(np.int64)
    streams = zip(*(writer.messages(available_ns) for writer in writers.values()), strict=True)
    for time_ns, beside in zip(available_ns.tolist(), streams, strict=True):
        for channel, data in zip(writers, beside, strict=True):
            yield Message(channel, time_ns, data, time_ns, 0)


def _events(fused: Tracks, table: pd.DataFrame) -> dict[int, list[detail.Event]]:
    """What was detected with each list: detections by the index of the list that was then available."""
    events: dict[int, list[detail.Event]] = {}
    issue_s, tolerance_s = fused.common_arrives_s, 2e-9 * SAME_INSTANT_NS
    if not len(issue_s):
        return events
    # The others are of other time chunks.
    here = table["detection_s"].between(issue_s[0] - tolerance_s, issue_s[-1] + tolerance_s)
    for row in table[table["detected"] & here].to_dict("records"):
        frame = int(np.abs(issue_s - row["detection_s"]).argmin())
        event = {"object": row["object_id"], "first_unit": row["first_unit"]}
        for name in ("onset_s", "captured_s", "time_to_detection_s", "distance_at_detection_m"):
            event[name] = None if row[name] != row[name] else float(row[name])
        events.setdefault(frame, []).append(event)
    return events


def _kept(original: Source) -> dict[str, dict[str, str]]:
    """The input's metadata records, without what its new messages belie."""
    records = dict(original.metadata)
    rosbag = records.pop(ROSBAG_RECORD, {})
    rest = {key: value for key, value in rosbag.items() if key != ROSBAG_COUNTS}
    return records | ({ROSBAG_RECORD: rest} if rest else {})


def _osi_record(original: Source, osi_version: str, protobuf: str) -> dict[str, str]:
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
