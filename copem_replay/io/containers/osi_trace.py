"""OSI's binary trace of a single channel: each message after its length (four bytes, little-endian), and nothing else.

(OSI 3.8, trace file formats and naming conventions.) What kind of message it holds is found out from the messages; the
name decides where they leave it open, if it is `<time>_<type>_<osi>_<protobuf>_<frames>_<name>.osi` by convention.
"""

from __future__ import annotations

import os
import re
from array import array
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass, field
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import IO, Any

import numpy as np
from google.protobuf.message import DecodeError
from mcap.records import Message

from copem_replay.core.errors import RecordingError
from copem_replay.core.text import counted
from copem_replay.io.channel import Channel
from copem_replay.io.containers.mcap_records import CHUNK_LIMIT_BYTES, MAGIC
from copem_replay.io.containers.unsupported import other_than
from copem_replay.io.log import Log, open_file
from copem_replay.io.schemas.decoded import LAST_NS
from copem_replay.io.schemas.osi_ground_truth import GROUND_TRUTH, SENSOR_DATA, SENSOR_VIEW

_LENGTH_BYTES = 4
_TRIED = 10  # messages by which the kind is found out (chosen)
_EXPLAINED = 0.5
"""Of the bytes of messages: the least share with a meaning by which a kind is believed (chosen). Of the right kind
it is 1, less where OSI is newer than ours; of a wrong one 0.2 at most, but 0.9 of a sensor view as ground truth."""
_NAME = re.compile(
    r"(\d{8}T\d{4}\w*?_)?(?P<type>[a-z]+)_(?P<osi>[\d.]+)_(?P<protobuf>[\d.]+)_(?P<frames>\d{1,12})(_|\.)"
)
_READ = {"gt": GROUND_TRUTH, "sv": SENSOR_VIEW, "sd": SENSOR_DATA}
_NOT_READ = {
    "svc": "SensorViewConfiguration", "hvd": "HostVehicleData", "tc": "TrafficCommand", "tcu": "TrafficCommandUpdate",
    "tu": "TrafficUpdate", "mr": "MotionRequest", "su": "StreamingUpdate",
}  # fmt: skip


@dataclass(frozen=True)
class Trace(Log):
    """A trace that was looked at: one channel, whose topic is the name of its messages (`GroundTruth`).

    Messages are logged at their time stamps. By these: where they are in the file, how long, and when.
    """

    osi_version: str = ""  # as the first message says it
    offsets: Sequence[int] = field(default=(), repr=False)
    lengths: Sequence[int] = field(default=(), repr=False)
    times_ns: Sequence[int] = field(default=(), repr=False)

    def messages(self, numbers: Set[int]) -> Iterator[Message]:
        """Messages in order of their time stamps, if the one channel is asked for."""
        with open_file(self.path) as file:
            for number, (first_ns, last_ns) in self.spans(numbers).items():
                for k in range(bisect_left(self.times_ns, first_ns), bisect_right(self.times_ns, last_ns)):
                    file.seek(self.offsets[k])
                    time_ns = self.times_ns[k]
                    yield Message(number, time_ns, file.read(self.lengths[k]), time_ns, 0)


def is_trace(path: Path) -> bool:
    """Whether a file is to be read as OSI's trace of a single channel: by its name, unless it is MCAP all the same."""
    if path.suffix.lower() != ".osi" or not path.is_file():
        return False
    with open_file(path) as file:
        return file.read(len(MAGIC)) != MAGIC


def open_trace(path: Path) -> Trace:
    """Look at a trace. Raises RecordingError: a kind that is not read, no message, or messages of no kind."""
    said = _NAME.match(path.name)
    schema, notes = _schema(path, said["type"] if said else "")
    kind, skipped = message_class(schema), Counter[str]()
    offsets, lengths, times_ns = array("q"), array("q"), array("q")
    cut: list[str] = []
    release = ""
    with open_file(path) as file:
        for offset, payload in _payloads(file, cut):
            try:
                message = kind.FromString(payload)
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
    notes += [f"{counted(number, 'message')} {what}: skipped" for what, number in skipped.items()]
    if not offsets:
        why = "; ".join([*cut, *notes])
        raise RecordingError(f"{'damaged, and ' if cut else ''}no message of {schema} can be read ({why})", path=path)
    order = np.argsort(np.array(times_ns), kind="stable")
    expected = int(said["frames"]) if said and cut else None
    topic = schema.removeprefix("osi3.")
    return Trace(
        path=path,
        channels=(Channel(1, topic, schema, "protobuf", len(offsets), expected, "protobuf"),),
        indexed=False,
        damage=cut[0] if cut else None,
        complete=not cut,
        start_ns=min(times_ns),
        end_ns=max(times_ns),
        notes=tuple(notes),
        osi_version=release,
        offsets=np.array(offsets)[order].tolist(),
        lengths=np.array(lengths)[order].tolist(),
        times_ns=np.array(times_ns)[order].tolist(),
    )


def message_class(schema: str) -> Any:
    """The class of messages, imported when first needed."""
    name = schema.removeprefix("osi3.")
    return getattr(import_module(f"osi3.osi_{name.lower()}_pb2"), name)


def _payloads(file: IO[bytes], cut: list[str]) -> Iterator[tuple[int, bytes]]:
    """Where each message is, and the message, as far as they go; why not further is put into `cut`."""
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
    """The time stamp of a message, or of the ground truth in it."""
    said = [message, *([message.global_ground_truth] if hasattr(message, "global_ground_truth") else [])]
    for one in said:
        if one.HasField("timestamp"):
            return int(one.timestamp.seconds) * 10**9 + int(one.timestamp.nanos)
    return None


def _schema(path: Path, named: str) -> tuple[str, list[str]]:
    """What the messages are, and a note where the file's name does not say. Raises RecordingError."""
    if named in _NOT_READ:
        raise RecordingError(
            f"osi3.{_NOT_READ[named]} by its name, which is not read; {', '.join(_READ)} are", path=path
        )
    with open_file(path) as file:
        first = [payload for _, payload in islice(_payloads(file, []), _TRIED)]
        if not first:
            file.seek(0)
            raise other_than("an OSI trace", path, file.read(64))
    share = {schema: _explained(first, schema) for schema in _READ.values()}
    best, second = sorted(share, key=lambda schema: -share[schema])[:2]
    if named in _READ and (share[_READ[named]] == share[best] or share[best] < _EXPLAINED):
        return _READ[named], []
    if share[best] >= _EXPLAINED and share[best] > share[second]:
        by_name = f"says {named}" if named in _READ else "does not say"
        return best, [f"taken for {best} by its messages: the name of the file {by_name}"]
    raise RecordingError(
        f"its messages can be told for none of {', '.join(share)}; if they are, name the file by OSI's "
        f"convention: 20260102T030405Z_gt_380_2961_{len(first)}_name.osi",
        path=path,
    )


def _explained(payloads: Sequence[bytes], schema: str) -> float:
    """The share of the bytes of messages that have a meaning in a schema."""
    kept = 0
    for payload in payloads:
        try:
            message = message_class(schema).FromString(payload)
        except DecodeError:
            continue
        message.DiscardUnknownFields()
        kept += min(len(payload), message.ByteSize())
    return kept / max(sum(map(len, payloads)), 1)
