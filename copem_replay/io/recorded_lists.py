"""Lists of a unit in any format but OSI's, as they were recorded: captured and arriving at their stamps.

What this project wrote beside its own lists (`…/detail`) says when they were captured, and what they have no fields
for.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from copem_replay.core.errors import RecordingError
from copem_replay.core.tracks import UNCERTAINTIES, VALUES, Bool, Float, Int, Scene
from copem_replay.io.channel import schema_name
from copem_replay.io.encodings.columns import take_apart
from copem_replay.io.encodings.definition import definition_of
from copem_replay.io.encodings.raw_values import DefinitionError
from copem_replay.io.log import BrokenIndexError, Log
from copem_replay.io.messages import gathered
from copem_replay.io.open import open_log
from copem_replay.io.recorded_osi import RecordedLists, as_tracks, in_time, read_recorded
from copem_replay.io.schemas.decoded import LAST_NS
from copem_replay.io.schemas.object_lists import DecodedLists
from copem_replay.io.schemas.registry import known_lists
from copem_replay.io.together import Local
from copem_replay.io.window import Window
from copem_replay.io.world_frame import LogContext, in_world, lists_of, log_context
from copem_replay.io.write.ros2_definitions import STRING


def lists_on(
    path: Local, topic: str, scene: Scene, around: LogContext | None, window: Window | None = None
) -> RecordedLists:
    """The lists on `topic` in whatever format, with what their messages say and nothing else. Raises RecordingError."""
    return read_listed(path, topic, scene, around, window) or read_recorded(path, topic, scene, window)


@np.errstate(over="ignore", invalid="ignore")
def read_listed(
    path: Local, topic: str, scene: Scene, around: LogContext | None, window: Window | None = None
) -> RecordedLists | None:
    """The lists on `topic`, in the world of the truth; None: none of a known format is there. Raises RecordingError."""
    log = open_log(path).within(window)
    try:
        return _read(log, topic, scene, around)
    except BrokenIndexError as error:
        return _read(log.from_start(error), topic, scene, around)


def _read(log: Log, topic: str, scene: Scene, around: LogContext | None) -> RecordedLists | None:
    channels = [c for c in known_lists(log.channels) if c.topic == topic]
    if not channels:
        return None
    mine = [c for c in channels if c.schema == channels[0].schema]
    if log.window is not None and next(log.payloads(frozenset(c.number for c in mine)), None) is None:
        raise RecordingError("holds no list in the window", path=log.path, topic=topic)
    around = around or log_context(log, None, seek_ego=False)
    found = in_world(lists_of(log, mine, None), around, log.path, topic)
    return _recorded(found, _details(log, topic), topic, scene)


def _details(log: Log, topic: str) -> dict[int, dict[str, Any]]:
    """What is beside the lists on a topic, by the time at which each was available."""
    beside = f"{topic.removesuffix('/objects')}/detail"
    channels = [c for c in log.channels if c.topic == beside and c.messages and schema_name(c) == STRING]
    found: dict[int, dict[str, Any]] = {}
    for channel in channels:
        payloads = gathered(log, frozenset({channel.number})).payloads[channel.number]
        try:
            said = take_apart(definition_of(channel, payloads), payloads, texts=["data"])
        except (DefinitionError, KeyError):  # some other String
            continue
        for word in said.levels[""].texts["data"].words:
            try:
                content = json.loads(word)
                found[int(content["available_ns"])] = {**content, "objects": list(content["objects"])}
            except (ValueError, TypeError, KeyError, RecursionError):  # not written by us
                continue
    return found


def _captured(stamps: Int, details: Mapping[int, Mapping[str, Any]]) -> tuple[Int, Bool]:
    """(F,) when lists available at `stamps` were captured, and whether that is said."""
    captured, known = stamps.copy(), np.zeros(len(stamps), dtype=bool)
    for k, stamp in enumerate(stamps.tolist()):
        said = details.get(stamp, {}).get("captured_ns")
        if isinstance(said, int) and abs(said) <= LAST_NS:
            captured[k], known[k] = said, True
    return captured, known


def _with_details(found: DecodedLists, details: Mapping[int, Mapping[str, Any]]) -> tuple[DecodedLists, Float]:
    """The lists with sizes and existence as they were stated, and (P, uncertainties) variances, NaN: not said."""
    columns = found.columns
    values, existence = columns.values.copy(), found.existence.copy()
    variances = np.full((len(values), len(UNCERTAINTIES)), np.nan)
    ends = np.cumsum(columns.rows)
    for stamp, number, end in zip(columns.stamp_ns.tolist(), columns.rows.tolist(), ends.tolist(), strict=True):
        items = details.get(stamp, {}).get("objects", ())
        if len(items) != number:  # objects without a place are left out
            continue
        for row, item in zip(range(end - number, end), items, strict=True):
            for name in ("length_m", "width_m"):
                values[row, VALUES.index(name)] = _number(item, name, values[row, VALUES.index(name)])
            existence[row] = _number(item, "existence", existence[row])
            variances[row] = [_number(item, name, np.nan) for name in UNCERTAINTIES]
    return replace(found, columns=replace(columns, values=values), existence=existence), variances


def _number(item: Any, name: str, otherwise: float) -> float:
    value = item.get(name) if isinstance(item, dict) else None
    return float(value) if isinstance(value, float) else otherwise


def _recorded(found: DecodedLists, details: Mapping[int, Mapping[str, Any]], topic: str, scene: Scene) -> RecordedLists:
    found, beside = _with_details(found, details)
    columns = found.columns
    by_time, frame = in_time(columns.stamp_ns, np.repeat(np.arange(len(columns.rows)), columns.rows))
    placed = np.isfinite(columns.values[:, :2]).all(axis=1)
    order = np.flatnonzero(placed)[np.argsort(frame[placed], kind="stable")]
    covariance = found.covariance_m2[order]
    said = np.isfinite(covariance).all(axis=1) & (covariance[:, 0] > 0) & (covariance[:, 2] > 0)
    variances = np.nan_to_num(beside[order])
    variances[:, :3] = np.where(said[:, None], covariance, 0.0)  # turned with its list
    stamps = columns.stamp_ns[by_time]
    captured, capture_said = _captured(stamps, details)
    tracks = as_tracks(
        topic,
        scene,
        np.stack([captured, stamps], axis=1),
        np.arange(len(order) + 1),
        np.full(len(order), -1),
        frame[order],
        np.nan_to_num(columns.values[order]),
        variances,
    )
    return RecordedLists(
        tracks,
        found.existence[order],
        found.probability[order],
        columns.object_ix[order] if found.named else np.full(len(order), -1),
        said,
        capture_said,
        columns.stamped[by_time],
        found.log_time_ns[by_time],
        int((~placed).sum()),
    )
