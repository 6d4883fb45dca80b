"""The formats of object lists that stations send: CPM of ETSI, SDSM of SAE. They can be lists of a unit, not the truth.

Positions are relative to the station; numbers are whole ones, and some of them mean that nothing is known.
Sources: ETSI TS 103 324 and TS 102 894-2 V2.1.1, as `etsi_its_cpm_ts_msgs` has them; SAE J3224 and J2735, as
`j3224_v2x_msgs` has them, and as `carma_v2x_msgs` has them in m, s and degrees.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Final

import numpy as np

from copem_replay.core.tracks import Bool, Float
from copem_replay.io.encodings.columns import ShreddedMessages, ancestor_rows, list_level
from copem_replay.io.schemas.description import ClassField, Description, Fields, Made, Stamp

_SIGMAS_95: Final = 1.959963984540054
"""Half the width of the interval that holds 95 % of a normal distribution, in standard deviations."""


def _scale(per: float, *none: float, flagged: bool = True) -> Callable[..., Float]:
    """What makes numbers of whole ones, `per` of them one unit; NaN: one of `none`, or a flag is not as `flagged`."""

    def make(whole: Float, *flags: Float) -> Float:
        known = ~np.isin(whole, none)
        for flag in flags:
            known &= (flag != 0) == flagged
        return np.where(known, whole / per, np.nan)

    return make


def _describe(
    objects: str, ident: str, within: str, class_: str, names: dict[int, str], share: str | None, made: dict[str, Made]
) -> Description:
    """The description of lists: `made` has each column with the paths it is made of; `share`: path of probability."""
    columns = ("x_m", "y_m", "yaw_rad", "length_m", "width_m", "height_m", "vx_mps", "vy_mps", "covariance")
    kind = ClassField(path=class_, map={str(number): name for number, name in names.items()}, probability=share)
    fields = {"objects": objects, "stamp": Stamp(path="stamp_ms", unit="ms"), "id": ident, "class": kind}
    make_yaw, *of_yaw = made["yaw_rad"]
    made |= {
        "yaw_said": (lambda *of: np.isfinite(make_yaw(*of)), *of_yaw),
        "yaw_rad": (lambda *of: np.nan_to_num(make_yaw(*of)), *of_yaw),
        "covariance[1]": (np.zeros_like, made["covariance[0]"][1]),  # variances alone
    }
    fields |= {name: name for name in columns}
    return Description(Fields.model_validate(fields), within=within, said={"yaw": "yaw_said"}, made=made, station=True)


# CPM.

_ITS_EPOCH_S: Final = 1_072_915_200
"""The begin of 2004 (UTC) in Unix time: times of ITS are counted from there."""
_LEAPS_S: Final = (1_136_073_600, 1_230_768_000, 1_341_100_800, 1_435_708_800, 1_483_228_800)
"""Ends of the leap seconds since in Unix time, which does not count them; time of ITS does."""
_CPM_CLASSES: Final = {
    **dict(enumerate(("vehicle", "pedestrian", "bicycle", "motorcycle", "motorcycle", "car", "bus", "van", "truck"))),
    **dict(enumerate(("trailer", "vehicle", "other", "bicycle", "animal", "vehicle"), 9)),
    **dict(enumerate(("pedestrian", "bicycle", "motorcycle", "animal"), 1000)),
    **{2000: "other", 3000: "other"},
}
"""TrafficParticipantType; 1000: VruProfileAndSubprofile; a group of road users, another thing."""


def convert_its_time(its_ms: Float) -> Float:
    """Unix time in ms of TimestampIts: ms since the begin of 2004, leap seconds counted."""
    ends_ms = [(end_s - _ITS_EPOCH_S + k) * 1000 for k, end_s in enumerate(_LEAPS_S, 1)]
    return its_ms + (_ITS_EPOCH_S - np.searchsorted(ends_ms, its_ms, side="right")) * 1000.0


def _cpm_velocity(turn: Callable[[Float], Float]) -> Callable[..., Float]:
    """What makes a velocity along an axis: of a speed and its direction (choice 0), or of that along the axis."""

    def make(stated: Float, choice: Float, speed: Float, direction: Float, along: Float) -> Float:
        polar = _scale(100, 16382, 16383)(speed) * turn(np.deg2rad(_scale(10, 3600, 3601)(direction)))
        velocity = np.where(choice == 0, polar, _scale(100, -16383, 16382, 16383)(along))
        return np.where(stated != 0, velocity, np.nan)

    return make


def _cpm_class(choice: Float, vehicle: Float, person: Float) -> Float:
    return 1000 * choice + np.where(choice == 0, vehicle, np.where(choice == 1, person, 0))


def cpm(offers: Collection[str]) -> Description:
    """CollectivePerceptionMessage: the objects of its containers, positions as east and north of the station."""
    management, of_class, speed = "/payload.management_container", "classification.array[]", "velocity.polar_velocity"
    objects = "perceived_object_container.perceived_objects.array[]"
    objects = f"payload.cpm_containers.value.array[].container_data_{objects}"
    kind, along, angle = f"{of_class}.object_class", "velocity.cartesian_velocity", "angles.z_angle.value.value"
    speed_of = (f"{speed}.velocity_magnitude.speed_value.value", f"{speed}.velocity_direction.value.value")
    fast = ("velocity_is_present", "velocity.choice", *speed_of)
    made: dict[str, Made] = {
        "/stamp_ms": (convert_its_time, f"{management}.reference_time.value"),
        "/latitude_deg": (_scale(1e7), f"{management}.reference_position.latitude.value"),
        "/longitude_deg": (_scale(1e7), f"{management}.reference_position.longitude.value"),
        "after_s": (_scale(1000), "measurement_delta_time.value"),
        "yaw_rad": (lambda *of: np.deg2rad(_scale(10, 3600, 3601)(*of)), angle, "angles_is_present"),
        "vx_mps": (_cpm_velocity(np.cos), *fast, f"{along}.x_velocity.value.value"),
        "vy_mps": (_cpm_velocity(np.sin), *fast, f"{along}.y_velocity.value.value"),
        f"{of_class}.class": (
            _cpm_class, f"{kind}.choice", f"{kind}.vehicle_sub_class.value", f"{kind}.vru_sub_class.choice",
        ),
        f"{of_class}.share": (lambda of: np.where(of > 100, 1.0, of / 100), f"{of_class}.confidence.value"),
    }  # fmt: skip
    for place, axis in {0: "x", 7: "y"}.items():
        at = f"position.{axis}_coordinate"
        made[f"{axis}_m"] = (_scale(100, -131072, 131071), f"{at}.value.value")
        made[f"covariance[{place}]"] = (
            lambda of: (_scale(100, 0, 4095, 4096)(of) / _SIGMAS_95) ** 2, f"{at}.confidence.value",
        )  # fmt: skip
    for side, axis in {"length": "x", "width": "y", "height": "z"}.items():
        size = f"object_dimension_{axis}"
        made[f"{side}_m"] = (_scale(10, 0, 255, 256), f"{size}.value.value", f"{size}_is_present")
    path, share = f"{of_class}.class", f"{of_class}.share"
    return _describe(objects, "object_id.value", "/header.station_id.value", path, _CPM_CLASSES, share, made)


# Sensors of a station.

CPM: Final = "etsi_its_cpm_ts_msgs/msg/CollectivePerceptionMessage"
PLACE_PATHS: Final = tuple(
    f"payload.management_container.reference_position.{axis}.value" for axis in ("latitude", "longitude")
)
_CONTAINER: Final = "payload.cpm_containers.value.array[]"
_SENSOR: Final = f"{_CONTAINER}.container_data_sensor_information_container.array[]"
_SHAPE: Final = f"{_SENSOR}.perception_region_shape"
_CIRCLE, _RADIAL, _SECTORS = f"{_SHAPE}.circular", f"{_SHAPE}.radial", f"{_SHAPE}.radial_shapes"
_SECTOR: Final = f"{_SECTORS}.radial_shapes_list.array[]"
_REGIONS: Final = {
    1: (f"{_CIRCLE}.shape_reference_point", f"{_CIRCLE}.radius", ""),
    4: (f"{_RADIAL}.shape_reference_point", f"{_RADIAL}.range", f"{_RADIAL}.stationary_horizontal_opening_angle"),
    5: (_SECTORS, f"{_SECTOR}.range", f"{_SECTOR}.horizontal_opening_angle"),
}
"""By choice of a shape the paths of its middle, of its radius, and of the angles between which it is."""
_KIND: Final = (f"{_CONTAINER}.container_id.value", f"{_SENSOR}.perception_region_shape_is_present", f"{_SHAPE}.choice")
_VEHICLE_CONTAINER: Final = 1
_AT_STATION_M: Final = 2.0


def _region_paths(choice: int) -> tuple[list[str], list[str]]:
    """The paths of the middle of a region, and of its radius and angles."""
    middle, radius, angle = _REGIONS[choice]
    ends = [f"{angle}_{end}.value" for end in ("start", "end") if angle]
    return [f"{middle}.{axis}_coordinate.value" for axis in "xy"], [f"{radius}.value", *ends]


SENSOR_PATHS: Final = (*_KIND, *(path for choice in _REGIONS for paths in _region_paths(choice) for path in paths))

View = tuple[tuple[float, float], tuple[float, float]]
"""Distances in m from and to, and azimuths in degrees from and to, counter-clockwise from north."""


def find_views(found: ShreddedMessages) -> tuple[list[View], str]:
    """Where the sensors of a station that stands look, seen from the station, and why that is not all of it.

    Angles of `radial` are clockwise from north, those of `radial_shapes` counter-clockwise from the x axis, which is
    east (TS 102 894-2, Wgs84AngleValue and CartesianAngleValue).
    """
    containers, *of_sensors = (found.levels[list_level(path)].numbers[path] for path in _KIND)
    choice, views, why = np.where(of_sensors[0] != 0, of_sensors[1], -1), dict[View, None](), ""
    if (containers == _VEHICLE_CONTAINER).any() and (choice >= 0).any():
        return [], "its station is a vehicle; expected one that stands"
    if not np.isin(choice, (-1, *_REGIONS)).all():
        why = "a sensor's region is neither a sector nor a circle"
    for kind in _REGIONS:
        middle, numbers = _region_paths(kind)
        level = list_level(numbers[0])
        sensor = ancestor_rows(found, level, _SENSOR)
        rows = np.flatnonzero(choice[sensor] == kind)
        away_m = np.hypot(*(found.levels[_SENSOR].numbers[path][sensor[rows]] / 100 for path in middle))
        if (away_m > _AT_STATION_M).any():
            why = f"a sensor is {away_m.max():.0f} m from its station; expected a unit for each such sensor"
        for radius, *angles in np.unique(
            [found.levels[level].numbers[path][rows] for path in numbers], axis=1
        ).T.tolist():
            if any(angle > 3600 for angle in angles):
                why = "a sensor does not state its angles"
            first, last = angles or (0, 3600)
            turned = (first / 10 - 90, last / 10 - 90) if kind == 5 else (-last / 10, -first / 10)
            views[(0.0, radius / 10), turned] = None
    return list(views), why


# SDSM.

_NEAR_M = np.array([np.nan, 500, 200, 100, 50, 20, 10, 5, 2, 1, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01])
"""PositionConfidence: as near is a position, along each axis, with 95 %."""
_SDSM_CLASSES: Final = {
    **dict(enumerate(("other", "vehicle", "pedestrian", "animal"))),  # ObjectType, where it says no more
    **{1010: "car", 1011: "car", 1020: "van", 1021: "van"},
    **dict.fromkeys(range(1025, 1036), "truck"),
    **dict.fromkeys(range(1040, 1049), "motorcycle"),
    **dict.fromkeys(range(1050, 1059), "bus"),
    **dict.fromkeys((1001, *range(1060, 1070)), "vehicle"),
    **dict(enumerate(("pedestrian", "bicycle", "pedestrian", "animal"), 2001)),
}
"""1000: BasicVehicleClass; 2000: PersonalDeviceUserType."""
_VEHICLE, _PERSON, _OBSTACLE = 0, 1, 2
_TIME = ("presence_vector", "year.year", "month.month", "day.day", "hour.hour", "minute.minute", "second.millisecond")
_HAS_TIME, _HAS_ZONE, _HAS_SIZE, _HAS_HEIGHT, _HAS_CLASS = 63, 64, 32, 64, 256
"""Bits of presence: of all parts of a time, and its zone; of the size, height and class of a vehicle."""


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
    """SensorDataSharingMessage in m, s and degrees, with flags for what is unavailable."""
    return _describe_sdsm(1, 1, 1, 1, 1, 1, 1, "unavailable")


def sdsm_integers(offers: Collection[str]) -> Description:
    """SensorDataSharingMessage in the units of J3224."""
    return _describe_sdsm(1e7, 1000, 10, 50, 80, 100, 20)


def _describe_sdsm(
    per_deg: float, per_s: float, per_m: float, per_mps: float, per_turn: float, per_side: float, per_height: float,
    *flags: str,
) -> Description:  # fmt: skip
    """The description of SDSM. `per_…`: units in a degree (place), s, m, m/s, degree (heading), m of a vehicle's side,
    of its height; `flags`: further paths of heading and speed.

    Offsets are north and east of the station, as CARMA reads them. A measurement is before its message, whatever the
    sign of its time: writers differ.
    """
    common, optional = "detected_object_common_data", "detected_object_optional_data"
    vehicle, person, obstacle = (f"{optional}.{name}" for name in ("det_veh", "det_vru", "det_obst"))
    heading, speed = ([f"{common}.{name}.{of}" for of in (name, *flags)] for name in ("heading", "speed"))
    fast, turn = _scale(per_mps, 8191, flagged=False), _scale(per_turn, 28800, flagged=False)
    has, count = ("presence_vector", f"{optional}.choice"), len(speed)

    def yaw(*of: Float) -> Float:
        return np.deg2rad(90 - turn(*of))

    def variance(of: Float) -> Float:
        return np.square(_NEAR_M[np.where(of < len(_NEAR_M), of, 0).astype(np.int64)] / _SIGMAS_95)

    made: dict[str, Made] = {
        "/stamp_ms": (_sdsm_time, *(f"/sdsm_time_stamp.{part}" for part in (*_TIME, "offset.offset_minute"))),
        "/latitude_deg": (_scale(per_deg), "/ref_pos.latitude"),
        "/longitude_deg": (_scale(per_deg), "/ref_pos.longitude"),
        "after_s": (lambda of: -np.abs(of) / per_s, f"{common}.measurement_time.measurement_time_offset"),
        "x_m": (_scale(per_m), f"{common}.pos.offset_y.object_distance"),
        "y_m": (_scale(per_m), f"{common}.pos.offset_x.object_distance"),
        "yaw_rad": (yaw, *heading),
        "vx_mps": (lambda *of: fast(*of[:count]) * np.cos(yaw(*of[count:])), *speed, *heading),
        "vy_mps": (lambda *of: fast(*of[:count]) * np.sin(yaw(*of[count:])), *speed, *heading),
        "covariance[0]": (variance, f"{common}.pos_confidence.pos.confidence"),
        "covariance[7]": (variance, f"{common}.pos_confidence.pos.confidence"),
        "class": (
            _sdsm_class, f"{common}.obj_type.object_type", *has, f"{vehicle}.presence_vector",
            f"{person}.presence_vector", f"{vehicle}.vehicle_class.basic_vehicle_class", f"{person}.basic_type.type",
        ),
    }  # fmt: skip
    for side, of, bit, per in (
        ("length", "size.vehicle_length", _HAS_SIZE, per_side),
        ("width", "size.vehicle_width", _HAS_SIZE, per_side),
        ("height", "height.vehicle_height", _HAS_HEIGHT, per_height),
    ):
        paths = (f"{vehicle}.presence_vector", f"{vehicle}.{of}", f"{obstacle}.obst_size.{side}.size_value")
        made[f"{side}_m"] = (_sdsm_size(bit, per, per_m), *has, *paths)
    ident, objects = f"{common}.detected_id.object_id", "objects.detected_object_data[]"
    return _describe(objects, ident, "/source_id.id", "class", _SDSM_CLASSES, None, made)
