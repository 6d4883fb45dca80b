"""From boxes to a recording of osi3.GroundTruth: the last step of every converter."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from osi3.osi_groundtruth_pb2 import GroundTruth

from copem_replay.core.errors import InputError
from copem_replay.core.text import counted
from copem_replay.io.convert.kinds import Kind
from copem_replay.io.convert.parse import LAST_SECOND
from copem_replay.io.write.osi_trace import NANOS_PER_SECOND, OsiTrace, empty_ground_truth, write_osi_trace

TOPIC: Final = "ground_truth"
RECORD: Final = "copem_replay.conversion"
"""Metadata record of the file: format, what the OSI ids were in the source, and the notes."""


@dataclass(frozen=True)
class Box:
    """One object at one instant, in the world frame of the source."""

    id: int
    kind: Kind
    at_m: tuple[float, float, float]  # centre of the box
    yaw_rad: float  # counter-clockwise from +x
    size_m: tuple[float, float, float]  # length, width, height
    velocity_mps: tuple[float, float] | None = None  # None: the source says nothing
    rear_axle_m: tuple[float, float, float] | None = None  # from the centre, in the frame of the box


@dataclass(frozen=True)
class Frame:
    """All boxes of one instant."""

    stamp_ns: int
    boxes: list[Box]
    host: int | None = None


@dataclass
class Report:
    """What was skipped, assumed or put right while converting, and the names of the objects in the source."""

    counts: Counter[tuple[str, str]] = field(default_factory=Counter)
    assumed: dict[str, None] = field(default_factory=dict)  # a line each, in order
    names: dict[int, str] = field(default_factory=dict)  # by OSI id
    frames: int = 0
    objects: Counter[str] = field(default_factory=Counter)  # per kind
    seen: set[tuple[bool, int]] = field(default_factory=set)

    def count(self, noun: str, what: str, number: int = 1) -> None:
        """Note that so many `noun`s are `what`."""
        if number:
            self.counts[noun, what] += number

    def assume(self, line: str) -> None:
        """Note an assumption, once."""
        self.assumed[line] = None

    def lines(self) -> list[str]:
        """All notes."""
        return [*self.assumed, *(f"{counted(number, noun)} {what}" for (noun, what), number in self.counts.items())]


def write(path: Path, frames: Iterable[Frame], report: Report, *, source: Path, format_name: str) -> None:
    """Write the recording, in full or not at all. Raises InputError: no object, or times that make no sense."""
    record: dict[str, str] = {}
    trace = OsiTrace(
        description=f"{source.name}, converted from {format_name}",
        topics={TOPIC: "osi3.GroundTruth: all objects of the source"},
        messages=_messages(frames, report, source, format_name, record),
        source=f"{format_name}: {source.name} (copem-replay convert)",
        records={RECORD: record},
    )
    write_osi_trace(trace, path)


def _messages(
    frames: Iterable[Frame], report: Report, source: Path, format_name: str, record: dict[str, str]
) -> Iterator[tuple[str, GroundTruth]]:
    """Encode frame by frame; `record` is filled once all are through, since only then all names are known."""
    last_ns = -1
    for frame in frames:
        if not last_ns < frame.stamp_ns <= LAST_SECOND * NANOS_PER_SECOND:
            expected = f"after {last_ns / 1e9:.6f} s" if last_ns >= 0 else "of 0 s or later"
            raise InputError(
                f"{source}: frame {report.frames + 1}: expected a time {expected}, up to {LAST_SECOND} s, "
                f"found {frame.stamp_ns / 1e9:.6f} s"
            )
        last_ns = frame.stamp_ns
        report.frames += 1
        yield TOPIC, _message(frame, report)
    if not report.seen:
        skipped = "".join(f"; {line}" for line in report.lines())
        raise InputError(f"{source}: no object to convert in {counted(report.frames, 'frame')}{skipped}")
    ids = {str(ident): name for ident, name in sorted(report.names.items())}
    notes = json.dumps(report.lines(), ensure_ascii=False)
    record |= {"format": format_name, "ids": json.dumps(ids, ensure_ascii=False), "notes": notes}


def _message(frame: Frame, report: Report) -> GroundTruth:
    osi = empty_ground_truth(frame.stamp_ns, frame.host)
    for box in frame.boxes:
        if not all(map(math.isfinite, (*box.at_m, box.yaw_rad, *box.size_m))):
            report.count("object state", "with a number that is none: skipped")
            continue
        if min(box.size_m) <= 0.0:
            report.count("object state", "without a size above 0: skipped")
            continue
        if (key := (box.kind.moving, box.id)) not in report.seen:
            report.seen.add(key)
            report.objects[box.kind.name] += 1
        _add(osi, box)
    return osi


def _add(osi: Any, box: Box) -> None:
    new = (osi.moving_object if box.kind.moving else osi.stationary_object).add()
    new.id.value = box.id
    base = new.base
    base.dimension.length, base.dimension.width, base.dimension.height = box.size_m
    base.position.x, base.position.y, base.position.z = box.at_m
    base.orientation.roll, base.orientation.pitch, base.orientation.yaw = 0.0, 0.0, box.yaw_rad
    if not box.kind.moving:
        new.classification.type = box.kind.type
        return
    new.type = box.kind.type
    if box.kind.vehicle is not None:
        new.vehicle_classification.type = box.kind.vehicle
    if box.velocity_mps is not None and all(map(math.isfinite, box.velocity_mps)):
        base.velocity.x, base.velocity.y, base.velocity.z = *box.velocity_mps, 0.0
    if box.rear_axle_m is not None:
        rear = new.vehicle_attributes.bbcenter_to_rear
        rear.x, rear.y, rear.z = box.rear_axle_m
