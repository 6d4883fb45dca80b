"""Degrees of the experiment as metres of a log.

What is written stays as it was written; a replay gets metres (`resolve_degrees`), as of an experiment that says metres.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final

from copem_replay.core.frame import Frame, distance_on_earth_m
from copem_replay.core.tracks import Float
from copem_replay.core.yaml import Key
from copem_replay.experiment.schema import Experiment

_FAR_M: Final = 50_000.0
"""Places of the experiment are nearer to the log: else latitude and longitude, or the frames, are mixed up."""


def uses_degrees(experiment: Experiment) -> bool:
    """Whether any place in an experiment, except in its maps, is in degrees."""
    return any(True for _ in _list_degrees(experiment))


def _list_degrees(experiment: Experiment) -> Iterator[tuple[Key, Any]]:
    """The key of everything that is given in degrees, and its places (latitude, longitude)."""
    for name, unit in experiment.units.items():
        if unit.at_wgs84 is not None:
            yield ("units", name, "at_wgs84"), [unit.at_wgs84[:2]]
    for k, obstacle in enumerate(experiment.obstacles):
        if obstacle.polygon_wgs84 is not None:
            yield ("obstacles", k, "polygon_wgs84"), obstacle.polygon_wgs84
    for name, area in experiment.areas.items():
        if area.polygon_wgs84 is not None:
            yield ("areas", name, "polygon_wgs84"), area.polygon_wgs84
    within, annotated = experiment.measure.objects.within, experiment.measure.annotated
    if within is not None and within.polygon_wgs84 is not None:
        yield ("measure", "objects", "within", "polygon_wgs84"), within.polygon_wgs84
    if annotated is not None and annotated.polygon_wgs84 is not None:
        yield ("measure", "annotated", "polygon_wgs84"), annotated.polygon_wgs84


def check_degrees(experiment: Experiment, frame: Frame | None, why: str, middle_m: Float) -> Iterator[tuple[Key, str]]:
    """Problems of places in degrees, by key: no frame, or too far from the log."""
    for key, places in _list_degrees(experiment):
        if frame is None:
            yield key, f"{why}; write `frame: {{proj: …}}`, or metres of the log"
            continue
        far_m = max(distance_on_earth_m(place, frame.to_wgs84(middle_m)[0]) for place in places)
        if far_m > _FAR_M:
            yield key, f"{far_m / 1000:,.0f} km from the log: latitude first, then longitude?"


def resolve_degrees(experiment: Experiment, frame: Frame | None) -> Experiment:
    """The experiment with metres of a log in place of degrees; itself where it has none, or the frame is not known."""
    if frame is None or not uses_degrees(experiment):
        return experiment

    def metres(places: Any) -> tuple[tuple[float, float], ...]:
        return tuple((float(x), float(y)) for x, y in frame.from_wgs84(places))

    def outlined(thing: Any) -> Any:
        if thing is None or thing.polygon_wgs84 is None:
            return thing
        return thing.model_copy(update={"polygon_m": metres(thing.polygon_wgs84), "polygon_wgs84": None})

    units = {name: _resolve_unit(unit, frame, metres) for name, unit in experiment.units.items()}
    measure = experiment.measure
    objects = measure.objects.model_copy(update={"within": outlined(measure.objects.within)})
    changed: Mapping[str, Any] = {
        "units": units,
        "obstacles": tuple(outlined(one) for one in experiment.obstacles),
        "areas": {name: outlined(area) for name, area in experiment.areas.items()},
        "measure": measure.model_copy(update={"objects": objects, "annotated": outlined(measure.annotated)}),
    }
    return experiment.model_copy(update=changed)


def _resolve_unit(unit: Any, frame: Frame, metres: Callable[[Any], tuple[tuple[float, float], ...]]) -> Any:
    if unit.at_wgs84 is None:
        return unit
    changed: dict[str, Any] = {"at_wgs84": None, "at": metres([unit.at_wgs84[:2]])[0]}
    if len(unit.at_wgs84) == 3:
        lat, lon, heading_deg = unit.at_wgs84
        changed["yaw_deg"] = frame.yaw_of_heading(heading_deg, lat, lon)
    return unit.model_copy(update=changed)
