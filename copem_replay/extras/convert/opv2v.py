"""OPV2V and data sets of its layout: OPV2V, V2XSet, V2X-Real, CooperScene.

A scenario is a folder with a folder for each agent, and in it a YAML file for each frame: the pose of the agent, and
the objects that it labels, by ids that all agents share. Angles are roll yaw pitch in degrees, `extent` is half of
length width height, `center` is the centre of the box seen from `location`. Of simulations the axes are CARLA's, y to
the right and yaw with the clock; real recordings have y to the left. The names are those of OpenCOOD and CooperScene.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np

from copem_replay.core.errors import InputError, quote_value, unknown_name_message
from copem_replay.core.tracks import Float
from copem_replay.core.yaml import NotYamlError, parse_yaml
from copem_replay.extras.convert.conversion import (
    KINDS,
    Box,
    ConversionReport,
    ConvertedFrame,
    OsiKind,
    PlannedRecording,
    number_names,
    parse_number,
    parse_seconds_as_ns,
    parse_vector,
    rotation_from_euler,
    wrap_yaw,
)
from copem_replay.io.class_names import class_from_name

RATE_HZ: Final = 10
"""Frames a second where nothing says how long a step is: so all these data sets are published."""

_SIZE_M: Final = (4.5, 1.8, 1.5)  # of an agent that no other agent labels
_SAME_M: Final = 2.0  # two cars side by side are farther apart, centre to centre
_APART_M: Final = 0.5  # labels of one object by two agents that differ by more are counted
_SHORT_M: Final = 1.2  # an object without a class that is no longer stands on two legs
_PROTOCOL: Final = "data_protocol.yaml"
_USED: Final = ("vehicles", "objects", "lidar_pose", "true_ego_pos", "RSU")


@dataclass(frozen=True)
class _Label:
    """An object at a frame: x y z yaw (4,), size (3,), and its class as written, empty: none."""

    pose: Float
    size_m: tuple[float, float, float]
    kind: str


@dataclass(frozen=True)
class _AgentFrame:
    """What an agent writes at a frame. `on_roof`: its pose is that of its lidar, not of the vehicle."""

    pose: Float
    lidar: Float  # its pose
    on_roof: bool
    fixed: bool
    labels: Mapping[str, _Label]
    right_handed: bool


Scenario = Mapping[str, Mapping[int, _AgentFrame]]
"""Frames by number, by agent."""
UnitedLabels = Mapping[int, Mapping[str, _Label]]
"""Labels of all agents by id, by number of the frame."""


def list_recordings(source: Path) -> dict[str, PlannedRecording] | None:
    """The scenarios of a folder; None: it is one. Raises InputError."""
    if not source.is_dir():
        raise InputError(f"{source}: expected the folder of a scenario or of several, found a file")
    if _list_frames(source):
        expected = "expected a scenario with a folder for each agent"
        raise InputError(f"{source}: {expected}, found the folder of one agent: name the folder above")
    if _list_agents(source):
        return None
    scenarios = {
        path.name: PlannedRecording(path) for path in sorted(source.iterdir()) if path.is_dir() and _list_agents(path)
    }
    if not scenarios:
        raise InputError(f"{source}: expected scenarios, AGENT/000000.yaml in each, found none")
    return scenarios


def _list_agents(scenario: Path) -> list[Path]:
    """The folders of agents, vehicles first, by their numbers where they are numbers."""
    found = [path for path in scenario.iterdir() if path.is_dir() and _list_frames(path)]
    return sorted(found, key=lambda path: (_is_negative(path.name), len(path.name), path.name))


def _list_frames(agent: Path) -> list[Path]:
    return sorted(
        path for path in agent.glob("*.yaml") if path.stem.isascii() and path.stem.isdecimal() and len(path.stem) < 16
    )


def _is_negative(name: str) -> bool:
    """Whether it is that of infrastructure."""
    return name.startswith("-")


# Files.


def _read_scenario(scenario: Path) -> dict[str, dict[int, _AgentFrame]]:
    return {
        agent.name: {int(path.stem): _read_frame(path) for path in _list_frames(agent)}
        for agent in _list_agents(scenario)
    }


def _read_frame(path: Path) -> _AgentFrame:
    """What an agent's file says of one frame: its pose, its lidar's, and the objects it labels. Raises InputError."""
    data = _read_keys(path)
    on_roof = "true_ego_pos" not in data
    key = "lidar_pose" if on_roof else "true_ego_pos"
    if key not in data:
        raise InputError(f"{path}: expected true_ego_pos or lidar_pose, found {', '.join(map(str, data)) or 'neither'}")
    pose, is_matrix = _read_pose(data[key], f"{path}: {key}")
    lidar, _ = _read_pose(data["lidar_pose"], f"{path}: lidar_pose") if "lidar_pose" in data else (pose, False)
    objects = data.get("vehicles", data.get("objects"))
    if not isinstance(objects or {}, dict) or ("vehicles" not in data and "objects" not in data):
        raise InputError(f"{path}: vehicles: expected an object of objects, found {quote_value(objects)}")
    labels = {str(name): _read_label(one, f"{path}: vehicle {name}") for name, one in (objects or {}).items()}
    right_handed = is_matrix or any(_is_plain_class(label.kind) for label in labels.values())
    return _AgentFrame(pose, lidar, on_roof, data.get("RSU") is True, labels, right_handed)


def _read_keys(path: Path) -> dict[str, Any]:
    """The keys of a file that are used; cameras and plans, most of it, are not parsed. Raises InputError."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise InputError(f"{path}: cannot be opened: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected YAML in UTF-8, found something else: {error}") from None
    used_lines, is_used = list[str](), False
    for line in lines:
        if line[:1] not in ("", " ", "-", "#"):
            is_used = line.split(":", 1)[0] in _USED
        used_lines.append(line if is_used else "")  # lines keep their numbers
    try:
        data, _, problems = parse_yaml("\n".join(used_lines))
    except NotYamlError as error:
        raise InputError(f"{path}:{error.line}: expected YAML, found something else: {error.why}") from None
    if problems:
        _, line_number, message = problems[0]
        raise InputError(f"{path}:{line_number}: {message}")
    if not isinstance(data, dict):
        raise InputError(f"{path}: expected {', '.join(_USED[:4])}, found none of them")
    return data


def _read_pose(value: Any, where: str) -> tuple[Float, bool]:
    """X y z yaw of x y z roll yaw pitch, or of a matrix (4, 4); and whether it is a matrix. Raises InputError."""
    if isinstance(value, list) and len(value) == 4 and all(isinstance(row, list) for row in value):
        rows = np.array([parse_vector(row, 4, where) for row in value])
        return np.array([*rows[:3, 3], math.atan2(rows[1, 0], rows[0, 0])]), True
    x, y, z, _, yaw_deg, _ = parse_vector(value, 6, where)
    return np.array([x, y, z, math.radians(yaw_deg)]), False


def _read_label(value: Any, where: str) -> _Label:
    """The pose, size (m) and class of a labelled object. Raises InputError."""
    if not isinstance(value, dict):
        raise InputError(f"{where}: expected location, center, angle and extent, found {quote_value(value)}")
    location, angle = (
        parse_vector(value.get("location"), 3, f"{where}: location"),
        parse_vector(value.get("angle"), 3, f"{where}: angle"),
    )
    centre = parse_vector(value["center"], 3, f"{where}: center") if value.get("center") is not None else np.zeros(3)
    length, width, height = (2 * parse_vector(value.get("extent"), 3, f"{where}: extent")).tolist()
    roll, yaw, pitch = np.radians(angle)
    at_m = location + rotation_from_euler(-roll, -pitch, yaw) @ centre  # a nose that rises has a pitch above 0
    return _Label(
        np.array([*at_m, yaw]), (length, width, height), str(value.get("obj_type") or value.get("bp_id") or "")
    )


def _find_step_s(scenario: Path, numbers: list[int], rate_hz: float | None) -> Decimal:
    """Seconds from one frame number to the next: by `rate_hz`, else by the simulation's step. Raises InputError."""
    steps = {later - number for number, later in pairwise(numbers)}
    least_step = min(steps, default=1)
    if rate_hz is not None:
        return 1 / Decimal(str(rate_hz)) / least_step
    if (path := scenario / _PROTOCOL).is_file():
        try:
            data, _, _ = parse_yaml(path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, NotYamlError):
            data = None
        world = data.get("world") if isinstance(data, dict) else None
        if isinstance(world, dict) and "fixed_delta_seconds" in world:
            step_s = parse_number(world["fixed_delta_seconds"], f"{path}: fixed_delta_seconds")
            if not 1e-4 <= step_s <= 10:
                raise InputError(f"{path}: fixed_delta_seconds: expected 0.0001 to 10 s, found {step_s:g}")
            return Decimal(str(step_s))
    return 1 / Decimal(RATE_HZ) / least_step


# Who is who.


def _find_own_labels(agents: Scenario, vehicles: list[str], united: UnitedLabels) -> dict[str, str]:
    """By vehicle the id under which others label it: the object at its place in most frames that have both."""
    ids: dict[str, str] = {}
    for name in vehicles:
        shared, at_place = Counter[str](), Counter[str]()
        for number, frame in agents[name].items():
            for ident, label in united[number].items():
                shared[ident] += 1
                at_place[ident] += math.dist(label.pose[:2], frame.pose[:2]) <= _SAME_M
        likely = [ident for ident, count in at_place.items() if 2 * count > shared[ident] and ident not in ids.values()]
        if likely:
            ids[name] = max(likely, key=lambda ident: (at_place[ident], ident == name))
    return ids


def _unite_labels(agents: Scenario, number: int, report: ConversionReport) -> dict[str, _Label]:
    """The labels of all agents at a frame; of those of one object that of the first agent."""
    united: dict[str, _Label] = {}
    for frames_of in agents.values():
        for ident, label in (frames_of[number].labels if number in frames_of else {}).items():
            first = united.setdefault(ident, label)
            if math.dist(first.pose[:2], label.pose[:2]) > _APART_M:
                report.count(
                    "label", f"more than {_APART_M:g} m from that of another agent for the same object: skipped"
                )
    return united


@dataclass(frozen=True)
class _Body:
    """The box of an agent: its kind, size, and centre from its pose, ahead, to the left of the source's y, up."""

    kind: OsiKind
    size_m: tuple[float, float, float]
    offset_m: Float

    def place(self, pose: Float) -> Float:
        """X y z yaw of the box at a pose of the agent."""
        cos, sin = math.cos(pose[3]), math.sin(pose[3])
        ahead, aside, up = self.offset_m
        return np.array(
            [pose[0] + cos * ahead - sin * aside, pose[1] + sin * ahead + cos * aside, pose[2] + up, pose[3]]
        )


def _find_body(
    name: str, agents: Scenario, own_label: str | None, united: UnitedLabels, report: ConversionReport
) -> _Body:
    """The box of an agent, from what others label as it; else of the size of a car."""
    offsets, labels = [], list[_Label]()
    for number, frame in agents[name].items():
        label = united[number].get(own_label) if own_label is not None else None
        if label is not None:
            dx, dy, dz = label.pose[:3] - frame.pose[:3]
            cos, sin = math.cos(frame.pose[3]), math.sin(frame.pose[3])
            offsets.append([cos * dx + sin * dy, cos * dy - sin * dx, dz])
            labels.append(label)
    if labels:
        return _Body(
            _name_kind(labels[0], ConversionReport(report.classes)), labels[0].size_m, np.median(offsets, axis=0)
        )
    up_m = _SIZE_M[2] / 2
    return _Body(KINDS["car"], _SIZE_M, np.array([0, 0, -up_m if next(iter(agents[name].values())).on_roof else up_m]))


def _is_plain_class(name: str) -> bool:
    """Whether it is an `obj_type` of a real recording, not CARLA's `vehicle.tesla.model3`."""
    return "." not in name and class_from_name(name) is not None


def _name_kind(label: _Label, report: ConversionReport) -> OsiKind:
    """The kind of an object, by its `obj_type`, CARLA's `bp_id`, or its length."""
    by_length = "pedestrian" if label.size_m[0] <= _SHORT_M else "vehicle"
    return report.find_kind(label.kind, otherwise=by_length) if label.kind else KINDS[by_length]


# Frames.


def frames(
    source: Path,
    report: ConversionReport,
    *,
    host: str | None = None,
    infrastructure: Iterable[str] = (),
    rate_hz: float | None = None,
    axes: str | None = None,
) -> Iterator[ConvertedFrame]:
    """A scenario. Raises InputError.

    `host`: an agent, None: the first that is a vehicle. `infrastructure`: agents that are none, besides those with
    names below 0. `rate_hz`: of the frames. `axes`: `left` (CARLA's) or `right`, None: by what the files have.
    """
    agents = _read_scenario(source)
    fixed = {name for name, seq in agents.items() if _is_negative(name) or any(frame.fixed for frame in seq.values())}
    for name in (*infrastructure, *([host] if host is not None else [])):
        if name not in agents:
            raise InputError(f"{source}: {unknown_name_message('agent', name, agents)}")
    fixed |= set(infrastructure)
    vehicles = [name for name in agents if name not in fixed]
    if host is not None and host in fixed:
        raise InputError(f"{source}: --host: expected a vehicle, found infrastructure: {host}")
    host = host if host is not None else next(iter(vehicles), None)
    right_handed = axes == "right" or (
        axes is None and any(f.right_handed for seq in agents.values() for f in seq.values())
    )
    numbers = sorted({number for seq in agents.values() for number in seq})
    step_s = _find_step_s(source, numbers, rate_hz)
    united = {number: _unite_labels(agents, number, report) for number in numbers}
    own_labels = _find_own_labels(agents, vehicles, united)
    bodies = {name: _find_body(name, agents, own_labels.get(name), united, report) for name in vehicles}
    ids, name_of = _number_objects(agents, vehicles, own_labels)
    report.names |= {number: name for name, number in ids.items()}
    _say_what_is_assumed(report, agents, fixed, own_labels, step_s, right_handed)
    for number in numbers:
        placed: dict[str, tuple[OsiKind, Float, tuple[float, float, float]]] = {}
        for ident, label in united[number].items():
            placed[ident] = _name_kind(label, report), label.pose, label.size_m
        for name in vehicles:
            if number in agents[name]:
                body = bodies[name]
                placed[name_of[name]] = body.kind, body.place(agents[name][number].pose), body.size_m
        boxes = [_make_box(ids[ident], *what, right_handed) for ident, what in placed.items()]
        stamp_ns = parse_seconds_as_ns((number - numbers[0]) * step_s, f"{source}: frame {number}")
        yield ConvertedFrame(stamp_ns, boxes, host=None if host is None else ids[name_of[host]])


def _make_box(number: int, kind: OsiKind, pose: Float, size_m: tuple[float, float, float], right_handed: bool) -> Box:
    x, y, z, yaw_rad = pose.tolist()
    sign = 1.0 if right_handed else -1.0
    return Box(number, kind, (x, sign * y, z), wrap_yaw(sign * yaw_rad), size_m)


def _number_objects(
    agents: Scenario, vehicles: list[str], own_labels: Mapping[str, str]
) -> tuple[dict[str, int], dict[str, str]]:
    """The numbers of all objects by name, and the names of agents that are vehicles: of their labels, or their own."""
    labelled = dict.fromkeys(ident for own in agents.values() for frame in own.values() for ident in frame.labels)
    name_of = {name: own_labels.get(name, f"agent {name}" if name in labelled else name) for name in vehicles}
    return number_names([*labelled, *name_of.values()]), name_of


def _say_what_is_assumed(
    report: ConversionReport,
    agents: Scenario,
    fixed: set[str],
    own_labels: Mapping[str, str],
    step_s: Decimal,
    right_handed: bool,
) -> None:
    """Report what is assumed about axes, time, truth and each agent; `fixed`: those of infrastructure."""
    sign = 1.0 if right_handed else -1.0
    if right_handed:
        report.assume("axes: y to the left, taken as they are (--axes left: CARLA's)")
    else:
        report.assume(
            "axes: CARLA's, y to the right and yaw with the clock: y and yaw change sign (--axes right: as they are)"
        )
    report.assume(f"time: numbers of frames times {float(step_s):g} s, from the first")
    report.assume("truth: what the agents label; speeds are left out, they have several units: the reader derives them")
    for name, own in agents.items():
        if name in fixed:
            x, y, z, yaw_rad = next(iter(own.values())).lidar.tolist()
            place = f"[{x:.2f}, {sign * y:.2f}], height_m: {z:.2f}, yaw_deg: {math.degrees(sign * yaw_rad):.1f}"
            report.assume(f"agent {name}: infrastructure, no object; its lidar, for a unit: at: {place}")
        elif name in own_labels:
            agent_words = name if name == own_labels[name] else f"{name} (object {own_labels[name]})"
            report.assume(f"agent {agent_words}: an object, of the size that others label")
        else:
            size = "×".join(f"{v:g}" for v in _SIZE_M)
            report.assume(f"agent {name}: an object of {size} m, as no other labels it")
