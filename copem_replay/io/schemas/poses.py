"""Poses over time: odometry, stamped poses, and transforms between frames of reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from copem_replay.core.tracks import Float, Int
from copem_replay.io.channel import Channel, schema_name
from copem_replay.io.encodings.columns import level_of, take_apart
from copem_replay.io.encodings.definition import definition_of
from copem_replay.io.schemas.pose_schemas import POSES
from copem_replay.io.schemas.timestamps import stamps_in

_FARTHEST_M = 1e9  # a coordinate beyond is no position (chosen: far more than the earth is wide)


@dataclass(frozen=True)
class Poses:
    """K poses in the order of the messages: of `child` ("": not said) in `frame`."""

    stamp_ns: Int
    position_m: Float  # (K, 3)
    rotation: Float  # (K, 4) unit quaternions x, y, z, w
    velocity_mps: Float  # (K, 2) ahead and to the left, NaN: not said
    frame: tuple[str, ...]
    child: tuple[str, ...]


def poses_of(channel: Channel, payloads: Sequence[bytes], log_time_ns: Int) -> Poses:
    """The poses of a channel; what is no number, rotation or place is left out. Raises DefinitionError, KeyError."""
    where = POSES[schema_name(channel)]
    definition = definition_of(channel, payloads)
    p = where.inside
    numbers = [f"{p}{where.position}.{axis}" for axis in "xyz"] + [f"{p}{where.rotation}.{axis}" for axis in "xyzw"]
    if where.velocity is not None:
        numbers += [f"{p}{where.velocity}.{axis}" for axis in "xy"]
    names = [f"{p}{where.frame}"] + ([f"{p}{where.child}"] if where.child else [])
    stamps = stamps_in(definition.offers(), f"{p}{where.stamp}")
    found = take_apart(definition, payloads, numbers, [*names, *stamps])
    level = found.levels[level_of(numbers[0])]
    message = level.parent if where.inside else np.arange(len(level.parent))
    message = found.levels[""].parent[message]
    columns = np.stack([level.numbers[n] for n in numbers], axis=1)
    texts = [np.array([*level.texts[n].words, ""], dtype=object)[level.texts[n].code] for n in names]
    parts = [level.texts[s] for s in stamps]
    seconds = [np.array([*(_whole(w) for w in part.words), 0], dtype=np.int64)[part.code] for part in parts]
    said = len(seconds) == 2
    stamp_ns = seconds[0] * 1_000_000_000 + seconds[1] - channel.ahead_ns if said else log_time_ns[message]
    with np.errstate(invalid="ignore", over="ignore"):
        length = np.linalg.norm(columns[:, 3:7], axis=1)
        near = (np.abs(columns[:, :3]) <= _FARTHEST_M).all(axis=1)
    good = np.isfinite(columns[:, :7]).all(axis=1) & near & (length > 0.5) & (length < 2.0)
    velocity = columns[:, 7:9] if where.velocity is not None else np.full((len(columns), 2), np.nan)
    return Poses(
        stamp_ns[good],
        columns[good, :3],
        columns[good, 3:7] / length[good, None],
        velocity[good],
        tuple(texts[0][good]),
        tuple(texts[1][good]) if where.child else ("",) * int(good.sum()),
    )


def _whole(word: str) -> int:
    try:
        number = int(word)
    except ValueError:
        return 0
    return number if abs(number) < 4_000_000_000 else 0
