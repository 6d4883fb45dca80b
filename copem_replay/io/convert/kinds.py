"""What an object is, as OSI says it. Each format maps its own names onto these."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from osi3.osi_object_pb2 import MovingObject, StationaryObject

from copem_replay.io.plausibility import HEIGHTS_M

Vehicle = MovingObject.VehicleClassification
Static = StationaryObject.Classification


@dataclass(frozen=True)
class Kind:
    """Type and, for vehicles and stationary objects, classification."""

    name: str
    moving: bool
    type: int  # MovingObject.Type, or StationaryObject.Classification.Type
    vehicle: int | None = None
    like: str = "vehicle"  # the class whose typical height it has

    @property
    def height_m(self) -> float:
        """Typical height, for sources without heights."""
        return HEIGHTS_M[self.like][1]


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
    "vehicle": (None, "vehicle"),  # a vehicle, not said which
}
_STATIC = {
    "cone": Static.TYPE_CONSTRUCTION_SITE_ELEMENT,
    "pole": Static.TYPE_POLE,
    "barrier": Static.TYPE_BARRIER,
    "building": Static.TYPE_BUILDING,
    "static": Static.TYPE_OTHER,
}
KINDS: Final[dict[str, Kind]] = {
    **{name: Kind(name, True, MovingObject.TYPE_VEHICLE, *what) for name, what in _VEHICLES.items()},
    "pedestrian": Kind("pedestrian", True, MovingObject.TYPE_PEDESTRIAN, like="pedestrian"),
    "animal": Kind("animal", True, MovingObject.TYPE_ANIMAL, like="animal"),
    "other": Kind("other", True, MovingObject.TYPE_OTHER, like="other"),
    **{name: Kind(name, False, number, like="other") for name, number in _STATIC.items()},
}
"""By name; the last five never move."""
