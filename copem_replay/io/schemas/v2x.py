"""The formats of object lists that stations send: CPM of ETSI, SDSM of SAE. They can be lists of a unit, not the truth.

Positions are relative to the station; numbers are whole ones, and some of them mean that nothing is known.
Sources: ETSI TS 103 324 and TS 102 894-2 V2.1.1, as `etsi_its_cpm_ts_msgs` has them; SAE J3224 and J2735, as
`j3224_v2x_msgs` has them, and as `carma_v2x_msgs` has them in m, s and degrees.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Final

import numpy as np

from copem_replay.core.tracks import Bool, Float
from copem_replay.io.schemas.description import ClassField, Description, Fields, Made, Stamp, StationFields

_SIGMAS_95: Final = 1.959963984540054
"""Half the width of the interval that holds 95 % of a normal distribution, in standard deviations."""


def _scale(per: float, *none: float) -> Callable[..., Float]:
    """What makes numbers of whole ones, `per` of them one unit; NaN: one of `none`, or another column is 0."""

    def make(whole: Float, *stated: Float) -> Float:
        known = ~np.isin(whole, none)
        for column in stated:
            known &= column != 0
        return np.where(known, whole / per, np.nan)

    return make


def _describe(objects: str, ident: str, within: str, class_: ClassField, made: Mapping[str, Made]) -> Description:
    """The description of lists whose columns `made` has."""
    names = ("x_m", "y_m", "yaw_rad", "length_m", "width_m", "height_m", "vx_mps", "vy_mps", "covariance")
    fields = {"objects": objects, "stamp": Stamp(path="stamp_ms", unit="ms"), "id": ident, "class": class_}
    return Description(
        Fields.model_validate(fields | {name: name for name in names}),
        within=within,
        said={"yaw": "yaw_said"},
        made={**made, "covariance[1]": Made((made["covariance[0]"].of[0],), np.zeros_like)},  # variances alone
        station=StationFields("/latitude_deg", "/longitude_deg", "after_s"),
    )


# CPM.

_ITS_EPOCH_S: Final = 1_072_915_200
"""The begin of 2004 (UTC) in Unix time: times of ITS are counted from there."""
_LEAPS_S: Final = (1_136_073_600, 1_230_768_000, 1_341_100_800, 1_435_708_800, 1_483_228_800)
"""Ends of the leap seconds since in Unix time, which does not count them; time of ITS does."""
_OBJECTS = "payload.cpm_containers.value.array[].container_data_perceived_object_container.perceived_objects.array[]"
_MANAGEMENT = "/payload.management_container"
_VEHICLES = (
    "vehicle", "pedestrian", "bicycle", "motorcycle", "motorcycle", "car", "bus", "van", "truck", "trailer", "vehicle",
    "other", "bicycle", "animal", "vehicle",
)  # fmt: skip
"""TrafficParticipantType."""
_PERSONS = ("pedestrian", "bicycle", "motorcycle", "animal")
"""VruProfileAndSubprofile."""
_CPM_CLASSES: Final = {
    **{str(k): name for k, name in enumerate(_VEHICLES)},
    **{str(1000 + k): name for k, name in enumerate(_PERSONS)},
    **{"2000": "other", "3000": "other"},  # a group of road users, another thing
}
_angle, _size = _scale(10, 3600, 3601), _scale(10, 0, 255, 256)
_component, _spread = _scale(100, -16383, 16382, 16383), _scale(100, 0, 4095, 4096)


def convert_its_time(its_ms: Float) -> Float:
    """Unix time in ms of TimestampIts: ms since the begin of 2004, leap seconds counted."""
    ends_ms = [(end_s - _ITS_EPOCH_S + k) * 1000 for k, end_s in enumerate(_LEAPS_S, 1)]
    return its_ms + (_ITS_EPOCH_S - np.searchsorted(ends_ms, its_ms, side="right")) * 1000.0


def _cpm_velocity(axis: int, stated: Float, kind: Float, speed: Float, direction: Float, along: Float) -> Float:
    """A velocity along an axis: of a speed and its direction (`kind` 0), or along the axis."""
    angle = np.deg2rad(_angle(direction))
    polar = _scale(100, 16382, 16383)(speed) * (np.sin(angle) if axis else np.cos(angle))
    return np.where(stated != 0, np.where(kind == 0, polar, _component(along)), np.nan)


def _cpm_class(kind: Float, vehicle: Float, person: Float) -> Float:
    return 1000 * kind + np.where(kind == 0, vehicle, np.where(kind == 1, person, 0))


def cpm(offers: Collection[str]) -> Description:
    """CollectivePerceptionMessage: the objects of its containers, positions as east and north of the station."""
    of_class, angle, polar = "classification.array[]", "angles.z_angle.value.value", "velocity.polar_velocity"
    speed = (f"{polar}.velocity_magnitude.speed_value.value", f"{polar}.velocity_direction.value.value")
    kinds = (
        f"{of_class}.object_class.{name}" for name in ("choice", "vehicle_sub_class.value", "vru_sub_class.choice")
    )
    made = {
        "/stamp_ms": Made((f"{_MANAGEMENT}.reference_time.value",), convert_its_time),
        "after_s": Made(("measurement_delta_time.value",), _scale(1000)),
        "yaw_said": Made((angle, "angles_is_present"), lambda *of: np.isfinite(_angle(*of))),
        "yaw_rad": Made((angle, "angles_is_present"), lambda *of: np.deg2rad(np.nan_to_num(_angle(*of)))),
        f"{of_class}.class": Made((*kinds,), _cpm_class),
        f"{of_class}.share": Made(
            (f"{of_class}.confidence.value",), lambda percent: np.where(percent > 100, 1.0, percent / 100)
        ),
    }
    for k, (axis, side) in enumerate((("x", "length_m"), ("y", "width_m"), ("z", "height_m"))):
        dimension, at = f"object_dimension_{axis}", f"position.{axis}_coordinate"
        made[side] = Made((f"{dimension}.value.value", f"{dimension}_is_present"), _size)
        if axis == "z":
            continue
        made[f"{axis}_m"] = Made((f"{at}.value.value",), _scale(100, -131072, 131071))
        along = f"velocity.cartesian_velocity.{axis}_velocity.value.value"
        made[f"v{axis}_mps"] = Made(
            ("velocity_is_present", "velocity.choice", *speed, along), partial(_cpm_velocity, k)
        )
        made[f"covariance[{7 * k}]"] = Made((f"{at}.confidence.value",), lambda of: (_spread(of) / _SIGMAS_95) ** 2)
    for name in ("latitude", "longitude"):
        made[f"/{name}_deg"] = Made((f"{_MANAGEMENT}.reference_position.{name}.value",), _scale(1e7))
    class_field = ClassField(path=f"{of_class}.class", map=_CPM_CLASSES, probability=f"{of_class}.share")
    return _describe(_OBJECTS, "object_id.value", "/header.station_id.value", class_field, made)


# SDSM.

_COMMON, _OPTIONAL = "detected_object_common_data", "detected_object_optional_data"
_NEAR_M = np.array([np.nan, 500, 200, 100, 50, 20, 10, 5, 2, 1, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01])
"""PositionConfidence: as near is a position, along each axis, with 95 %."""
_SDSM_CLASSES: Final = {
    **{"0": "other", "1": "vehicle", "2": "pedestrian", "3": "animal"},  # ObjectType, where it says no more
    **{"1010": "car", "1011": "car", "1020": "van", "1021": "van"},
    **{str(1000 + k): "truck" for k in range(25, 36)},
    **{str(1000 + k): "motorcycle" for k in range(40, 49)},
    **{str(1000 + k): "bus" for k in range(50, 59)},
    **{str(1000 + k): "vehicle" for k in (1, *range(60, 70))},
    **{"2001": "pedestrian", "2002": "bicycle", "2003": "pedestrian", "2004": "animal"},
}
"""1000: BasicVehicleClass; 2000: PersonalDeviceUserType."""
_HAS_SIZE, _HAS_HEIGHT, _HAS_CLASS, _HAS_TIME, _HAS_ZONE = 32, 64, 256, 63, 64
"""Bits of presence: of the size, height and class of a vehicle; of all parts of a time, and of its zone."""
_VEHICLE, _PERSON, _OBSTACLE = 0, 1, 2
_TIME = ("presence_vector", "year.year", "month.month", "day.day", "hour.hour", "minute.minute", "second.millisecond")


def _has(flags: Float, bits: int) -> Bool:
    result: Bool = (flags.astype(np.int64) & bits) == bits
    return result


def _sdsm_time(has: Float, year: Float, month: Float, day: Float, *of_day: Float) -> Float:
    """Unix time in ms of DDateTime; NaN: a part is missing, or is none."""
    hour, minute, second_ms, zone_min = of_day
    known = _has(has, _HAS_TIME) & (year > 0) & (second_ms < 61_000)
    months = (np.where(known, year, 1970).astype(np.int64) - 1970) * 12 + month.astype(np.int64) - 1
    days = months.astype("datetime64[M]").astype("datetime64[D]").astype(np.float64) + day - 1
    minutes = days * 1440 + hour * 60 + minute - np.where(_has(has, _HAS_ZONE), zone_min, 0)
    return np.where(known, minutes * 60_000 + second_ms, np.nan)


def _sdsm_class(kind: Float, has: Float, choice: Float, of_vehicle: Float, of_person: Float, *which: Float) -> Float:
    """The class that a vehicle or a person states, else the kind of object."""
    vehicle, person = which
    as_vehicle = _has(has, 1) & (choice == _VEHICLE) & _has(of_vehicle, _HAS_CLASS) & (vehicle > 0)
    as_person = _has(has, 1) & (choice == _PERSON) & _has(of_person, 1) & (person > 0)
    return np.where(as_vehicle, 1000 + vehicle, np.where(as_person, 2000 + person, kind))


def _sdsm_size(bit: int, per: float, per_obstacle: float) -> Callable[..., Float]:
    """What makes the size of a vehicle that has the flag `bit`, or of an obstacle."""

    def make(has: Float, choice: Float, of_vehicle: Float, vehicle: Float, obstacle: Float) -> Float:
        as_vehicle = _has(has, 1) & (choice == _VEHICLE) & _has(of_vehicle, bit)
        as_obstacle = _has(has, 1) & (choice == _OBSTACLE)
        return np.where(as_vehicle, vehicle / per, np.where(as_obstacle, obstacle / per_obstacle, np.nan))

    return make


def sdsm(offers: Collection[str]) -> Description:
    """SensorDataSharingMessage in m, s and degrees."""
    return _describe_sdsm(dict.fromkeys(("place", "time", "at", "speed", "angle", "side", "height", "obstacle"), 1))


def sdsm_integers(offers: Collection[str]) -> Description:
    """SensorDataSharingMessage in the units of J3224."""
    per = {"place": 1e7, "time": 1000, "at": 10, "speed": 50, "angle": 80, "side": 100, "height": 20, "obstacle": 10}
    return _describe_sdsm(per)


def _describe_sdsm(per: Mapping[str, float]) -> Description:
    """The description of messages with so many units for each m, s or degree.

    Offsets are north and east of the station, as CARMA reads them. The time of a measurement is before the message's,
    whatever its sign: writers differ.
    """
    flags = () if per["speed"] > 1 else ("unavailable",)
    angle, speed = _scale(per["angle"], 28800), _scale(per["speed"], 8191)
    heading, fast = (
        (f"{_COMMON}.{name}.{name}", *(f"{_COMMON}.{name}.{flag}" for flag in flags)) for name in ("heading", "speed")
    )

    def yaw(heading: Float, *unknown: Float) -> Float:
        return np.where(np.any([flag != 0 for flag in unknown], axis=0), np.nan, np.deg2rad(90 - angle(heading)))

    def velocity(turn: Callable[[Float], Float]) -> Callable[..., Float]:
        def make(*of: Float) -> Float:
            to, (value, *unknown) = yaw(*of[: len(heading)]), of[len(heading) :]
            return np.where(np.any([flag != 0 for flag in unknown], axis=0), np.nan, speed(value)) * turn(to)

        return make

    has, person = ("presence_vector", f"{_OPTIONAL}.choice"), f"{_OPTIONAL}.det_vru"
    vehicle, obstacle = f"{_OPTIONAL}.det_veh", f"{_OPTIONAL}.det_obst"
    which = (f"{vehicle}.vehicle_class.basic_vehicle_class", f"{person}.basic_type.type")
    made = {
        "/stamp_ms": Made(tuple(f"/sdsm_time_stamp.{part}" for part in (*_TIME, "offset.offset_minute")), _sdsm_time),
        "after_s": Made((f"{_COMMON}.measurement_time.measurement_time_offset",), lambda of: -np.abs(of) / per["time"]),
        "x_m": Made((f"{_COMMON}.pos.offset_y.object_distance",), _scale(per["at"])),
        "y_m": Made((f"{_COMMON}.pos.offset_x.object_distance",), _scale(per["at"])),
        "yaw_said": Made(heading, lambda *of: np.isfinite(yaw(*of))),
        "yaw_rad": Made(heading, lambda *of: np.nan_to_num(yaw(*of))),
        "vx_mps": Made((*heading, *fast), velocity(np.cos)),
        "vy_mps": Made((*heading, *fast), velocity(np.sin)),
        "class": Made(
            (f"{_COMMON}.obj_type.object_type", *has, *(f"{of}.presence_vector" for of in (vehicle, person)), *which),
            _sdsm_class,
        ),
        "/latitude_deg": Made(("/ref_pos.latitude",), _scale(per["place"])),
        "/longitude_deg": Made(("/ref_pos.longitude",), _scale(per["place"])),
    }  # fmt: skip
    sides = {"length": ("size.vehicle_length", _HAS_SIZE, "side"), "width": ("size.vehicle_width", _HAS_SIZE, "side")}
    for side, (path, bit, unit) in (sides | {"height": ("height.vehicle_height", _HAS_HEIGHT, "height")}).items():
        of = (*has, f"{vehicle}.presence_vector", f"{vehicle}.{path}", f"{obstacle}.obst_size.{side}.size_value")
        made[f"{side}_m"] = Made(of, _sdsm_size(bit, per[unit], per["obstacle"]))
    for k in (0, 7):
        made[f"covariance[{k}]"] = Made(
            (f"{_COMMON}.pos_confidence.pos.confidence",),
            lambda of: (_NEAR_M[np.where(of < len(_NEAR_M), of, 0).astype(np.int64)] / _SIGMAS_95) ** 2,
        )
    class_field = ClassField(path="class", map=_SDSM_CLASSES)
    return _describe(
        "objects.detected_object_data[]", f"{_COMMON}.detected_id.object_id", "/source_id.id", class_field, made
    )
