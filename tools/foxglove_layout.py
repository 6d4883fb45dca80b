"""A layout for Foxglove and Lichtblick that shows the scenes of a replay.mcap side by side, cameras in step.

python tools/foxglove_layout.py out/tc016d/replay.mcap logs/tc016d.foxglove.json

Then, in either, open the replay.mcap and import the layout from its file.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory as Protobuf

from copem_replay.core.errors import InputError
from copem_replay.core.files import atomic_file

PREFIX, SUFFIX = "copem/", "/scene"
EYE = {"perspective": True, "phi": 55, "thetaOffset": 45, "fovy": 45, "near": 0.5, "far": 5000}
"""How the camera looks (chosen): degrees from above and around."""
NEAR_FAR_M = (30, 150)
"""How far from the middle of what is seen, at least and at most (chosen)."""


def layout_of(replay: Path) -> dict[str, Any]:
    """The layout, a panel per configuration. Raises InputError where there is no scene to show."""
    try:
        with replay.open("rb") as file:
            reader = make_reader(file, decoder_factories=[Protobuf(), *_ros2()])
            summary = reader.get_summary()
            channels = [] if summary is None else [summary.channels[k] for k in sorted(summary.channels)]
            topics = [c.topic for c in channels if c.topic.startswith(PREFIX) and c.topic.endswith(SUFFIX)]
            messages = reader.iter_decoded_messages(topics=topics) if topics else ()
            cubes = [
                (entity.frame_id, cube) for *_, scene in messages for entity in scene.entities for cube in entity.cubes
            ]
    except (OSError, McapError) as error:
        raise InputError(f"{replay}: cannot be read: {' '.join(str(error).split())}") from None
    if not topics:
        raise InputError(f"{replay}: expected topics {PREFIX}<configuration>{SUFFIX}, as in a replay.mcap, found none")
    if not cubes:
        raise InputError(f"{replay}: expected boxes on {', '.join(topics)}, found none: nobody listed anything")
    panels = {f"3D!{k}": topic for k, topic in enumerate(topics)}
    camera = _camera(np.array([[c.pose.position.x, c.pose.position.y, c.pose.position.z] for _, c in cubes]))
    return {
        "configById": {panel: _panel(topic, topics, cubes[0][0], camera) for panel, topic in panels.items()},
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _grid(list(panels)),
    }


def _ros2() -> list[Any]:
    """For replays of ROS 2 recordings, where that decoder is installed (`pip install .[dev]`)."""
    try:
        from mcap_ros2.decoder import DecoderFactory
    except ImportError:
        return []
    return [DecoderFactory()]


def _camera(place_m: np.ndarray) -> dict[str, Any]:
    """On the middle of all boxes (K, 3), far enough away for half of them."""
    middle = np.median(place_m, axis=0)
    half_m = np.median(np.hypot(*(place_m - middle).T[:2]))
    distance_m = float(np.clip(2.5 * half_m, *NEAR_FAR_M))
    return {
        **EYE,
        "distance": round(distance_m, 1),
        "target": [0, 0, 0],
        "targetOffset": [round(float(x), 1) for x in (*middle[:2], 0.0)],
        "targetOrientation": [0, 0, 0, 1],
    }


def _panel(topic: str, topics: Sequence[str], frame: str, camera: dict[str, Any]) -> dict[str, Any]:
    """A 3D panel of one topic, in the scenes' own frame of reference."""
    title = topic.removeprefix(PREFIX).removesuffix(SUFFIX)
    grid = {"visible": True, "frameLocked": True, "label": "Grid", "instanceId": "grid", "layerId": "foxglove.Grid",
            "frameId": frame, "size": 200, "divisions": 20, "lineWidth": 1, "color": "#55555588"}  # fmt: skip
    return {
        "foxglovePanelTitle": title,
        "lichtblickPanelTitle": title,
        "cameraState": camera,
        "followTf": frame,
        "followMode": "follow-none",
        "scene": {"syncCamera": True, "transforms": {"visible": False}},
        "topics": {one: {"visible": one == topic} for one in topics},
        "transforms": {},
        "layers": {"grid": grid},
    }


def _grid(panels: Sequence[str]) -> Any:
    """Rows of up to three, all panels of a row as wide, all rows as high."""
    wide = 3 if len(panels) in (3, 5, 6) or len(panels) > 8 else 2
    return _split("column", [_split("row", panels[k : k + wide]) for k in range(0, len(panels), wide)])


def _split(direction: str, parts: Sequence[Any]) -> Any:
    """The parts one after the other: a split has two sides, so the second holds the rest."""
    if len(parts) == 1:
        return parts[0]
    rest = _split(direction, parts[1:])
    return {"first": parts[0], "second": rest, "direction": direction, "splitPercentage": round(100 / len(parts), 3)}


def main() -> None:
    parser = argparse.ArgumentParser(description="A layout that shows the scenes of a replay.mcap side by side.")
    parser.add_argument("replay", type=Path, help="replay.mcap of a results folder")
    parser.add_argument("out", type=Path, help="the layout (.json)")
    given = parser.parse_args()
    try:
        text = json.dumps(layout_of(given.replay), indent=1, ensure_ascii=False) + "\n"
        with atomic_file(given.out) as scratch:
            scratch.write_text(text, encoding="utf-8")
    except InputError as error:
        sys.exit("\n".join(error.problems))


if __name__ == "__main__":
    main()
