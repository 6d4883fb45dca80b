"""Names of classes, as data sets, drivers and simulators write them: one table for all readers and converters.

A name is cut into words, `vehicle.carlamotors.firetruck` and `MotorcycleRider` alike. Words of things that stand win
over the road user they contain (`bicycle_rack`), persons over what they work on, and of the others the most special.
"""

from __future__ import annotations

import re
from functools import cache
from itertools import pairwise
from typing import Final

from copem_replay.core.tracks import CLASSES

_STATIC: Final = (
    "rack", "sign", "stop", "crossing", "lane", "door", "cone", "trafficcone", "pylon", "pylons", "barrier", "bollard",
    "signal", "marking", "parking", "shelter", "pole", "post", "hydrant", "fence", "wall",
    "building", "guardrail", "debris", "wheel", "window", "plate", "stand", "path", "side", "roadside", "tree",
    "bench", "bin", "board", "mirror", "bridge", "tunnel", "area", "zone", "guard", "track", "tracks", "barrel",
    "boundary", "strip", "pillar", "trashcan", "trash", "pushable", "pullable",
)  # fmt: skip
"""Words that make of a road user a thing that stands beside the road, or a part of something."""
_WORDS: Final = {
    "pedestrian": (
        "pedestrian", "ped", "person", "people", "human", "walker", "adult", "child", "children", "kid", "man", "woman",
        "men", "women", "wheelchair", "stroller", "worker", "workers", "roadworker", "officer", "policeman", "signaler",
        "jogger", "runner", "skater", "vru",
    ),
    "motorcycle": (
        "motorcycle", "motorbike", "motorcyclist", "motor_cycle", "motorcyle", "motorscooter", "moped", "vespa",
        "harley", "davidson", "kawasaki", "yamaha", "ducati", "powered_two_wheeler", "ptw",
    ),
    "bicycle": (
        "bicycle", "bicyclist", "bike", "biker", "cyclist", "cycle", "scooter", "kickscooter", "escooter", "rider",
        "tricycle", "unicycle", "pedicab", "rickshaw", "barrow", "barrowlist", "pedelec", "diamondback", "gazelle",
        "crossbike", "segway", "kickboard",
    ),
    "animal": ("animal", "dog", "cat", "deer", "horse", "cow", "bird", "sheep", "boar"),
    "trailer": ("trailer", "semitrailer", "caravan", "caravantransporter"),
    "bus": ("bus", "coach", "minibus", "autobus", "trolleybus", "busses", "buses"),
    "truck": (
        "truck", "lorry", "lorries", "semi", "semitractor", "firetruck", "boxtruck", "truckcab", "hgv", "tractor",
        "excavator", "bulldozer", "crane", "forklift", "tanker", "carlacola", "machine",
    ),
    "van": ("van", "minivan", "pickup", "delivery", "sprinter"),
    "car": (
        "car", "sedan", "taxi", "passenger", "hatchback", "suv", "coupe", "cabrio", "convertible", "wagon", "limousine",
        "police", "passengercar", "audi", "bmw", "tesla", "toyota", "nissan", "jeep", "seat", "lincoln", "dodge",
        "micro", "chevrolet", "citroen", "mini", "ambulance",
    ),
    "vehicle": ("vehicle", "vehicles", "veh", "ego", "emergency", "regular", "kart"),
    "other": (
        "other", "unknown", "misc", "object", "tram", "subway", "train", "rail", "streetcar", "movable", "static",
        "device", "ship", "boat", "aircraft", "airplane",
    ),
}  # fmt: skip
"""Words by class, the most special class first: `vehicle.bus` is a bus, `motorcycle rider` no bicycle."""
assert set(_WORDS) == set(CLASSES)
_JOINED: Final = {
    "two_wheeler": "motorcycle", "other_vehicle": "vehicle", "pickup_truck": "truck", "train_car": "other",
    "motor_cycle": "motorcycle", "police_officer": "pedestrian", "construction_worker": "pedestrian",
    "tractor_trailer": "trailer", "trailer_truck": "truck", "truck_bus": "bus", "e_scooter": "bicycle",
    "electric_scooter": "bicycle", "motorized_scooter": "motorcycle", "medium_car": "car", "wheeled_device": "bicycle",
    "traffic_light": "other", "light_trailer": "trailer", "board_trailer": "trailer", "railed_vehicle": "other",
    "emergency_vehicle": "vehicle", "regular_vehicle": "car",
    "mini_bus": "bus", "school_bus": "bus", "mini_van": "van",
    "wheel_chair": "pedestrian", "wheeled_pedestrian": "pedestrian", "personal_mobility": "pedestrian",
    "station_wagon": "car", "street_light": "other", "bus_station": "other",
    **{f"{size}_vehicle": "truck" for size in ("long", "large", "heavy", "special", "utility", "construction")},
    "vehicle_construction": "truck",
    "delivery_truck": "truck", "cargo_bike": "bicycle", "low_rider": "motorcycle",
}  # fmt: skip
"""Words that mean something else together than each by itself."""


def _split_name(text: str) -> list[str]:
    """The words of a name, in lower case, without `type`."""
    spaced = re.sub(r"([a-z])([A-Z])", r"\1 \2", text)
    return [word for word in re.split(r"[^a-z]+", spaced.lower()) if word not in ("", "type")]


def stands(text: str) -> bool:
    """Whether a name means a thing that never moves: a sign, a cone, a wall."""
    return class_from_name(text) == "other" and not {"static", *_STATIC}.isdisjoint(_split_name(text))


@cache
def class_from_name(text: str) -> str | None:
    """The class that a name means, None where it says nothing: `Car`, `vehicle.bus.rigid`, `TYPE_PEDESTRIAN`."""
    words = _split_name(text)
    pairs = ["_".join(pair).removesuffix("s") for pair in pairwise(words)][::-1]  # the last word says what it is
    if "with" in words:  # `Pedestrian with Object`, `person with bicycle`
        words = words[: words.index("with")]
    if "on" in words:  # `person on bicycle`
        words = words[words.index("on") + 1 :]
    for pair in pairs:
        if pair in _JOINED:
            return _JOINED[pair]
    known = {*words, *(word.removesuffix("s") for word in words), "_".join(words), "".join(words)}
    result = next((name for name, terms in _WORDS.items() if known & set(terms)), None)
    if known & set(_STATIC) and not known & {"worker", "officer", "person"}:
        return "other"
    if result is None:  # `MyFiretruckModel`: words that are written together
        result = next(
            (name for name, terms in _WORDS.items() for one in terms if len(one) > 4 and any(one in w for w in words)),
            None,
        )
    return result
