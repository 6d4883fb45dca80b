"""Results as GeoJSON (RFC 7946), for maps of cities: units, paths of measured objects, and what stands at the site.

Places are longitude and latitude of WGS84 with nine decimals; rings run against the clock. Only logs whose place on
earth is known are written.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from copem_replay.core.errors import InputError, RecordingError
from copem_replay.core.files import parse_json
from copem_replay.core.frame import Frame
from copem_replay.core.tracks import CLASSES, Float
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.experiment.schema import Experiment, Unit
from copem_replay.io.recording import Recording
from copem_replay.perception.sensor_poses import couple_outlines
from copem_replay.pipeline.expansion import give_views
from copem_replay.results.outputs import made_files
from copem_replay.results.read import Results, open_results

FILES: Final = ("units.geojson", "episodes.geojson", "site.geojson")
_DECIMALS: Final = 9
_EPISODE: Final = ["log", "object_id", "onset_s", "ended_s"]


def write_geojson(results: Results | Path, out: Path | None = None) -> tuple[list[Path], list[str]]:
    """Write the three files of a results folder; their paths, and notes on logs that are left out. `out`: a folder;
    None: `geojson` in the results folder. Raises InputError where no log has a place on earth.
    """
    results = results if isinstance(results, Results) else open_results(results)
    features: dict[str, list[dict[str, Any]]] = {name: [] for name in FILES}
    notes, licences = list[str](), dict[str, None]()
    names = [one.name for one in results.provenance.logs]
    for log in names:
        experiment = resolve_for_log(results.experiment, log)
        try:
            recording = results.recording(log, experiment)
        except RecordingError as error:
            notes.append(f"{log}: left out: {error}")
            continue
        frame = recording.scene.frame
        if frame is None:
            notes.append(f"{log}: left out: it is not known where it is on earth; write `frame: {{proj: …}}`")
            continue
        licences |= dict.fromkeys(note for note in recording.notes if "©" in note)
        features["units.geojson"] += _list_units(log, experiment, frame)
        features["episodes.geojson"] += _list_episodes(results, log, experiment, recording, frame)
        features["site.geojson"] += _list_site(log, experiment, recording, frame)
    if len(notes) == len(names):
        raise InputError("\n".join([f"{results.place}: no log can be placed on earth", *notes]).splitlines())
    folder = out or results.place / "geojson"
    files = [folder / name for name in FILES]
    with made_files(folder, FILES, results.place, is_own=_is_exported) as scratch:
        for name, of_file in features.items():
            text = {"type": "FeatureCollection", **({"licence": [*licences]} if licences else {}), "features": of_file}
            (scratch / name).write_text(json.dumps(text, ensure_ascii=False) + "\n", encoding="utf-8")
    return files, notes


def _is_exported(path: Path) -> bool:
    """Whether a file is an earlier export: every feature says its log, and what or which object it is."""
    with suppress(OSError, ValueError, KeyError, TypeError, AttributeError):
        said = [feature["properties"].keys() for feature in parse_json(path.read_bytes())["features"]]
        return all("log" in keys and keys & {"what", "object_id"} for keys in said)
    return False


def _make_feature(geometry: str, coordinates: Any, **properties: Any) -> dict[str, Any]:
    shown = {name: value for name, value in properties.items() if value is not None}
    return {"type": "Feature", "geometry": {"type": geometry, "coordinates": coordinates}, "properties": shown}


def _write_places(frame: Frame, at_m: Float) -> list[list[float]]:
    """Longitudes and latitudes of places of the log (K, 2)."""
    return [[round(float(lon), _DECIMALS), round(float(lat), _DECIMALS)] for lat, lon in frame.to_wgs84(at_m)]


def _write_ring(frame: Frame, corners_m: Any, *, hole: bool = False) -> list[list[float]]:
    """A closed ring, against the clock on earth; a hole with it."""
    ring = np.array(_write_places(frame, np.asarray(corners_m, dtype=np.float64)[:, :2]))
    after = np.roll(ring, -1, axis=0)
    with_clock = bool((ring[:, 0] * after[:, 1] - after[:, 0] * ring[:, 1]).sum() < 0)
    places: list[list[float]] = (ring if with_clock == hole else ring[::-1]).tolist()
    return [*places, places[0]]


def _list_units(log: str, experiment: Experiment, frame: Frame) -> Iterator[dict[str, Any]]:
    """A point for each unit that stands, and a polygon for each field of view of its PEM."""
    experiment = give_views(experiment)
    for name, unit in experiment.units.items():
        if unit.at is None:
            continue
        lat, lon = frame.to_wgs84(unit.at)[0]
        heading = round(frame.heading_of_yaw(unit.yaw_deg, lat, lon), 6)
        properties = {"log": log, "unit": name, "pem": unit.pem}
        place = _write_places(frame, np.array([unit.at]))[0]
        yield _make_feature(
            "Point", place, **properties, what="unit", height_m=unit.height_m, heading_deg_from_true_north=heading
        )
        for field_m in _place_fields(experiment, unit):
            yield _make_feature("Polygon", [_write_ring(frame, field_m)], **properties, what="field of view")


def _place_fields(experiment: Experiment, unit: Unit) -> Iterator[Float]:
    """Outlines (K, 2) in metres of the log of the fields in which couples of a unit's PEM apply."""
    if unit.pem is None or unit.at is None:
        return
    yaw = np.deg2rad(unit.yaw_deg)
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    for border in couple_outlines(experiment.pems[unit.pem].couples):
        yield (border + np.array(unit.offset_m)) @ turn.T + np.array(unit.at)


def _list_episodes(
    results: Results, log: str, experiment: Experiment, recording: Recording, frame: Frame
) -> Iterator[dict[str, Any]]:
    """The path of each measured object from its onset to the end of its episode, and when each configuration knows."""
    truth, scene = recording.truth, recording.scene
    rows = results.known
    for (_, object_id, onset_s, ended_s), episode in rows[rows["log"] == log].groupby(_EPISODE, sort=False):
        k = scene.object_number[str(object_id)]
        time_s = truth.row_captured_s
        of_object = np.flatnonzero((truth.row_object_ix == k) & truth.valid[0])
        episode_rows = of_object[(time_s[of_object] >= onset_s - 1e-9) & (time_s[of_object] <= ended_s + 1e-9)]
        gaps = np.flatnonzero(np.diff(time_s[episode_rows]) > experiment.max_gap_s) + 1
        at_m = np.stack([truth.x_m[0, episode_rows], truth.y_m[0, episode_rows]], axis=1)
        pieces = [_write_places(frame, piece) for piece in np.split(at_m, gaps) if len(piece) > 1]
        if not pieces:
            continue
        yield _make_feature(
            "LineString" if len(pieces) == 1 else "MultiLineString",
            pieces[0] if len(pieces) == 1 else pieces,
            log=log,
            object_id=str(object_id),
            object_class=CLASSES[scene.object_class[k]],
            onset_s=float(onset_s),
            ended_s=float(ended_s),
            **_describe_knowledge(episode),
        )


def _describe_knowledge(episode: pd.DataFrame) -> dict[str, float | None]:
    """By configuration: the share of runs that detect the object; of these the mean time and distance."""
    shares: dict[str, float | None] = {}
    for name, rows in episode.groupby("configuration", sort=False):
        runs, time_s = rows["runs"].to_numpy(), rows["time_to_detection_s"].to_numpy()
        detected = np.isfinite(time_s)
        shares[f"detected_share {name}"] = round(float(runs[detected].sum() / runs.sum()), 6)
        for key, column in (("ttd_s", "time_to_detection_s"), ("dad_m", "distance_at_detection_m")):
            mean = np.average(rows[column].to_numpy()[detected], weights=runs[detected]) if detected.any() else None
            shares[f"{key} {name}"] = None if mean is None or not np.isfinite(mean) else round(float(mean), 6)
    return shares


def _list_site(log: str, experiment: Experiment, recording: Recording, frame: Frame) -> Iterator[dict[str, Any]]:
    """Features of the site: borders of lanes, areas, and outlines of what hides."""
    for line in recording.lane_boundaries:
        yield _make_feature("LineString", _write_places(frame, line[:, :2]), log=log, what="lane boundary")
    for area in recording.scene.areas:
        rings = _write_rings(frame, area.rings_m)
        yield _make_feature("Polygon", rings, log=log, what="area", name=area.name, kind=area.kind)
    for solid in recording.scene.solids:
        rings = _write_rings(frame, (solid.corners_m, *solid.holes_m))
        heights = {"bottom_m": solid.bottom_m, "height_m": solid.height_m}
        yield _make_feature("Polygon", rings, log=log, what="solid", name=solid.name, **heights)
    for k, obstacle in enumerate(experiment.obstacles):
        rings, name = [_write_ring(frame, obstacle.polygon_m)], f"obstacles[{k}]"
        yield _make_feature("Polygon", rings, log=log, what="obstacle", name=name, height_m=obstacle.height_m)


def _write_rings(frame: Frame, rings_m: Sequence[Any]) -> list[list[list[float]]]:
    return [_write_ring(frame, ring, hole=k > 0) for k, ring in enumerate(rings_m)]
