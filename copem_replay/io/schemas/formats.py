"""The formats of object lists that are known by name: those of ROS 2 and Foxglove.

The definitions in recordings differ between releases; a description is made for the paths that the messages offer.
Sources: the packages' own message definitions (autoware_perception_msgs, autoware_auto_perception_msgs, vision_msgs,
derived_object_msgs, visualization_msgs, ika's perception_msgs; foxglove.SceneUpdate).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any, Literal

import numpy as np

from copem_replay.io.schemas.description import (
    ClassField,
    Description,
    Fields,
    Made,
    StaysField,
    Yaw,
)

# ObjectClassification.msg of both packages, the same up to PEDESTRIAN; from HAZARD on it is no road user
AUTOWARE = {
    **{"1": "car", "2": "truck", "3": "bus", "4": "trailer", "5": "motorcycle", "6": "bicycle", "7": "pedestrian"},
    "8": "animal",
}

_AUTOWARE_SAYS: Mapping[Literal["yaw", "velocity", "covariance"], str] = {
    "yaw": "kinematics.orientation_availability",  # 0: UNAVAILABLE
    "velocity": "kinematics.has_twist",
    "covariance": "kinematics.has_position_covariance",
}

# derived_object_msgs/Object.msg
_DERIVED = {"4": "pedestrian", "5": "bicycle", "6": "car", "7": "truck", "8": "motorcycle", "9": "vehicle"}

# perception_msgs/ObjectClassification.msg
_IKA = {
    **{"1": "pedestrian", "2": "bicycle", "3": "motorcycle", "4": "car", "5": "truck", "6": "van", "7": "bus"},
    **{"8": "animal", "9": "other", "10": "other", "11": "trailer", "12": "pedestrian", "13": "bicycle"},
    **{"50": "car", "51": "truck", "52": "bicycle", "100": "other"},
}


_LIST = {"objects": "objects[]", "stamp": "header.stamp", "frame": "header.frame_id"}


def _box(pose: str, size: str) -> dict[str, Any]:
    """The fields of a box: its pose and its size."""
    place = {f"{axis}_m": f"{pose}.position.{axis}" for axis in "xyz"}
    sides = {f"{side}_m": f"{size}.{axis}" for side, axis in zip(("length", "width", "height"), "xyz", strict=True)}
    return {**place, "yaw_rad": Yaw(quaternion=f"{pose}.orientation"), **sides}


def autoware(offers: Collection[str]) -> Description:
    """DetectedObjects, TrackedObjects, PredictedObjects: centre of the box, twist along the object.

    The shape of a POLYGON (2) has no x and y, but a footprint.
    """
    first = "initial_" if "objects[].kinematics.initial_pose_with_covariance.pose.position.x" in offers else ""
    pose, twist = f"kinematics.{first}pose_with_covariance", f"kinematics.{first}twist_with_covariance"
    return Description(
        Fields.model_validate(
            {
                **_LIST,
                "id": "object_id.uuid" if "objects[].object_id.uuid" in offers else None,
                "class": {
                    "path": "classification[].label",
                    "map": AUTOWARE,
                    "probability": "classification[].probability",
                },
                **_box(f"{pose}.pose", "shape.dimensions"),
                "vx_mps": f"{twist}.twist.linear.x",
                "vy_mps": f"{twist}.twist.linear.y",
                "velocity": "object",
                "existence": "existence_probability",
                "covariance": f"{pose}.covariance",
            }
        ),
        said={what: path for what, path in _AUTOWARE_SAYS.items() if f"objects[].{path}" in offers},
        footprint="shape.footprint.points[]" if "objects[].shape.footprint.points[].x" in offers else None,
    )


def detection3d(offers: Collection[str]) -> Description:
    """vision_msgs/Detection3DArray; names and the place of the class changed after Foxy."""
    new = "detections[].results[].hypothesis.class_id" in offers
    kind, score = ("hypothesis.class_id", "hypothesis.score") if new else ("id", "score")
    ident = next((n for n in ("id", "tracking_id") if f"detections[].{n}" in offers), None)
    fields = {
        **_LIST,
        "objects": "detections[]",
        "id": ident,
        "class": {"path": f"results[].{kind}", "probability": f"results[].{score}"},
        "existence": f"results[0].{score}",
        **_box("bbox.center", "bbox.size"),
    }
    if "detections[].results[].pose.covariance[]" in offers:
        fields["covariance"] = "results[0].pose.covariance"
    return Description(Fields.model_validate(fields))


def _solid(side: int) -> Callable[..., Any]:
    """What makes a side of the box around a solid: of a sphere 2, of a cylinder 3 and a cone 4 height and radius."""

    def make(kind: Any, *sides: Any) -> Any:
        across = 2.0 * np.where(kind == 2, sides[0], sides[1])
        height = np.where(kind == 2, across, sides[0])
        return np.where((kind >= 2) & (kind <= 4), height if side == 2 else across, sides[side])

    return make


def derived(offers: Collection[str]) -> Description:
    """derived_object_msgs/ObjectArray, as the CARLA bridge writes it: twist along the axes of the list."""
    sides = [f"shape.dimensions[{k}]" for k in range(3)]
    made: dict[str, Made] = {f"box[{k}]": (_solid(k), "shape.type", *sides) for k in range(3)}
    made, sides = (made, [*made]) if "objects[].shape.type" in offers else ({}, sides)
    fields = {
        **_LIST,
        "id": "id",
        "class": ClassField(path="classification", map=_DERIVED),
        **_box("pose", "shape"),
        **dict(zip(("length_m", "width_m", "height_m"), sides, strict=True)),
        "vx_mps": "twist.linear.x",
        "vy_mps": "twist.linear.y",
    }
    return Description(Fields.model_validate(fields), made=made)


def markers(offers: Collection[str]) -> Description:
    """visualization_msgs/MarkerArray: its cubes; an id is unique in its namespace, which may name the class."""
    return Description(
        Fields.model_validate(
            {
                "objects": "markers[]",
                "stamp": "markers[].header.stamp",
                "frame": "markers[].header.frame_id",
                "id": "id",
                "class": ClassField(path="ns"),
                **_box("pose", "scale"),
            }
        ),
        only={"type": ("1",), "action": ("0",)},  # CUBE; ADD, which is MODIFY too
        within="ns",
        stays=StaysField("markers[].lifetime", "markers[].action", None, ("2",), ("3",)),
    )


def _by_model(model: Any, iscactr: Any, hexamotion: Any) -> Any:
    return np.select([model == 16, model == 17], [iscactr, hexamotion], np.nan)


def _state(iscactr: int, hexamotion: int, quantity: str = "continuous_state") -> tuple[str, ...]:
    """The paths of the model of a state, and of a quantity where each model has it."""
    return ("state.model_id", f"state.{quantity}[{iscactr}]", f"state.{quantity}[{hexamotion}]")


def perception(offers: Collection[str]) -> Description:
    """perception_msgs/ObjectList of ika: states of ISCACTR and HEXAMOTION, moved to the centre of the box."""
    centre, yaw = "state.reference_point.translation_to_geometric_center", _state(7, 9)
    cells, place = "continuous_state_covariance", "state.continuous_state"

    def move(turn: Callable[[Any], tuple[Any, Any]]) -> Callable[..., Any]:
        def make(at: Any, ahead: Any, left: Any, *yaw: Any) -> Any:
            by_ahead, by_left = turn(_by_model(*yaw))
            return at + by_ahead * ahead + by_left * left

        return make

    made: dict[str, Made] = {
        "x_m": (move(lambda a: (np.cos(a), -np.sin(a))), f"{place}[0]", f"{centre}.x", f"{centre}.y", *yaw),
        "y_m": (move(lambda a: (np.sin(a), np.cos(a))), f"{place}[1]", f"{centre}.x", f"{centre}.y", *yaw),
        "z_m": (np.add, f"{place}[2]", f"{centre}.z"),
        "yaw_rad": (_by_model, *yaw),
        "length_m": (_by_model, *_state(10, 13)),
        "width_m": (_by_model, *_state(9, 14)),
        "height_m": (_by_model, *_state(11, 15)),
        "covariance[0]": (_by_model, *_state(0, 0, cells)),
        "covariance[1]": (_by_model, *_state(1, 1, cells)),
        "covariance[7]": (_by_model, *_state(13, 17, cells)),
    }
    kinds = "state.classifications[]"
    fields = {
        **_LIST,
        "id": "id",
        "class": {"path": f"{kinds}.type", "map": _IKA, "probability": f"{kinds}.probability"},
        "vx_mps": f"{place}[3]",
        "vy_mps": f"{place}[4]",
        "velocity": "object",
        "existence": "existence_probability",
        "covariance": "covariance",
        **{name: name for name in made if name.endswith(("_m", "_rad"))},
    }
    return Description(Fields.model_validate(fields), made=made)


_MATCHING = ("0", "MATCHING_ID", "")
_KEYS = ("class", "category", "category_name", "classification", "label", "object_class", "type")


def description(offers: Collection[str]) -> Description:
    """foxglove.SceneUpdate in protobuf, JSON or ROS 2: its cubes, boxes with their pose at the centre.

    An entity has an id, a frame of reference and a time stamp of its own; its class may be in its metadata.
    """
    classes = "entities[].metadata[].value" in offers
    class_field = ClassField(path="/entities[].metadata[].value", key="/entities[].metadata[].key", keys=_KEYS)
    return Description(
        Fields.model_validate(
            {
                "objects": "entities[].cubes[]",
                "stamp": "entities[].timestamp" if any(p.startswith("entities[].timestamp.") for p in offers) else None,
                "frame": "entities[].frame_id" if "entities[].frame_id" in offers else None,
                "id": "/entities[].id" if "entities[].id" in offers else None,
                "class": class_field if classes else None,
                **_box("pose", "size"),
            }
        ),
        largest_of="entities[]",
        stays=StaysField("entities[].lifetime", "deletions[].type", "deletions[].id", _MATCHING, ("1", "ALL")),
    )
