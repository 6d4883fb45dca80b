"""Layouts for Foxglove and Lichtblick: the scenes of a replay.mcap side by side, or two configurations compared.

Panels of scenes share their camera and follow the ego; under them each object has lanes, which show when it is known,
and curves of the age of its entries, in the colours of the configurations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.reader import make_reader

from copem_replay.core.colours import configuration_colours
from copem_replay.core.errors import InputError, unknown_name_message
from copem_replay.core.files import is_temporary, parse_json
from copem_replay.core.tracks import TRUTH
from copem_replay.core.yaml import NotYamlError, parse_yaml
from copem_replay.io.containers.mcap_records import DAMAGE
from copem_replay.io.write.message_family import EGO_FRAME, MIDDLE_FRAME, RUN_RECORD, TRUTH_TOPICS

PREFIX, SUFFIX = "copem/", "/scene"
EYE = {"perspective": True, "phi": 55, "thetaOffset": 45, "fovy": 45, "near": 0.5, "far": 5000}
"""The camera: its angles from above and around, in degrees; other values change the picture only."""
DISTANCE_M = 60.0
"""Distance of the camera: objects that the ego meets within two seconds are in the picture."""
TOLD_OBJECTS = 3
"""Objects with lanes and curves, those known at the most different times; more make their panels too narrow to read."""
_CDR_TEXT = 8
"""Bytes before the text of a ROS 2 string: the head, and the length."""
_NEVER_NS = 2**62


@dataclass(frozen=True)
class ReplayContents:
    """The scenes of a replay.mcap: configurations, colours (`#rrggbb`), objects, drawn truth, and frame to follow."""

    configurations: tuple[str, ...]
    colours: dict[str, str]
    objects: tuple[str, ...]
    truth: bool
    follow: str | None


def read_contents(replay: Path) -> ReplayContents:
    """The content of a replay.mcap. Raises InputError: it has no scene to show, or cannot be read."""
    try:
        with replay.open("rb") as file:
            reader = make_reader(file)
            summary = reader.get_summary()
            channels = [] if summary is None else [summary.channels[k] for k in sorted(summary.channels)]
            topics = [c.topic for c in channels]
            names = tuple(
                t.removeprefix(PREFIX).removesuffix(SUFFIX)
                for t in topics
                if t.startswith(PREFIX) and t.endswith(SUFFIX) and t != TRUTH_TOPICS[0]
            )
            moves = next((m.data for *_, m in reader.iter_messages(topics=TRUTH_TOPICS[2:])), b"")
            run_record = {record.name: record.metadata for record in reader.iter_metadata()}.get(RUN_RECORD, {})
            details = [f"{PREFIX}{name}/detail" for name in names]
            known: dict[str, dict[str, int]] = {}
            for _, channel, message in reader.iter_messages(topics=details) if details else ():
                text = message.data if channel.message_encoding == "json" else message.data[_CDR_TEXT:-1]
                for event in parse_json(text)["events"]:
                    known.setdefault(str(event["object"]), {})[channel.topic] = message.log_time
    except (*DAMAGE, TypeError) as error:
        raise InputError(f"{replay}: cannot be read: {' '.join(str(error).split())}") from None
    if not names:
        raise InputError(f"{replay}: expected topics {PREFIX}<configuration>{SUFFIX}, as in a replay.mcap, found none")
    apart = {name: _detection_gap(times, len(names)) for name, times in known.items()}
    objects = sorted(apart, key=lambda name: -apart[name])[:TOLD_OBJECTS]
    follow = next((frame for frame in (EGO_FRAME, MIDDLE_FRAME) if frame.encode() in moves), None)
    return ReplayContents(
        names, _find_colours(run_record.get("experiment", ""), names), tuple(objects), TRUTH_TOPICS[1] in topics, follow
    )


def _find_colours(experiment: str, names: Sequence[str]) -> dict[str, str]:
    """The colour of each configuration, `#rrggbb`, by the experiment that made the replay."""
    try:
        configurations = dict(parse_yaml(experiment)[0]["configurations"])
        truths = {name for name, keys in configurations.items() if keys.get("units") == TRUTH}
    except (NotYamlError, AttributeError, TypeError, ValueError, KeyError):
        configurations, truths = {}, set()
    configurations = configurations if set(names) <= set(configurations) else dict.fromkeys(names)
    colours = configuration_colours(configurations, truths, shown=[name for name in configurations if name in names])
    return {name: "#{:02x}{:02x}{:02x}".format(*colours[name]) for name in names}


def _detection_gap(times_ns: dict[str, int], configurations: int) -> int:
    """Time in ns between the first and the last configuration that knows an object; never knowing it is the latest."""
    last = _NEVER_NS if len(times_ns) < configurations else max(times_ns.values())
    return last - min(times_ns.values())


def list_replays(place: Path) -> list[Path]:
    """The replays of a results folder, `replay.mcap` or one for each shown log, or the one that is named."""
    if not place.is_dir() or (place / "replay.mcap").is_file():
        return [place / "replay.mcap" if place.is_dir() else place]
    found = sorted(path for path in (place / "replay").rglob("*.mcap") if not is_temporary(path.name))
    return found or [place / "replay.mcap"]


def build_layout(replay: Path, compare: Sequence[str] = ()) -> dict[str, Any]:
    """The layout: a panel per configuration, or of `compare` one with all of them and one of each.

    Raises InputError: there is no scene to show, or none of a configuration.
    """
    contents = read_contents(replay)
    for name in compare:
        if name not in contents.configurations:
            raise InputError(f"{replay}: {unknown_name_message('configuration', name, contents.configurations)}")
    shown = tuple(dict.fromkeys(compare)) or contents.configurations
    groups = [(name,) for name in shown] if not compare else [shown, *((name,) for name in shown)]
    scenes = {f"3D!{k}": _scene_panel(group, contents) for k, group in enumerate(groups)}
    lanes = [_knowledge_panels(contents, shown, k) for k in range(len(contents.objects))]
    rows = _arrange_grid(list(scenes))
    return {
        "configById": {**scenes, **{key: panel for panels in lanes for key, panel in panels.items()}},
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _stack_below(rows, lanes) if lanes else rows,
    }


def _knowledge_panels(contents: ReplayContents, shown: Sequence[str], number: int) -> dict[str, Any]:
    """By id the panels of object `number`: lanes (when it is known), and curves (age of its entries, s)."""
    ident = contents.objects[number]
    objects = {
        name: f"{quote_topic(f'{PREFIX}{name}/status')}.objects[:]{{id=={_quote_value(ident)}}}" for name in shown
    }
    lanes = [
        {"value": f"{path}.status", "label": name, "timestampMethod": "receiveTime"} for name, path in objects.items()
    ]
    curves = [
        {"value": f"{path}.age_s", "label": name, "enabled": True, "timestampMethod": "receiveTime",
         "color": contents.colours[name]}
        for name, path in objects.items()
    ]  # fmt: skip
    return {
        f"StateTransitions!{number}": {**_title_settings(f"{ident}: known"), "paths": lanes, "isSynced": True},
        f"Plot!{number}": {
            **_title_settings(f"{ident}: age of its entry, s"), "paths": curves, "xAxisVal": "timestamp",
            "isSynced": True, "showLegend": True, "legendDisplay": "floating", "showXAxisLabels": True,
            "showYAxisLabels": True, "showPlotValuesInLegend": False, "sidebarDimension": 240,
        },
    }  # fmt: skip


def quote_topic(topic: str) -> str:
    """A topic in quotes: message paths of Foxglove and Lichtblick know bare ones of letters and slashes only."""
    return '"' + topic.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _quote_value(value: str) -> str:
    """A value in quotes for the filter of a message path, which knows no escapes: in those that it does not have."""
    return f"'{value}'" if '"' in value else f'"{value}"'


def _title_settings(title: str) -> dict[str, str]:
    return {"foxglovePanelTitle": title, "lichtblickPanelTitle": title}


def _scene_panel(configurations: Sequence[str], contents: ReplayContents) -> dict[str, Any]:
    """The settings of a 3D panel of some configurations over the truth, whose camera follows the ego."""
    camera = {**EYE, "distance": DISTANCE_M, "target": [0, 0, 0], "targetOffset": [0, 0, 0],
              "targetOrientation": [0, 0, 0, 1]}  # fmt: skip
    shown = {f"{PREFIX}{name}/{kind}" for name in configurations for kind in ("scene", "uncertainty")}
    every = [f"{PREFIX}{name}/{kind}" for name in contents.configurations for kind in ("scene", "uncertainty")]
    topic_settings = {topic: {"visible": topic in shown} for topic in every}
    truth = {topic: {"visible": True} for topic in TRUTH_TOPICS[:2]} if contents.truth else {}
    grid = {"visible": True, "frameLocked": True, "label": "Grid", "instanceId": "grid", "layerId": "foxglove.Grid",
            "size": 200, "divisions": 20, "lineWidth": 1, "color": "#55555588"}  # fmt: skip
    return {
        **_title_settings(" and ".join(configurations)),
        "cameraState": camera,
        **({"followTf": contents.follow, "followMode": "follow-position"} if contents.follow else {}),
        "scene": {"syncCamera": True, "transforms": {"visible": False}},
        "topics": {**truth, **topic_settings},
        "transforms": {},
        "layers": {"grid": grid},
    }


def _stack_below(scenes: Any, lanes: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Lanes and curves in a strip under the scenes, a column per object; of one object they are side by side."""
    way = "row" if len(lanes) == 1 else "column"
    strip = split_panels("row", [split_panels(way, list(panels)) for panels in lanes])
    return {"first": scenes, "second": strip, "direction": "column", "splitPercentage": 72 if len(lanes) == 1 else 58}


def _arrange_grid(panels: Sequence[str]) -> Any:
    """A grid of rows of up to three panels; panels of a row have one width, rows one height."""
    wide = 3 if len(panels) in (3, 5, 6) or len(panels) > 8 else 2
    return split_panels("column", [split_panels("row", panels[k : k + wide]) for k in range(0, len(panels), wide)])


def split_panels(direction: str, parts: Sequence[Any]) -> Any:
    """The panels side by side; a split has two sides, so the second holds the rest."""
    if len(parts) == 1:
        return parts[0]
    rest = split_panels(direction, parts[1:])
    return {"first": parts[0], "second": rest, "direction": direction, "splitPercentage": round(100 / len(parts), 3)}
