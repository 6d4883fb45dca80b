"""Lists of a unit in any format but OSI's, as they were recorded: captured and arriving at their stamps."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from copem_replay import container
from copem_replay.formats.fields import Listed
from copem_replay.lists import RecordedLists, as_tracks
from copem_replay.topics import Surroundings, in_world, known_lists, lists_of, surroundings
from copem_replay.tracks import UNCERTAINTIES, Scene


@np.errstate(over="ignore", invalid="ignore")
def read_listed(path: Path, topic: str, scene: Scene, around: Surroundings | None) -> RecordedLists | None:
    """The lists on `topic`, in the world of the truth; None: none of a known format is there. Raises RecordingError."""
    log = container.open_log(path)
    try:
        return _read(log, topic, scene, around)
    except container.BrokenIndexError as error:
        return _read(log.from_start(error), topic, scene, around)


def _read(log: container.Log, topic: str, scene: Scene, around: Surroundings | None) -> RecordedLists | None:
    channels = [c for c in known_lists(log) if c.topic == topic]
    if not channels:
        return None
    mine = [c for c in channels if c.schema == channels[0].schema]
    around = around or surroundings(log, None, seek_ego=False)
    return _recorded(in_world(lists_of(log, mine, None), around, f"{log.path}: {topic}"), topic, scene)


def _recorded(found: Listed, topic: str, scene: Scene) -> RecordedLists:
    columns = found.columns
    by_time = np.argsort(columns.stamp_ns, kind="stable")
    place = np.empty_like(by_time)
    place[by_time] = np.arange(len(by_time))
    frame = place[np.repeat(np.arange(len(columns.rows)), columns.rows)]
    placed = np.isfinite(columns.values[:, :2]).all(axis=1)
    order = np.flatnonzero(placed)[np.argsort(frame[placed], kind="stable")]
    covariance = found.covariance_m2[order]
    said = np.isfinite(covariance).all(axis=1) & (covariance[:, 0] > 0) & (covariance[:, 2] > 0)
    variances = np.zeros((len(order), len(UNCERTAINTIES)))
    variances[:, :3] = np.where(said[:, None], covariance, 0.0)
    stamps = columns.stamp_ns[by_time]
    tracks = as_tracks(
        topic,
        scene,
        np.stack([stamps, stamps], axis=1),
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
        np.zeros(len(stamps), dtype=bool),
        int((~placed).sum()),
    )
