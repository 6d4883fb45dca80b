"""The formats of object lists that are known by name: those of ROS 2 and Foxglove.

The definitions in recordings differ between releases; a description is made for the paths that the messages offer.
Sources: the packages' own message definitions (autoware_perception_msgs, autoware_auto_perception_msgs, vision_msgs,
derived_object_msgs, visualization_msgs; foxglove.SceneUpdate).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Literal

from copem_replay.io.schemas.description import (
    ClassField,
    Description,
    Fields,
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


_POSE = {
    "x_m": "pose.position.x", "y_m": "pose.position.y", "z_m": "pose.position.z",
    "yaw_rad": Yaw(quaternion="pose.orientation"),
}  # fmt: skip


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
                **_POSE,
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
                **_POSE,
                "length_m": "scale.x",
                "width_m": "scale.y",
                "height_m": "scale.z",
            }
        ),
        only={"type": ("1",), "action": ("0",)},  # CUBE; ADD, which is MODIFY too
        within="ns",
        stays=StaysField("markers[].lifetime", "markers[].action", None, ("2",), ("3",)),
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
                **_POSE,
                "length_m": "size.x",
                "width_m": "size.y",
                "height_m": "size.z",
            }
        ),
        largest_of="entities[]",
        stays=StaysField("entities[].lifetime", "deletions[].type", "deletions[].id", _MATCHING, ("1", "ALL")),
    )
