"""CPM and SDSM for tests: their definitions as the packages have them, as far as they matter, and messages by hand."""

from typing import Any

from tests.helpers.messages import SEPARATOR

CPM = "etsi_its_cpm_ts_msgs/msg/CollectivePerceptionMessage"
SDSM = {name: f"{name}_v2x_msgs/msg/SensorDataSharingMessage" for name in ("carma", "j3224")}

_OF_CPM = {
    "CollectivePerceptionMessage": "ItsPduHeader header; CpmPayload payload",
    "ItsPduHeader": "U8 protocol_version; U8 message_id; U32 station_id",
    "CpmPayload": "ManagementContainer management_container; Containers cpm_containers",
    "ManagementContainer": (
        "U64 reference_time; ReferencePosition reference_position; Segmentation segmentation_info;"
        "bool segmentation_info_is_present; Rate message_rate_range; bool message_rate_range_is_present"
    ),
    "ReferencePosition": "I32 latitude; I32 longitude; Ellipse position_confidence_ellipse; Altitude altitude",
    "Ellipse": "U16 semi_major_confidence; U16 semi_minor_confidence; U16 semi_major_orientation",
    "Altitude": "I32 altitude_value; U8 altitude_confidence",
    "Segmentation": "U8 total_msg_no; U8 this_msg_no",
    "Rate": "Hz message_rate_min; Hz message_rate_max",
    "Hz": "U8 mantissa; I8 exponent",
    "Containers": "WrappedCpmContainers value",
    "WrappedCpmContainers": "WrappedCpmContainer[] array; uint8 MIN_SIZE=1",
    "WrappedCpmContainer": (
        "U8 container_id; Vehicle container_data_originating_vehicle_container;"
        "Sensors container_data_sensor_information_container;"
        "PerceivedObjectContainer container_data_perceived_object_container"
    ),
    "Vehicle": "Angle orientation_angle; Angle pitch_angle; bool pitch_angle_is_present",
    "Sensors": "Sensor[] array",
    "Sensor": (
        "U8 sensor_id; U8 sensor_type; Shape perception_region_shape; bool perception_region_shape_is_present;"
        "U8 perception_region_confidence; bool perception_region_confidence_is_present; bool shadowing_applies"
    ),
    "Shape": (
        "uint8 choice; uint8 CHOICE_RECTANGULAR=0; Circle circular; uint8 CHOICE_CIRCULAR=1; Radial radial;"
        "uint8 CHOICE_RADIAL=4; Radials radial_shapes; uint8 CHOICE_RADIAL_SHAPES=5"
    ),
    "Circle": "Point shape_reference_point; bool shape_reference_point_is_present; U16 radius; U16 height",
    "Radial": (
        "Point shape_reference_point; bool shape_reference_point_is_present; U16 range;"
        "U16 stationary_horizontal_opening_angle_start; U16 stationary_horizontal_opening_angle_end;"
        "U16 vertical_opening_angle_start; bool vertical_opening_angle_start_is_present"
    ),
    "Radials": (
        "U8 ref_point_id; I32 x_coordinate; I32 y_coordinate; I32 z_coordinate; bool z_coordinate_is_present;"
        "RadialsList radial_shapes_list"
    ),
    "RadialsList": "RadialDetails[] array",
    "RadialDetails": "U16 range; U16 horizontal_opening_angle_start; U16 horizontal_opening_angle_end",
    "Point": "I32 x_coordinate; I32 y_coordinate; I32 z_coordinate; bool z_coordinate_is_present",
    "PerceivedObjectContainer": "U8 number_of_perceived_objects; PerceivedObjects perceived_objects",
    "PerceivedObjects": "PerceivedObject[] array",
    "PerceivedObject": (
        "U16 object_id; bool object_id_is_present; I16 measurement_delta_time; Position position;"
        "Velocity velocity; bool velocity_is_present; Angles angles; bool angles_is_present;"
        "Dimension object_dimension_z; bool object_dimension_z_is_present;"
        "Dimension object_dimension_y; bool object_dimension_y_is_present;"
        "Dimension object_dimension_x; bool object_dimension_x_is_present;"
        "I16 object_age; bool object_age_is_present; Ids sensor_id_list; bool sensor_id_list_is_present;"
        "Classes classification; bool classification_is_present"
    ),
    "Position": (
        "Coordinate x_coordinate; Coordinate y_coordinate; Coordinate z_coordinate; bool z_coordinate_is_present"
    ),
    "Coordinate": "I32 value; U16 confidence",
    "Velocity": (
        "uint8 choice; Polar polar_velocity; uint8 CHOICE_POLAR_VELOCITY=0;"
        "Cartesian cartesian_velocity; uint8 CHOICE_CARTESIAN_VELOCITY=1"
    ),
    "Polar": "Speed velocity_magnitude; Angle velocity_direction; Component z_velocity; bool z_velocity_is_present",
    "Speed": "U16 speed_value; U8 speed_confidence",
    "Cartesian": "Component x_velocity; Component y_velocity; Component z_velocity; bool z_velocity_is_present",
    "Component": "I16 value; U8 confidence",
    "Angles": "Angle z_angle; Angle y_angle; bool y_angle_is_present; Angle x_angle; bool x_angle_is_present",
    "Angle": "U16 value; U8 confidence",
    "Dimension": "U16 value; U8 confidence",
    "Ids": "U8[] array",
    "Classes": "ClassWithConfidence[] array",
    "ClassWithConfidence": "ObjectClass object_class; U8 confidence",
    "ObjectClass": "uint8 choice; U8 vehicle_sub_class; Vru vru_sub_class; Group group_sub_class; U8 other_sub_class",
    "Vru": "uint8 choice; U8 pedestrian; U8 bicyclist_and_light_vru_vehicle; U8 motorcyclist; U8 animal",
    "Group": "U8 cluster_id; bool cluster_id_is_present; U8 cluster_cardinality_size",
    **{
        f"{sign}{bits}": f"{word}{bits} value"
        for sign, word in (("U", "uint"), ("I", "int"))
        for bits in (8, 16, 32, 64)
    },
}


def _of_sdsm(si: bool) -> dict[str, str]:
    """In units of SI, with flags for what is unavailable, or in whole numbers."""
    number, flag = ("float32", "; bool unavailable") if si else ("int16", "")
    return {
        "SensorDataSharingMessage": (
            "U8 msg_cnt; Id source_id; U8 equipment_type; DDateTime sdsm_time_stamp; Position3D ref_pos;"
            "Accuracy ref_pos_xy_conf; DetectedObjectList objects; uint8 presence_vector; U8 ref_pos_el_conf"
        ),
        "Id": "uint8[] id; uint16 ID_TIME_MAX=3000",
        "U8": "uint8 value",
        "DDateTime": (
            "uint8 presence_vector; uint8 YEAR=1; Year year; Month month; Day day; Hour hour; Minute minute;"
            "Second second; Offset offset"
        ),
        "Year": "uint16 year", "Month": "uint8 month", "Day": "uint8 day", "Hour": "uint8 hour",
        "Minute": "uint8 minute", "Second": "uint16 millisecond", "Offset": "int16 offset_minute",
        "Position3D": f"{'float64' if si else 'int32'} latitude; {'float64' if si else 'int32'} longitude;"
        f"{'float32' if si else 'int32'} elevation; bool elevation_exists",
        "Accuracy": f"uint16 presence_vector; {number} semi_major; {number} semi_minor; float64 orientation",
        "DetectedObjectList": "DetectedObjectData[] detected_object_data",
        "DetectedObjectData": (
            "Common detected_object_common_data; uint8 presence_vector; Optional detected_object_optional_data"
        ),
        "Common": (
            "Kind obj_type; U8 obj_type_cfd; ObjectId detected_id; TimeOffset measurement_time; U8 time_confidence;"
            "OffsetXYZ pos; ConfidenceSet pos_confidence; Speed speed; Confidence speed_confidence; Heading heading;"
            "Confidence heading_conf; uint8 presence_vector; uint8 HAS_SPEED_Z=1"
        ),
        "Kind": "uint8 object_type", "ObjectId": "uint16 object_id",
        "TimeOffset": f"{number} measurement_time_offset",
        "OffsetXYZ": "Distance offset_x; Distance offset_y; uint8 presence_vector; Distance offset_z",
        "Distance": f"{number} object_distance",
        "ConfidenceSet": "Confidence pos; Confidence elevation",
        "Confidence": "uint8 confidence",
        "Speed": f"{'float32' if si else 'uint16'} speed{flag}",
        "Heading": f"{'float32' if si else 'uint16'} heading{flag}",
        "Optional": "uint8 choice; Vehicle det_veh; Person det_vru; Obstacle det_obst",
        "Vehicle": "uint16 presence_vector; uint16 HAS_SIZE=32; Size size; Height height; VehicleClass vehicle_class",
        "Size": f"{'uint16 presence_vector; ' * si}{number} vehicle_width; {number} vehicle_length",
        "Height": f"{'float32' if si else 'uint8'} vehicle_height{flag}",
        "VehicleClass": "uint8 basic_vehicle_class",
        "Person": "uint8 presence_vector; Basic basic_type", "Basic": "uint8 type",
        "Obstacle": "ObstacleSize obst_size; U8 obst_size_confidence",
        "ObstacleSize": "Side width; Side length; uint8 presence_vector; Side height",
        "Side": f"{number} size_value",
    }  # fmt: skip


def define(types: dict[str, str]) -> str:
    """The text of a definition whose first type is that of the message."""
    first, *others = ((name, fields.replace(";", "\n")) for name, fields in types.items())
    return first[1] + "\n" + "".join(f"{SEPARATOR}MSG: p/{name}\n{fields}\n" for name, fields in others)


CPM_TEXT = define(_OF_CPM)
SDSM_TEXT = {"carma": define(_of_sdsm(True)), "j3224": define(_of_sdsm(False))}


def value(of: float) -> dict[str, float]:
    return {"value": of}


def measured(of: float, confidence: float = 127) -> dict[str, Any]:
    return {"value": value(of), "confidence": value(confidence)}


def cpm_object(number: int, x: int, y: int, **changes: Any) -> dict[str, Any]:
    """A car of 4.5 × 1.8 × 1.5 m at 10 m/s to the north, measured 50 ms before, within 0.5 m with 95 %."""
    return {
        "object_id": value(number), "object_id_is_present": True, "measurement_delta_time": value(-50),
        "position": {"x_coordinate": measured(x, 50), "y_coordinate": measured(y, 50)},
        "velocity_is_present": True, "velocity": cartesian(0, 1000),
        "angles_is_present": True, "angles": {"z_angle": measured(900)},
        **{f"object_dimension_{axis}_is_present": True for axis in "xyz"},
        **{f"object_dimension_{axis}": measured(side) for axis, side in zip("xyz", (45, 18, 15), strict=True)},
        "classification_is_present": True, "classification": {"array": [kind(5)]},
        **changes,
    }  # fmt: skip


def kind(vehicle: int = 0, vru: int = 0, choice: int = 0, confidence: int = 80) -> dict[str, Any]:
    of = {"choice": choice, "vehicle_sub_class": value(vehicle), "vru_sub_class": {"choice": vru}}
    return {"object_class": of, "confidence": value(confidence)}


def cartesian(x: int, y: int) -> dict[str, Any]:
    return {"choice": 1, "cartesian_velocity": {"x_velocity": measured(x), "y_velocity": measured(y)}}


def polar(speed: int, tenths: int) -> dict[str, Any]:
    fast = {"speed_value": value(speed), "speed_confidence": value(127)}
    return {"choice": 0, "polar_velocity": {"velocity_magnitude": fast, "velocity_direction": measured(tenths)}}


def sector(range_dm: int, start: int, end: int, east_cm: int = 0) -> dict[str, Any]:
    """A sensor with a sector clockwise from north, in dm and tenths of a degree."""
    angles = {f"stationary_horizontal_opening_angle_{of}": value(at) for of, at in (("start", start), ("end", end))}
    about = {"shape_reference_point": {"x_coordinate": value(east_cm)}, "shape_reference_point_is_present": True}
    return shaped(4, radial={"range": value(range_dm)} | angles | (about if east_cm else {}))


def sectors(*ranges_and_angles: tuple[int, int, int]) -> dict[str, Any]:
    """A sensor with sectors counter-clockwise from east."""
    names = ("range", "horizontal_opening_angle_start", "horizontal_opening_angle_end")
    parts = [dict(zip(names, map(value, part), strict=True)) for part in ranges_and_angles]
    return shaped(5, radial_shapes={"radial_shapes_list": {"array": parts}})


def shaped(choice: int, **shape: Any) -> dict[str, Any]:
    region = {"choice": choice, **shape}
    return {"sensor_id": value(1), "perception_region_shape": region, "perception_region_shape_is_present": True}


def cpm_message(
    its_ms: int, lat: float, lon: float, *objects: dict[str, Any], station: int = 7, sensors: Any = None
) -> dict[str, Any]:
    """A container of sensors, or of a vehicle, and one of objects."""
    of = {"number_of_perceived_objects": value(len(objects)), "perceived_objects": {"array": list(objects)}}
    full = {"container_id": value(5), "container_data_perceived_object_container": of}
    place = {"latitude": value(round(lat * 1e7)), "longitude": value(round(lon * 1e7))}
    before = {"container_id": value(1)}
    if sensors is not None:
        before = {"container_id": value(3), "container_data_sensor_information_container": {"array": sensors}}
    return {
        "header": {"station_id": value(station)},
        "payload": {
            "management_container": {"reference_time": value(its_ms), "reference_position": place},
            "cpm_containers": {"value": {"array": [before, full]}},
        },
    }


def sdsm_object(number: int, north: float, east: float, *, per: float = 1.0, **changes: Any) -> dict[str, Any]:
    """As that of a CPM; offsets in m, or in dm with `per` 10."""
    whole = per > 1
    far = (lambda of: round(of * per)) if whole else float
    common = {
        "obj_type": {"object_type": 1}, "detected_id": {"object_id": number},
        "measurement_time": {"measurement_time_offset": -50 if whole else -0.05},
        "pos": {"offset_x": {"object_distance": far(north)}, "offset_y": {"object_distance": far(east)}},
        "pos_confidence": {"pos": {"confidence": 10}}, "speed": {"speed": 500 if whole else 10.0},
    }  # fmt: skip
    size = {"presence_vector": 3, "vehicle_width": 180 if whole else 1.8, "vehicle_length": 450 if whole else 4.5}
    vehicle = {
        "presence_vector": 32 + 64 + 256, "size": size, "height": {"vehicle_height": 30 if whole else 1.5},
        "vehicle_class": {"basic_vehicle_class": 10},
    }  # fmt: skip
    return {
        "detected_object_common_data": common | changes,
        "presence_vector": 1,
        "detected_object_optional_data": {"choice": 0, "det_veh": vehicle},
    }


def sdsm_message(lat: float, lon: float, *objects: dict[str, Any], per: float = 1.0) -> dict[str, Any]:
    """Sent at 2026-11-28 12:34:56.789 UTC."""
    now = {
        "presence_vector": 63, "year": {"year": 2026}, "month": {"month": 11}, "day": {"day": 28},
        "hour": {"hour": 12}, "minute": {"minute": 34}, "second": {"millisecond": 56789},
    }  # fmt: skip
    place = {"latitude": lat, "longitude": lon}
    if per > 1:
        place = {name: round(of * 1e7) for name, of in place.items()}
    return {
        "source_id": {"id": [0, 1, 2, 255]}, "sdsm_time_stamp": now, "ref_pos": place,
        "objects": {"detected_object_data": list(objects)},
    }  # fmt: skip
