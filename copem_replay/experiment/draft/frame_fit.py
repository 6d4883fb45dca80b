"""The frame fitted to satellite fixes in a recording: turn and offset of the recording's metres.

A recording with odometry of its own and fixes beside it does not say where it is; both together do. The fit is printed
by `info` with the key to copy, and never applied.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from copem_replay.core.errors import RecordingError
from copem_replay.core.frame import Frame, make_local_proj
from copem_replay.core.tracks import Float, Int
from copem_replay.io.channel import ENCODINGS, LAST_NS, Channel, DefinitionError, schema_name
from copem_replay.io.encodings import make_definition
from copem_replay.io.encodings.columns import list_level, shred_messages
from copem_replay.io.log import Log, gather_messages
from copem_replay.io.recording import Recording


class FixFields(NamedTuple):
    """The fields of a schema of places on earth; `status`: below 0 there is no fix."""

    stamp: str
    place: str = ""
    status: str = ""


_ROS_FIX = FixFields("header.stamp", status="status.status")
FIXES: Final = {
    "sensor_msgs/msg/NavSatFix": _ROS_FIX,
    "geographic_msgs/msg/GeoPoseStamped": FixFields("header.stamp", "pose.position."),
    "foxglove.LocationFix": FixFields("timestamp"),
    "foxglove_msgs/msg/LocationFix": FixFields("timestamp"),
}
"""By schema. Sources: the definitions of sensor_msgs, geographic_msgs and Foxglove."""
_LEAST_WAY_M: Final = 20.0
"""Over a shorter way the turn is not determined: an error of 1 m at its ends is 3°."""
_NEAR_NS: Final = 500_000_000
"""Between states of the ego that are farther apart no fix is placed."""
_SIGMAS: Final = 1.96


@dataclass(frozen=True)
class Fixes:
    """K places on earth, latitude and longitude in degrees (K, 2), in order of time."""

    topic: str
    stamp_ns: Int
    places: Float


@dataclass(frozen=True)
class FrameFit:
    """A frame fitted to K fixes; `residual_m` is the root of the mean square, `turn_deg` half of the 95 % interval of
    the turn, infinite where the way is too short.
    """

    topic: str
    origin: tuple[float, float]
    frame: Frame
    fixes: int
    residual_m: float
    way_m: float
    turn_deg: float

    @property
    def words(self) -> str:
        """The fit in one line, with the key to copy."""
        line = f"{self.fixes:,} fixes of {self.topic}, over {self.way_m:,.0f} m that the ego gets around"
        if not math.isfinite(self.turn_deg):
            return f"{line}: turn not determined, expected {_LEAST_WAY_M:g} m or more"
        (lat, lon), (east_m, north_m) = self.origin, self.frame.offset_m
        key = f"frame: {{proj: {{at_wgs84: [{lat:.7f}, {lon:.7f}]}}, offset_m: [{east_m:.2f}, {north_m:.2f}]"
        key += f", yaw_deg: {math.degrees(self.frame.yaw_rad):.3f}}}"
        return f"{line} fit `{key}`: residual {self.residual_m:.2f} m, turn ± {self.turn_deg:.2g}° (95 %); not applied"


def fit_fixes(log: Log, recording: Recording) -> Iterator[FrameFit]:
    """The fit of each topic of fixes to the way of the ego; none without an ego, or fixes while it is there."""
    scene, truth = recording.scene, recording.truth
    rows = np.flatnonzero((truth.row_object_ix == scene.ego_ix) & truth.valid[0])
    if scene.ego_ix < 0 or len(rows) < 2:
        return
    stamp_ns = scene.t0_ns + np.rint(truth.row_captured_s[rows] * 1e9).astype(np.int64)
    way_m = np.stack([truth.x_m[0, rows], truth.y_m[0, rows]], axis=1)
    for fixes in _read_fixes(log):
        after = np.searchsorted(stamp_ns, fixes.stamp_ns).clip(1, len(stamp_ns) - 1)
        covered = (fixes.stamp_ns >= stamp_ns[0]) & (fixes.stamp_ns <= stamp_ns[-1])
        covered &= stamp_ns[after] - stamp_ns[after - 1] <= _NEAR_NS
        at_s, known_s = ((ns - stamp_ns[0]) * 1e-9 for ns in (fixes.stamp_ns[covered], stamp_ns))
        at_m = np.stack([np.interp(at_s, known_s, way_m[:, k]) for k in (0, 1)], axis=1)
        if len(at_m) > 1:
            yield fit_frame(fixes.topic, fixes.places[covered], at_m)


def fit_frame(topic: str, places: Float, at_m: Float) -> FrameFit:
    """Turn and offset that bring places of a log (K, 2) in metres nearest to fixes (K, 2), by least squares.

    In the transverse Mercator projection with the first fix as its origin.
    """
    lat, lon = (float(value) for value in places[0])
    proj = make_local_proj(round(lat, 7), round(lon, 7))
    target_m = Frame(proj).from_wgs84(places)
    (a, b), (p, q) = (at_m.mean(axis=0), target_m.mean(axis=0)), (at_m - at_m.mean(axis=0), target_m)
    q = q - b
    yaw_rad = math.atan2(float((p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum()), float((p * q).sum()))
    moved = Frame(proj, yaw_rad=yaw_rad)
    offset_m = b - moved.project([a])[0]
    frame = Frame(proj, (float(offset_m[0]), float(offset_m[1])), yaw_rad)
    off_m = frame.project(at_m) - target_m
    residual_m = math.sqrt(float((off_m**2).sum(axis=1).mean()))
    way_m = float(np.hypot(*np.ptp(at_m, axis=0)))
    spread_m2 = float((p**2).sum())
    turn_deg = math.inf
    if way_m >= _LEAST_WAY_M:
        sigma_m = math.sqrt(float((off_m**2).sum()) / max(2 * len(off_m) - 3, 1))
        turn_deg = math.degrees(_SIGMAS * sigma_m / math.sqrt(spread_m2))
    return FrameFit(topic, (round(lat, 7), round(lon, 7)), frame, len(at_m), residual_m, way_m, turn_deg)


def _read_fixes(log: Log) -> Iterator[Fixes]:
    for channel in log.channels:
        if schema_name(channel) not in FIXES or channel.encoding not in ENCODINGS or not channel.messages:
            continue
        try:
            messages = gather_messages(log, frozenset([channel.number]))
            times = np.array(messages.log_time_ns[channel.number], dtype=np.int64)
            yield decode_fixes(channel, messages.payloads[channel.number], times)
        except (DefinitionError, KeyError, RecordingError):
            continue  # `info` lists the topic; that its messages are none is not what is asked here


def decode_fixes(channel: Channel, payloads: Sequence[bytes], log_time_ns: Int) -> Fixes:
    """The fixes of a channel, without those that are none or at 0° N 0° E. Raises DefinitionError, KeyError."""
    from copem_replay.io.stamps import find_stamp_paths, parse_nanoseconds

    where, definition = FIXES[schema_name(channel)], make_definition(channel, payloads)
    numbers = [f"{where.place}latitude", f"{where.place}longitude", *([where.status] if where.status else [])]
    stamps = find_stamp_paths(definition.offers(), where.stamp)
    shredded = shred_messages(definition, payloads, numbers, stamps)
    level = shredded.levels[list_level(numbers[0])]
    stamp_ns = log_time_ns[level.parent]
    if stamps:
        parsed_ns, is_time, _ = parse_nanoseconds([level.texts[name] for name in stamps], "ns")
        stamp_ns = np.where(is_time & (parsed_ns > 0) & (parsed_ns < LAST_NS), parsed_ns - channel.ahead_ns, stamp_ns)
    places = np.stack([level.numbers[name] for name in numbers[:2]], axis=1)
    with np.errstate(invalid="ignore"):
        good = (np.abs(places) <= (84.0, 180.0)).all(axis=1) & (places != 0.0).any(axis=1)
        good &= ~(level.numbers[where.status] < 0) if where.status else True
    order = np.argsort(stamp_ns[good], kind="stable")
    return Fixes(channel.topic, stamp_ns[good][order], places[good][order])
