"""What names of classes mean, as data sets and drivers write them."""

from __future__ import annotations

import re

from copem_replay.core.tracks import CLASSES

_WORDS = {
    "pedestrian": ("pedestrian", "person", "people", "human", "walker", "adult", "child", "wheelchair", "stroller"),
    "bicycle": ("bicycle", "bicyclist", "bike", "cyclist", "cycle", "scooter", "rider"),
    "motorcycle": ("motorcycle", "motorbike", "motorcyclist", "moped"),
    "van": ("van", "minivan", "pickup"),
    "truck": ("truck", "lorry", "semi"),
    "bus": ("bus", "coach", "minibus"),
    "trailer": ("trailer", "caravan"),
    "animal": ("animal", "dog", "cat", "deer"),
    "car": ("car", "sedan", "taxi", "passenger"),
    "vehicle": ("vehicle", "ego"),
    "other": ("other", "unknown", "misc", "object", "barrier", "cone", "sign", "tram", "train"),
}
"""In order of preference: `vehicle.bus` is a bus, `motorcycle rider` no bicycle."""
_ORDER = ("motorcycle", *(name for name in _WORDS if name != "motorcycle"))


def class_named(text: str) -> str | None:
    """The class that a name means, None where it says nothing: `Car`, `vehicle.bus.rigid`, `TYPE_PEDESTRIAN`."""
    words = set(re.split(r"[^a-z]+", re.sub(r"([a-z])([A-Z])", r"\1 \2", text).lower()))
    words |= {word.removesuffix("s") for word in words}
    for name in _ORDER:
        if words & set(_WORDS[name]):
            return name
    return None


assert set(_WORDS) == set(CLASSES)
