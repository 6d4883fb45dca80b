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
    SolidField,
    StaysField,
    Yaw,
)

# ObjectClassification.msg of both packages, the same up to PEDESTRIAN; from HAZARD on it is no road user
_AUTOWARE = {
    "1": "car",
    "2": "truck",
    "3": "bus",
    "4": "trailer",
    "5": "motorcycle",
    "6": "bicycle",
    "7": "pedestrian",
    "8": "animal",
}

_AUTOWARE_SAYS: Mapping[Literal["yaw", "velocity", "covariance"], str] = {
    "yaw": "kinematics.orientation_availability",  # 0: UNAVAILABLE
    "velocity": "kinematics.has_twist",
    "covariance": "kinematics.has_position_covariance",
}

# derived_object_msgs/Object.msg
_DERIVED = {
    "4": "pedestrian",
    "5": "bicycle",
    "6": "car",
    "7": "truck",
    "8": "motorcycle",
    "9": "vehicle",
}

# perception_msgs/ObjectClassification.msg
_IKA = {
    **{"1": "pedestrian", "2": "bicycle", "3": "motorcycle", "4": "car", "5": "truck", "6": "van", "7": "bus"},
    **{"8": "animal", "9": "other", "10": "other", "11": "trailer", "12": "pedestrian", "13": "bicycle"},
    **{"50": "car", "51": "truck", "52": "bicycle", "100": "other"},
}
_IKA_STATES = {
    16: {"x": 0, "y": 1, "z": 2, "along": 3, "left": 4, "yaw": 7, "width": 9, "length": 10, "height": 11, "of": 12},
    17: {"x": 0, "y": 1, "z": 2, "along": 3, "left": 4, "yaw": 9, "length": 13, "width": 14, "height": 15, "of": 16},
}
"""By model (ISCACTR, HEXAMOTION) the places of its quantities in the vector of the state, and their number, `of`."""


def autoware(offers: Collection[str]) -> Description:
    """DetectedObjects, TrackedObjects, PredictedObjects: centre of the box, twist along the object.

    The shape of a POLYGON (2) has no x and y, but a footprint.
    """
    first = "initial_" if "objects[].kinematics.initial_pose_with_covariance.pose.position.x" in offers else ""
    pose, twist = f"kinematics.{first}pose_with_covariance", f"kinematics.{first}twist_with_covariance"
    return Description(
        Fields.model_validate(
            {
                "objects": "objects[]",
                "stamp": "header.stamp",
                "frame": "header.frame_id",
                "id": "object_id.uuid" if "objects[].object_id.uuid" in offers else None,
                "class": {
                    "path": "classification[].label",
                    "map": _AUTOWARE,
                    "probability": "classification[].probability",
                },
                "x_m": f"{pose}.pose.position.x",
                "y_m": f"{pose}.pose.position.y",
                "z_m": f"{pose}.pose.position.z",
                "yaw_rad": {"quaternion": f"{pose}.pose.orientation"},
                "length_m": "shape.dimensions.x",
                "width_m": "shape.dimensions.y",
                "height_m": "shape.dimensions.z",
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
        "objects": "detections[]",
        "stamp": "header.stamp",
        "frame": "header.frame_id",
        "id": ident,
        "class": {"path": f"results[].{kind}", "probability": f"results[].{score}"},
        "existence": f"results[0].{score}",
        "x_m": "bbox.center.position.x",
        "y_m": "bbox.center.position.y",
        "z_m": "bbox.center.position.z",
        "yaw_rad": {"quaternion": "bbox.center.orientation"},
        "length_m": "bbox.size.x",
        "width_m": "bbox.size.y",
        "height_m": "bbox.size.z",
    }
    if "detections[].results[].pose.covariance[]" in offers:
        fields["covariance"] = "results[0].pose.covariance"
    return Description(Fields.model_validate(fields))


def derived(offers: Collection[str]) -> Description:
    """derived_object_msgs/ObjectArray, as the CARLA bridge writes it: twist along the axes of the list."""
    return Description(
        Fields.model_validate(
            {
                "objects": "objects[]",
                "stamp": "header.stamp",
                "frame": "header.frame_id",
                "id": "id",
                "class": ClassField(path="classification", map=_DERIVED),
                "x_m": "pose.position.x",
                "y_m": "pose.position.y",
                "z_m": "pose.position.z",
                "yaw_rad": Yaw(quaternion="pose.orientation"),
                "length_m": "shape.dimensions[0]",
                "width_m": "shape.dimensions[1]",
                "height_m": "shape.dimensions[2]",
                "vx_mps": "twist.linear.x",
                "vy_mps": "twist.linear.y",
            }
        ),
        solid=SolidField("shape.type", "shape.dimensions") if "objects[].shape.type" in offers else None,
    )


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
                "x_m": "pose.position.x",
                "y_m": "pose.position.y",
                "z_m": "pose.position.z",
                "yaw_rad": Yaw(quaternion="pose.orientation"),
                "length_m": "scale.x",
                "width_m": "scale.y",
                "height_m": "scale.z",
            }
        ),
        only={"type": ("1",), "action": ("0",)},  # CUBE; ADD, which is MODIFY too
        within="ns",
        stays=StaysField("markers[].lifetime", "markers[].action", None, ("2",), ("3",)),
    )


def perception(offers: Collection[str]) -> Description:
    """perception_msgs/ObjectList of ika: states of ISCACTR and HEXAMOTION, moved to the centre of the box."""
    model, centre = "state.model_id", "state.reference_point.translation_to_geometric_center"

    def pick(names: str, path: str = "state.continuous_state") -> tuple[str, ...]:
        """The paths of quantities in the state of each model, after that of the model."""
        return (model, *(f"{path}[{at[name]}]" for name in names.split() for at in _IKA_STATES.values()))

    def choose(of: Any, *values: Any) -> list[Any]:
        """Of quantities by model (Q · models) those of the model, NaN: of another one."""
        models = [of == number for number in _IKA_STATES]
        pairs = (values[k : k + len(models)] for k in range(0, len(values), len(models)))
        return [np.select(models, list(pair), np.nan) for pair in pairs]

    def move(axis: int) -> Callable[..., Any]:
        def make(*of: Any) -> Any:
            (at, yaw), (ahead, left) = choose(*of[:-2]), of[-2:]
            return at + (np.sin(yaw) * ahead + np.cos(yaw) * left if axis else np.cos(yaw) * ahead - np.sin(yaw) * left)

        return make

    names = {"yaw_rad": "yaw", "length_m": "length", "width_m": "width", "height_m": "height"}
    names |= {"vx_mps": "along", "vy_mps": "left"}
    made = {field: Made(pick(name), lambda *of: choose(*of)[0]) for field, name in names.items()}
    for k, axis in enumerate("xy"):
        made[f"{axis}_m"] = Made((*pick(f"{axis} yaw"), f"{centre}.x", f"{centre}.y"), move(k))
    made["z_m"] = Made((*pick("z"), f"{centre}.z"), lambda *of: choose(*of[:-1])[0] + of[-1])
    for place, (row, column) in {0: (0, 0), 1: (0, 1), 7: (1, 1)}.items():
        cells = (f"state.continuous_state_covariance[{row * at['of'] + column}]" for at in _IKA_STATES.values())
        made[f"covariance[{place}]"] = Made((model, *cells), lambda *of: choose(*of)[0])
    fields = {
        "objects": "objects[]",
        "stamp": "header.stamp",
        "frame": "header.frame_id",
        "id": "id",
        "class": {
            "path": "state.classifications[].type",
            "map": _IKA,
            "probability": "state.classifications[].probability",
        },
        "velocity": "object",
        "existence": "existence_probability",
        "covariance": "covariance",
    }
    return Description(
        Fields.model_validate(fields | {name: name for name in made if not name.startswith("covariance")}), made=made
    )


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
                "x_m": "pose.position.x",
                "y_m": "pose.position.y",
                "z_m": "pose.position.z",
                "yaw_rad": Yaw(quaternion="pose.orientation"),
                "length_m": "size.x",
                "width_m": "size.y",
                "height_m": "size.z",
            }
        ),
        largest_of="entities[]",
        stays=StaysField("entities[].lifetime", "deletions[].type", "deletions[].id", _MATCHING, ("1", "ALL")),
    )
