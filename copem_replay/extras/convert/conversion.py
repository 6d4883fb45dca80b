"""Converting data sets and simulations to recordings of OSI truth: sources, outputs, kinds of objects, and notes.

A format is one module with `frames(source, report, **options)` and a row of `FORMATS`. An output is complete or does
not exist; a given input gives the same bytes each time.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np
from osi3.osi_groundtruth_pb2 import GroundTruth
from osi3.osi_object_pb2 import MovingObject, StationaryObject

from copem_replay.core.errors import InputError, OutputError, count_noun, quote_value, unknown_name_message
from copem_replay.core.files import find_scratch_names, remove_leftovers
from copem_replay.core.frame import SaidPlace
from copem_replay.core.site_map import SiteMap
from copem_replay.core.tracks import CLASSES, Float
from copem_replay.io.class_names import class_from_name, stands
from copem_replay.io.findings import (
    BODIES_M,
    FARTHEST_M,
    LENGTH,
    LONGEST_M,
    MOST_RAD,
    RULES,
    as_finding,
    complete_sizes,
)
from copem_replay.io.schemas.osi_ground_truth import osi_class_index
from copem_replay.io.write.osi import NANOS_PER_SECOND, OsiTrace, add_road, empty_ground_truth, write_osi_trace
from copem_replay.results.outputs import CONVERSION, check_output, check_outputs, is_converted

# Kinds of objects in OSI. The names of formats are mapped onto these by the one table of class names.

Vehicle = MovingObject.VehicleClassification
Static = StationaryObject.Classification


@dataclass(frozen=True)
class OsiKind:
    """A kind of object: its type in OSI and, for vehicles and stationary objects, its classification."""

    name: str
    moving: bool
    type: int  # MovingObject.Type, or StationaryObject.Classification.Type
    vehicle: int | None = None
    like: str = "vehicle"  # the class whose typical height it has

    @property
    def class_name(self) -> str:
        """The class as which it is read."""
        return CLASSES[osi_class_index(self.type, self.vehicle)]

    @property
    def height_m(self) -> float:
        """Typical height, for sources without heights."""
        return BODIES_M[self.like][2]


_VEHICLES = {  # name: (vehicle classification, class whose height is typical)
    "car": (Vehicle.TYPE_MEDIUM_CAR, "car"),
    "van": (Vehicle.TYPE_DELIVERY_VAN, "van"),
    "truck": (Vehicle.TYPE_HEAVY_TRUCK, "truck"),
    "tractor": (Vehicle.TYPE_SEMITRACTOR, "truck"),
    "bus": (Vehicle.TYPE_BUS, "bus"),
    "trailer": (Vehicle.TYPE_TRAILER, "trailer"),
    "motorcycle": (Vehicle.TYPE_MOTORBIKE, "motorcycle"),
    "bicycle": (Vehicle.TYPE_BICYCLE, "bicycle"),
    "scooter": (Vehicle.TYPE_STANDUP_SCOOTER, "bicycle"),
    "wheelchair": (Vehicle.TYPE_WHEELCHAIR, "pedestrian"),
    "tram": (Vehicle.TYPE_TRAM, "bus"),
    "train": (Vehicle.TYPE_TRAIN, "bus"),
    "work machine": (Vehicle.TYPE_WORK_MACHINE, "truck"),
    "vehicle": (None, "vehicle"),  # a vehicle of unknown kind
}
_STATIC = {
    "cone": Static.TYPE_CONSTRUCTION_SITE_ELEMENT,
    "pole": Static.TYPE_POLE,
    "barrier": Static.TYPE_BARRIER,
    "building": Static.TYPE_BUILDING,
    "static": Static.TYPE_OTHER,
}
KINDS: Final[dict[str, OsiKind]] = {
    **{name: OsiKind(name, True, MovingObject.TYPE_VEHICLE, *what) for name, what in _VEHICLES.items()},
    "pedestrian": OsiKind("pedestrian", True, MovingObject.TYPE_PEDESTRIAN, like="pedestrian"),
    "animal": OsiKind("animal", True, MovingObject.TYPE_ANIMAL, like="animal"),
    "other": OsiKind("other", True, MovingObject.TYPE_OTHER, like="other"),
    **{name: OsiKind(name, False, number, like="other") for name, number in _STATIC.items()},
}
"""By name; the last five never move."""


def kind_from_name(name: str) -> OsiKind | None:
    """The kind that a name of a source means, by the table of class names; None: it says nothing. Of the kinds of a
    class that whose own name is in it: a `SEMITRACTOR` is a tractor, a `traffic_cone` a cone.
    """
    if name in KINDS:
        return KINDS[name]
    if (class_name := class_from_name(name)) is None:
        return None
    within, moves = name.lower().replace("_", " "), not stands(name)
    alike = [kind for kind in KINDS.values() if kind.moving == moves and kind.name in within]
    default = KINDS[class_name if moves else "static"]
    return next((kind for kind in alike if not moves or kind.class_name == class_name), default)


# Rotations as matrices, (…, 3, 3), and the yaw of one.


def rotation_from_quaternion(w: Float, x: Float, y: Float, z: Float) -> Float:
    """Rotation matrices (N, 3, 3) of quaternions, (N,) each, of any length but 0 and more than 1e154 (then NaN)."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        length = np.sqrt(w * w + x * x + y * y + z * z)
        w, x, y, z = np.array([w, x, y, z], dtype=np.float64) / np.where(np.isinf(length), np.nan, length)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrices: Float = np.moveaxis(np.array(rows), -1, 0)
    return matrices


def rotation_from_euler(roll: float, pitch: float, yaw: float) -> Float:
    """Rotation matrix (3, 3): first roll about x, then pitch about y, then yaw about z, all axes fixed."""
    half = np.array([roll, pitch, yaw]) / 2
    (cr, cp, cy), (sr, sp, sy) = np.cos(half), np.sin(half)
    w, x = cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy
    y, z = cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy
    matrix: Float = rotation_from_quaternion(*(np.array([v]) for v in (w, x, y, z)))[0]
    return matrix


def wrap_yaw(yaw_rad: float) -> float:
    """The angle of this direction in [−π, π]; NaN of a number that is none."""
    return math.remainder(yaw_rad, math.tau) if abs(yaw_rad) <= MOST_RAD else math.nan


# Numbers, times and ids from texts. Errors name the place.

LARGEST_M: Final = 1e8  # places and sizes beyond it are none
LAST_SECOND: Final = 4_000_000_000  # Unix time of 2096; reading takes no later stamp (`LAST_NS`)
_LARGEST_ID: Final = 2**63 - 1  # OSI ids have 64 bits, which many readers keep in a signed integer


def parse_number(text: object, where: str) -> float:
    """Return a finite number. Raises InputError, `where: expected a number, found …`."""
    if not math.isfinite(value := _parse_float(text, where)):
        raise InputError(f"{where}: expected a number, found {quote_value(text)}")
    return value


def parse_number_or_none(text: object, where: str) -> float:
    """Return a number of an object's state, NaN where it is none: the state is left out or completed, and counted.
    Raises InputError: a text that is none.
    """
    return value if abs(value := _parse_float(text, where)) <= LARGEST_M else math.nan


def _parse_float(text: object, where: str) -> float:
    try:
        if isinstance(text, str | int | float) and not isinstance(text, bool):
            return float(text)
    except (ValueError, OverflowError):
        pass
    raise InputError(f"{where}: expected a number, found {quote_value(text)}")


def parse_positive(text: object, where: str) -> float:
    """Return a finite number above 0. Raises InputError."""
    if (value := parse_number(text, where)) <= 0.0:
        raise InputError(f"{where}: expected a number above 0, found {quote_value(text)}")
    return value


def parse_vector(values: object, count: int, where: str) -> Float:
    """Return the numbers (count,) of a list, of `LARGEST_M` at most. Raises InputError."""
    if not isinstance(values, list) or len(values) != count:
        raise InputError(f"{where}: expected {count} numbers, found {quote_value(values)}")
    return check_size(np.array([parse_number(value, where) for value in values]), where)


def check_size(values: Float, where: str) -> Float:
    """Return the values. Raises InputError where one is beyond `LARGEST_M`."""
    if (largest := np.abs(values).max()) > LARGEST_M:
        raise InputError(f"{where}: expected numbers of at most {LARGEST_M:g}, found {largest:g}")
    return values


def parse_seconds_as_ns(text: object, where: str, *, times: Decimal = Decimal(1)) -> int:
    """Return nanoseconds of seconds, exactly as they are written; `times` is what they count. Raises InputError."""
    try:
        seconds = Decimal(str(text)) * times if not isinstance(text, bool) else Decimal("nan")
    except ArithmeticError:  # no number, or one whose exponent no decimal has
        seconds = Decimal("nan")
    if not seconds.is_finite() or not 0 <= seconds <= LAST_SECOND:
        raise InputError(f"{where}: expected a time of 0 to {LAST_SECOND} s, found {quote_value(text)}")
    return round(seconds * 1_000_000_000)


def number_names(names: Iterable[str]) -> dict[str, int]:
    """Return the OSI id of each name: the name itself where all are whole numbers, else 1, 2, … as they come."""
    unique = list(dict.fromkeys(names))
    if all(name.isascii() and name.isdecimal() and len(name) < 20 and str(int(name)) == name for name in unique):
        kept = {name: int(name) for name in unique}
        if all(ident <= _LARGEST_ID for ident in kept.values()):
            return kept
    return {name: k for k, name in enumerate(unique, start=1)}


def sign_files(paths: Iterable[Path]) -> tuple[tuple[str, int, int], ...]:
    """Names, sizes and times of files: what is kept of them for the next recording holds as long as these are equal."""
    stats = [(path, path.stat()) for path in sorted(paths) if path.is_file()]
    return tuple((str(path.absolute()), stat.st_size, stat.st_mtime_ns) for path, stat in stats)


# A recording of osi3.GroundTruth from boxes: the last step of every converter.

TOPIC: Final = "ground_truth"


@dataclass(frozen=True)
class Box:
    """One object at one instant, in the world frame of the source."""

    id: int
    kind: OsiKind
    at_m: tuple[float, float, float]  # centre of the box
    yaw_rad: float  # counter-clockwise from +x
    size_m: tuple[float, float, float]  # length, width, height
    velocity_mps: tuple[float, float] | None = None  # None: the source states none
    rear_axle_m: tuple[float, float, float] | None = None  # from the centre, in the frame of the box


@dataclass(frozen=True)
class ConvertedFrame:
    """All boxes of one instant."""

    stamp_ns: int
    boxes: list[Box]
    host: int | None = None
    lines: Sequence[Float] = ()  # (K, 3) each: borders of lanes, in the first frame alone
    site: SiteMap | None = None  # lanes and crosswalks, in the first frame alone
    place: SaidPlace | None = None  # where its metres are on earth, in the first frame alone


@dataclass
class ConversionReport:
    """What was skipped, assumed or corrected in a conversion, and the names of the objects in the source.

    `classes`: kinds by names of the source, beside those that are known.
    """

    classes: Mapping[str, str] = field(default_factory=dict)
    counts: Counter[tuple[str, str]] = field(default_factory=Counter)
    assumed: dict[str, None] = field(default_factory=dict)  # a line each, in order
    names: dict[int, str] = field(default_factory=dict)  # by OSI id
    frames: int = 0
    objects: Counter[str] = field(default_factory=Counter)  # per kind
    seen: set[tuple[bool, int]] = field(default_factory=set)

    def count(self, noun: str, what: str, number: int = 1) -> None:
        """Count states to be noted as `number noun what`."""
        if number:
            self.counts[noun, what] += number

    def find_kind(self, name: str, noun: str = "object state", otherwise: str = "other") -> OsiKind:
        """The kind that a name of the source means; one that says nothing is counted, and `otherwise`."""
        kind = KINDS[self.classes[name]] if name in self.classes else kind_from_name(name)
        if kind is None:
            said = f"taken as {otherwise}; --class '{name}=car' says what it is" if name else f"taken as {otherwise}"
            self.count(noun, f"of the class name {quote_value(name)}, which says nothing: {said}")
        return kind or KINDS[otherwise]

    def assume(self, line: str) -> None:
        """Add a note on an assumption, once."""
        self.assumed[line] = None

    def lines(self) -> list[str]:
        """All notes."""
        return [*self.assumed, *(f"{count_noun(number, noun)} {what}" for (noun, what), number in self.counts.items())]


def write_recording(
    path: Path, frames: Iterable[ConvertedFrame], report: ConversionReport, *, source: Path, format_name: str
) -> None:
    """Write the recording, complete or not at all. Raises InputError: no object, or times not in order."""
    record: dict[str, str] = {}
    trace = OsiTrace(
        description=f"{source.name}, converted from {format_name}",
        topics={TOPIC: "osi3.GroundTruth: all objects of the source"},
        messages=_encode_messages(frames, report, source, format_name, record),
        source=f"{format_name}: {source.name} (copem-replay convert)",
        records={CONVERSION: record},
    )
    write_osi_trace(trace, path)


def _encode_messages(
    frames: Iterable[ConvertedFrame], report: ConversionReport, source: Path, format_name: str, record: dict[str, str]
) -> Iterator[tuple[str, GroundTruth]]:
    """Topic and message of each frame; `record` is filled after the last, as only then all names are known."""
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
        yield TOPIC, _encode_message(frame, report)
    if not report.seen:
        skipped = "".join(f"; {line}" for line in report.lines())
        raise InputError(f"{source}: no object to convert in {count_noun(report.frames, 'frame')}{skipped}")
    ids = {str(ident): name for ident, name in sorted(report.names.items())}
    notes = json.dumps(report.lines(), ensure_ascii=False)
    record |= {"format": format_name, "ids": json.dumps(ids, ensure_ascii=False), "notes": notes}


def _encode_message(frame: ConvertedFrame, report: ConversionReport) -> GroundTruth:
    """The message of a frame: place on earth, road, and its boxes; those with no number are left out, counted."""
    osi = empty_ground_truth(frame.stamp_ns, frame.host)
    if frame.place is not None:
        osi.proj_string, offset = frame.place.proj, osi.proj_frame_offset
        offset.position.x, offset.position.y = frame.place.offset_m
        offset.yaw = frame.place.yaw_rad
    add_road(osi, frame.lines, frame.site or SiteMap())
    for box in frame.boxes:
        if not all(abs(value) <= FARTHEST_M for value in (*box.at_m, box.yaw_rad)):
            report.count("object state", "with a number that is none: skipped")
            continue
        if (key := (box.kind.moving, box.id)) not in report.seen:
            report.seen.add(key)
            report.objects[box.kind.name] += 1
        _add_box(osi, box, _complete_size(box, report))
    return osi


def _complete_size(box: Box, report: ConversionReport) -> tuple[float, float, float]:
    """Length, width, height, by the rules of all that is read: typical of the class where none is said."""
    if all(0.0 < size <= LONGEST_M for size in box.size_m):
        return box.size_m
    findings = list[str]()
    values = np.array([[0.0] * LENGTH + [*box.size_m]])
    values = complete_sizes(values, np.array([CLASSES.index(box.kind.like)]), None, findings)
    for finding in map(as_finding, findings):
        report.count("object state", RULES[finding.rule].words)
    length, width, height = values[0, LENGTH:].tolist()
    return length, width, height


def _add_box(osi: Any, box: Box, size_m: tuple[float, float, float]) -> None:
    """Add a box to a message as a moving or stationary object of `size_m`."""
    osi_object = (osi.moving_object if box.kind.moving else osi.stationary_object).add()
    osi_object.id.value = box.id
    base = osi_object.base
    base.dimension.length, base.dimension.width, base.dimension.height = size_m
    base.position.x, base.position.y, base.position.z = box.at_m
    base.orientation.roll, base.orientation.pitch, base.orientation.yaw = 0.0, 0.0, box.yaw_rad
    if not box.kind.moving:
        osi_object.classification.type = box.kind.type
        return
    osi_object.type = box.kind.type
    if box.kind.vehicle is not None:
        osi_object.vehicle_classification.type = box.kind.vehicle
    if box.velocity_mps is not None and all(map(math.isfinite, box.velocity_mps)):
        base.velocity.x, base.velocity.y, base.velocity.z = *box.velocity_mps, 0.0
    if box.rear_axle_m is not None:
        rear = osi_object.vehicle_attributes.bbcenter_to_rear
        rear.x, rear.y, rear.z = box.rear_axle_m


# Conversion of one source, or of many.

FORMATS: Final[Mapping[str, str]] = {
    "argoverse2": "argoverse2",
    "nuscenes": "nuscenes",
    "opv2v": "opv2v",
    "v2xseq": "v2xseq",
    "openlabel": "openlabel",
    "commonroad": "commonroad",
    "sumo": "sumo",
    "csv": "csv_rows",
}
"""Module of this folder by the name of the format."""
_MOST_LINES: Final = 10
"""Lines of one kind in a summary, at most: a data set has thousands of scenarios."""


@dataclass(frozen=True)
class PlannedRecording:
    """What a recording is made of: a file or folder, and which part of it, as options of the format's `frames`."""

    source: Path
    options: Mapping[str, Any] = field(default_factory=dict)


def convert_source(
    source: Path,
    out: Path,
    *,
    format: str,
    options: Mapping[str, Any] | None = None,
    classes: Mapping[str, str] | None = None,
) -> ConversionReport:
    """Convert one recording to the file `out`.

    `options`: keyword arguments of the format's `frames`. `classes`: kinds by names of the source, beside those that
    are known. Raises InputError: unknown format, or a source that cannot be converted; OutputError.
    """
    frames: Callable[..., Iterator[ConvertedFrame]] = _import_format(format).frames
    report = ConversionReport(classes or {})
    write_recording(out, frames(source, report, **(options or {})), report, source=source, format_name=format)
    return report


def _import_format(format: str) -> Any:
    """The module of a format. Raises InputError."""
    if format not in FORMATS:
        raise InputError(unknown_name_message("format", format, FORMATS))
    return import_module(f"copem_replay.extras.convert.{FORMATS[format]}")


def plan_outputs(
    source: Path, out: Path, *, format: str, overwrite: bool = False, only: str | None = None
) -> dict[Path, PlannedRecording]:
    """What each recording to write is made of: one, or one for each that the format's `list_recordings` finds.

    `only`: one of these. Raises InputError: the source does not exist or has no recording, or an output exists already;
    OutputError: one may not be written.
    """
    if not source.exists():
        raise InputError(f"{source}: no such file or folder")
    planned: dict[str, PlannedRecording] | None = None
    if (listing := getattr(_import_format(format), "list_recordings", None)) is not None:
        planned = listing(source)
    if only is not None and planned is not None:
        if only not in planned:
            raise InputError(f"--only: {unknown_name_message('recording', only, planned)}")
        planned = {only: planned[only]}
    if planned is None or (only is not None and out.suffix == ".mcap"):
        if out.suffix != ".mcap":
            raise InputError(f"{out}: expected an output that ends in .mcap, found {out.name!r}")
        outputs = {out: next(iter(planned.values())) if planned else PlannedRecording(source)}
    else:
        if out.suffix == ".mcap" or out.is_file():
            raise InputError(f"{out}: expected a folder for the recordings of one, found a file's name")
        outputs = {out / f"{name}.mcap": part for name, part in planned.items()}
    for path in outputs:
        check_outputs({"--out": path}, [source])
        check_output(path, is_converted)
    for folder in {path.parent for path in outputs}:
        if find_scratch_names(folder):  # of conversions that were killed
            for path in outputs:
                remove_leftovers(path, folder)
    existing = [path for path in outputs if path.is_file()]
    if existing and not overwrite:
        more = f", and {count_noun(len(existing) - 1, 'other')}" if len(existing) > 1 else ""
        raise InputError(f"{existing[0]}: is there already{more}; give another name, or --overwrite")
    return outputs


@dataclass
class Conversion:
    """The sums of notes and errors over all recordings of one command."""

    asked: int = 0  # recordings
    done: int = 0
    wrong: list[str] = field(default_factory=list)  # a line per problem
    notes: Counter[tuple[str, str]] = field(default_factory=Counter)  # (noun, what): how many
    assumed: Counter[str] = field(default_factory=Counter)  # line: recordings
    numbered: bool = False  # whether ids differ from the names in the source

    def add(self, report: ConversionReport) -> None:
        """Add the report of a recording that was written."""
        self.done += 1
        self.notes += report.counts
        self.assumed.update(list(report.assumed))
        self.numbered |= any(name != str(ident) for ident, name in report.names.items())

    def note_lines(self) -> list[str]:
        """A line for everything that was skipped, assumed or corrected."""
        many = self.asked > 1
        lines = [f"{line} ({count_noun(n, 'recording')})" if many else line for line, n in self.assumed.items()]
        if len(lines) > _MOST_LINES:
            more = len(lines) - _MOST_LINES
            lines[_MOST_LINES:] = [f"… and {more} more; the metadata record {CONVERSION} of each has all"]
        lines += [f"{count_noun(number, noun)} {what}" for (noun, what), number in self.notes.items()]
        if self.numbered:
            lines.append(f"objects are numbered; the file's metadata record {CONVERSION} has their names")
        return lines

    def problem_lines(self) -> list[str]:
        """A line for each error, and with many recordings one that counts those not written."""
        lines = self.wrong[:_MOST_LINES]
        if len(self.wrong) > _MOST_LINES:
            lines.append(f"… and {len(self.wrong) - _MOST_LINES} more")
        if self.wrong and self.asked > 1:
            lines.append(f"{self.asked - self.done} of {count_noun(self.asked, 'scenario')} not converted")
        return lines


def convert_all(
    outputs: Mapping[Path, PlannedRecording],
    conversion: Conversion,
    *,
    format: str,
    options: Mapping[str, Any] | None = None,
    classes: Mapping[str, str] | None = None,
) -> Iterator[str]:
    """Convert every source of `outputs` to its output and yield a line per recording, as soon as it is written.

    `conversion` takes up the notes, and the problems of sources that cannot be converted; the others are converted
    all the same. Nothing further is tried once an output cannot be written.
    """
    conversion.asked = len(outputs)
    for output, planned in outputs.items():
        try:
            given = {**(options or {}), **planned.options}
            report = convert_source(planned.source, output, format=format, options=given, classes=classes)
        except InputError as error:
            # Recordings of one folder may share what is wrong: it is said once.
            conversion.wrong += [line for line in error.problems if line not in conversion.wrong]
            continue
        except OutputError as error:
            conversion.wrong += error.problems
            break
        conversion.add(report)
        objects = ", ".join(f"{many} {name}" for name, many in sorted(report.objects.items()))
        yield f"{output}: {count_noun(report.frames, 'frame')}, {objects}"
