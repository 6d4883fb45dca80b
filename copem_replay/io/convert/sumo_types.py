"""Sizes and kinds of SUMO's vehicle types, which its FCD output only names.

Defaults of the classes are SUMO's own (sumo.dlr.de, Vehicle Type Parameter Defaults; its source of 2025): the front
bumper was placed with these lengths, plausible or not.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from copem_replay.core.errors import InputError
from copem_replay.io.convert.kinds import KINDS, Kind
from copem_replay.io.convert.parse import positive
from copem_replay.io.convert.xml_nodes import Node, parts

_CLASSES: Final = {  # vClass: kind, length, width, height in m
    "passenger": ("car", 5.0, 1.8, 1.5),
    "pedestrian": ("pedestrian", 0.215, 0.478, 1.719),
    "wheelchair": ("wheelchair", 5.0, 0.8, 1.5),  # no length of its own in SUMO, nor has the scooter
    "bicycle": ("bicycle", 1.6, 0.65, 1.7),
    "scooter": ("scooter", 5.0, 0.5, 1.7),
    "moped": ("motorcycle", 2.1, 0.78, 1.7),
    "motorcycle": ("motorcycle", 2.2, 0.9, 1.5),
    "truck": ("truck", 7.1, 2.4, 2.4),
    "trailer": ("truck", 16.5, 2.55, 4.0),  # a truck with a trailer, one rigid box
    "bus": ("bus", 12.0, 2.5, 3.4),
    "coach": ("bus", 14.0, 2.6, 4.0),
    "delivery": ("van", 6.5, 2.16, 2.86),
    "emergency": ("van", 6.5, 2.16, 2.86),
    "tram": ("tram", 22.0, 2.4, 3.2),
    "rail_urban": ("train", 109.5, 3.0, 3.6),
    "subway": ("train", 109.5, 3.0, 3.6),
    "rail": ("train", 135.0, 2.84, 3.75),
    "rail_electric": ("train", 200.0, 2.95, 3.89),
    "rail_fast": ("train", 200.0, 2.95, 3.89),
    "ship": ("other", 17.0, 4.0, 4.0),
}
_LIKE_CARS: Final = ("private", "vip", "hov", "taxi", "evehicle", "custom1", "custom2", "ignoring", "authority", "army")


@dataclass(frozen=True)
class VehicleType:
    """What is known of a type."""

    kind: Kind
    size_m: tuple[float, float, float]  # length, width, height


def of_class(name: str) -> VehicleType | None:
    """Return the defaults of a vClass, None for one that is not known."""
    found = _CLASSES.get("passenger" if name in _LIKE_CARS else name)
    return None if found is None else VehicleType(KINDS[found[0]], found[1:])


def _built_in() -> Iterator[tuple[str, VehicleType]]:
    pairs = {"VEH": "passenger", "PED": "pedestrian", "BIKE": "bicycle", "TAXI": "taxi"}
    for part, name in pairs.items():
        if (kind := of_class(name)) is not None:
            yield f"DEFAULT_{part}TYPE", kind


def types(files: Iterable[Path]) -> dict[str, VehicleType]:
    """Return all types of route and additional files, and those SUMO has itself. Raises InputError."""
    found = dict(_built_in())
    for path in files:
        before = len(found)
        for part in parts(path, ("routes", "additional")):
            for node in [part, *part.children]:  # on their own, or in a vTypeDistribution
                if node.tag == "vType":
                    found[node.attribute("id", path)] = _type(node, path)
        if len(found) == before:
            raise InputError(f"{path}: expected vehicle types (<vType>), found no further one")
    return found


def _type(node: Node, path: Path) -> VehicleType:
    """Read a type: what it does not say is that of its class; without a class it is a passenger car."""
    name = node.attributes.get("vClass", "passenger")
    if (default := of_class(name)) is None:
        raise InputError(f"{path}:{node.line}: vClass: expected one of {', '.join(_CLASSES)}, found {name!r}")
    length, width, height = (
        positive(node.attributes.get(key, value), f"{path}:{node.line}: {key}")
        for key, value in zip(("length", "width", "height"), default.size_m, strict=True)
    )
    return VehicleType(default.kind, (length, width, height))
