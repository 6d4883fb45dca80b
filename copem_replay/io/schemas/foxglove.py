"""foxglove.SceneUpdate as a list of objects: its cubes, whatever it is encoded in (protobuf, JSON, ROS 2).

An entity has an id, a frame of reference and a time stamp of its own; a cube is a box at its centre. What it is, if
anything says so, is in the entity's metadata.
"""

from __future__ import annotations

from collections.abc import Collection

from copem_replay.io.schemas.description import Class, Description, Fields, Yaw

_KEYS = ("class", "category", "category_name", "classification", "label", "object_class", "type")


def description(offers: Collection[str]) -> Description:
    """Where a SceneUpdate has what."""
    classes = "entities[].metadata[].value" in offers
    said = Class(path="/entities[].metadata[].value", key="/entities[].metadata[].key", keys=_KEYS)
    return Description(
        Fields.model_validate(
            {
                "objects": "entities[].cubes[]",
                "stamp": "entities[].timestamp" if any(p.startswith("entities[].timestamp.") for p in offers) else None,
                "frame": "entities[].frame_id" if "entities[].frame_id" in offers else None,
                "id": "/entities[].id" if "entities[].id" in offers else None,
                "class": said if classes else None,
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
        stays="entities[].id" if "entities[].id" in offers else None,
    )
