"""OSI's binary trace of a single channel: each message after its length (four bytes, little-endian), and nothing else.

Source: OSI 3.8, trace file formats and naming conventions. The kind of message follows from the messages themselves;
where they leave it open it follows from the name of the file, by convention
`<time>_<type>_<osi>_<protobuf>_<frames>_<name>.osi`.
"""

from __future__ import annotations

import os
import re
from array import array
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import IO, Any

import numpy as np
from google.protobuf.message import DecodeError
from mcap.records import Message

from copem_replay.core.errors import RecordingError, count_noun
from copem_replay.core.tracks import Int
from copem_replay.io.channel import LAST_NS, Channel
from copem_replay.io.containers.mcap_records import CHUNK_LIMIT_BYTES, MAGIC
from copem_replay.io.decoded_size import OversizeError
from copem_replay.io.log import Log, open_file, unsupported_file_error
from copem_replay.io.schemas.osi_ground_truth import (
    GROUND_TRUTH,
    SENSOR_DATA,
    SENSOR_VIEW,
    check_osi,
    load_message_class,
)
from copem_replay.io.stamps import SLACK_NS

_LENGTH_BYTES = 4
_TRIED = 10  # messages by which the kind is told; more make opening slower
_EXPLAINED = 0.5
"""Least share of the bytes of messages with a meaning in a schema. In the right one the share is 1, less where the OSI
of the file is newer; in a wrong one at most 0.2, except 0.9 for a sensor view read as ground truth."""
_NAME = re.compile(
    r"(\d{8}T\d{4}\w*?_)?(?P<type>[a-z]+)_(?P<osi>[\d.]+)_(?P<protobuf>[\d.]+)_(?P<frames>\d{1,12})(_|\.)"
)
_READ = {"gt": GROUND_TRUTH, "sv": SENSOR_VIEW, "sd": SENSOR_DATA}
_NOT_READ = {
    "svc": "SensorViewConfiguration", "hvd": "HostVehicleData", "tc": "TrafficCommand", "tcu": "TrafficCommandUpdate",
    "tu": "TrafficUpdate", "mr": "MotionRequest", "su": "StreamingUpdate",
}  # fmt: skip


@dataclass(frozen=True)
class TraceLog(Log):
    """The log of a trace: one channel, whose topic is the name of its messages (`GroundTruth`).

    Log times are the messages' time stamps, which no reset sets back. In their order: offsets and lengths of the
    messages in the file, and times.
    """

    osi_version: str = ""  # as the first message states it
    offsets: Sequence[int] = field(default=(), repr=False)
    lengths: Sequence[int] = field(default=(), repr=False)
    times_ns: Sequence[int] = field(default=(), repr=False)

    def messages(self, numbers: Set[int], *, sort: bool = False) -> Iterator[Message]:
        """Messages in order of their time stamps, if the one channel is asked for."""
        with open_file(self.path) as file:
            for number, (first_ns, last_ns) in self.spans(numbers).items():
                for k in range(bisect_left(self.times_ns, first_ns), bisect_right(self.times_ns, last_ns)):
                    file.seek(self.offsets[k])
                    time_ns = self.times_ns[k]
                    yield Message(number, time_ns, file.read(self.lengths[k]), time_ns, 0)


def is_trace(path: Path) -> bool:
    """Whether a file is read as OSI's trace of a single channel: its name ends in `.osi`, and it is not MCAP."""
    if path.suffix.lower() != ".osi" or not path.is_file():
        return False
    with open_file(path) as file:
        return file.read(len(MAGIC)) != MAGIC


def open_trace(path: Path) -> TraceLog:
    """The log of a trace. Raises RecordingError: a kind that is not read, no message, or messages of no kind."""
    name = _NAME.match(path.name)
    schema, notes = _find_schema(path, name["type"] if name else "")
    message_class, skipped = load_message_class(schema), Counter[str]()
    offsets, lengths, times_ns = array("q"), array("q"), array("q")
    cut, release = list[str](), ""
    with open_file(path) as file:
        for offset, payload in _read_payloads(file, cut):
            try:
                check_osi(message_class, payload)
                message = message_class.FromString(payload)
            except OversizeError as error:
                raise RecordingError(str(error), path=path) from None
            except DecodeError:
                skipped["cannot be decoded"] += 1
                continue
            time_ns = _time_ns(message)
            if time_ns is None or not 0 <= time_ns <= LAST_NS:
                skipped["without a time stamp" if time_ns is None else "with an impossible time stamp"] += 1
                continue
            if not offsets and message.HasField("version"):
                v = message.version
                release = f"{v.version_major}.{v.version_minor}.{v.version_patch}"
            offsets.append(offset)
            lengths.append(len(payload))
            times_ns.append(time_ns)
    notes += [f"{count_noun(number, 'message')} {what}: skipped" for what, number in skipped.items()]
    if not offsets:
        reason = "; ".join([*cut, *notes])
        raise RecordingError(
            f"{'damaged, and ' if cut else ''}no message of {schema} can be read ({reason})", path=path
        )
    logged_ns = _make_log_times(np.array(times_ns))
    order = np.argsort(logged_ns, kind="stable")
    expected = int(name["frames"]) if name and cut else None
    topic = schema.removeprefix("osi3.")
    return TraceLog(
        path=path,
        channels=(Channel(1, topic, schema, "protobuf", len(offsets), expected, "protobuf"),),
        indexed=False,
        damage=cut[0] if cut else None,
        complete=not cut,
        start_ns=int(logged_ns.min()),
        end_ns=int(logged_ns.max()),
        notes=tuple(notes),
        osi_version=release,
        offsets=np.array(offsets)[order].tolist(),
        lengths=np.array(lengths)[order].tolist(),
        times_ns=logged_ns[order].tolist(),
    )


def _make_log_times(stamp_ns: Int) -> Int:
    """(F,) log times of messages in the order of the file: their stamps, but after a reset on and on."""
    shift_ns = np.zeros(len(stamp_ns))
    falls = np.flatnonzero((np.diff(stamp_ns)[:-1] < -SLACK_NS) & (stamp_ns[2:] - stamp_ns[:-2] < -SLACK_NS))
    shift_ns[falls + 1] = stamp_ns[falls] - stamp_ns[falls + 1] + 2 * SLACK_NS  # one late message is no reset
    later_ns = stamp_ns + np.cumsum(shift_ns).clip(max=LAST_NS).astype(np.int64)
    return later_ns if later_ns.max() <= LAST_NS else stamp_ns


def _read_payloads(file: IO[bytes], cut: list[str]) -> Iterator[tuple[int, bytes]]:
    """Offset and bytes of each message, as far as they go; at damage the reason is appended to `cut`."""
    size = os.fstat(file.fileno()).st_size
    offset = 0
    while offset < size:
        file.seek(offset)
        length = int.from_bytes(file.read(_LENGTH_BYTES), "little")
        offset += _LENGTH_BYTES
        if offset > size or length > size - offset:
            cut.append("the file ends too early")
            return
        if length == 0 or length > CHUNK_LIMIT_BYTES:
            cut.append("something that is no message")
            return
        yield offset, file.read(length)
        offset += length


def _time_ns(message: Any) -> int | None:
    """The time stamp of a message, or of the ground truth in it, in ns; None: there is none."""
    candidates = [message, *([message.global_ground_truth] if hasattr(message, "global_ground_truth") else [])]
    for candidate in candidates:
        if candidate.HasField("timestamp"):
            return int(candidate.timestamp.seconds) * 10**9 + int(candidate.timestamp.nanos)
    return None


def _find_schema(path: Path, named: str) -> tuple[str, list[str]]:
    """The schema of the messages, and a note if the file's name (`named`) says another. Raises RecordingError."""
    if named in _NOT_READ:
        raise RecordingError(
            f"osi3.{_NOT_READ[named]} by its name, which is not read; {', '.join(_READ)} are", path=path
        )
    with open_file(path) as file:
        first = [payload for _, payload in islice(_read_payloads(file, []), _TRIED)]
        if not first:
            file.seek(0)
            raise unsupported_file_error("an OSI trace", path, file.read(64))
    share = {schema: _explained_share(first, schema) for schema in _READ.values()}
    best_schema, second_schema = sorted(share, key=lambda schema: -share[schema])[:2]
    if named in _READ and (share[_READ[named]] == share[best_schema] or share[best_schema] < _EXPLAINED):
        return _READ[named], []
    if share[best_schema] >= _EXPLAINED and share[best_schema] > share[second_schema]:
        by_name = f"says {named}" if named in _READ else "does not say"
        return best_schema, [f"taken for {best_schema} by its messages: the name of the file {by_name}"]
    raise RecordingError(
        f"its messages can be told for none of {', '.join(share)}; if they are, name the file by OSI's "
        f"convention: 20260102T030405Z_gt_380_2961_{len(first)}_name.osi",
        path=path,
    )


def _explained_share(payloads: Sequence[bytes], schema: str) -> float:
    """Share (0 to 1) of the messages' bytes that are known fields of a schema; high for the right one."""
    explained_bytes = 0
    for payload in payloads:
        try:
            check_osi(message_class := load_message_class(schema), payload)
            message = message_class.FromString(payload)
        except (DecodeError, OversizeError):
            continue
        message.DiscardUnknownFields()
        explained_bytes += min(len(payload), message.ByteSize())
    return explained_bytes / max(sum(map(len, payloads)), 1)
