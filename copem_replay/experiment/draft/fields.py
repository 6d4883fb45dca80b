"""Proposals of `read:` for messages of an unknown schema, by the names of their fields; tried on the recording."""

from __future__ import annotations

import itertools
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from pydantic import ValidationError

from copem_replay.core.errors import RecordingError
from copem_replay.experiment.draft.findings import ProposalFound
from copem_replay.io.channel import Channel, DefinitionError
from copem_replay.io.encodings import make_definition
from copem_replay.io.encodings.columns import list_level, list_levels, shred_messages
from copem_replay.io.log import BrokenIndexError, Log
from copem_replay.io.recording import Recording, foreign_channels, read_log
from copem_replay.io.schemas.description import Fields
from copem_replay.io.schemas.poses import is_pose
from copem_replay.io.schemas.registry import is_list
from copem_replay.io.stamps import UNIT_NS, find_stamp_paths

NEEDED = ("id", "x_m", "y_m", "length_m", "width_m")
"""Keys without which no true object can be read."""
_AXES = ("x", "y", "z")
_PLACE = r"(?:pos(?:ition)?|cent(?:er|re)|loc(?:ation)?|translation|coordinates?|place|point|xyz)"
_SIZE = r"(?:size|dimensions?|dims?|extents?|scale|lwh)"
_SPEED = r"(?:velocity|vel|speed|linear)"
_NO_PLACE = re.compile(
    r"(?i)vel|twist|linear|angular|accel|size|dim|extent|scale|orient|quat|rotat|covar|std|sigma|colou?r|offset|min|max"
    r"|prev|predict|path|future|goal|footprint|polygon|corner|vertex|vertices"
)
_IDS = (
    "id", "track_id", "object_id", "tracking_id", "obj_id", "objectid", "trackid", "uuid", "uid", "identifier", "track",
)  # fmt: skip
_INNER_IDS = ("uuid", "value", "id")
_CLASSES = (
    "class", "class_name", "classname", "class_id", "category", "category_name", "classification", "label",
    "object_type", "object_class", "obj_type", "type", "kind", "subtype",
)  # fmt: skip
_STAMPS = ("header.stamp", "header.timestamp", "timestamp", "stamp", "header.time", "time", "t", "measurement_time")
_FRAMES = ("header.frame_id", "frame_id", "header.frame", "frame")
_FLAT = {"x_m": ("x_m", "y_m", "z_m"), "easting": ("easting", "northing", "altitude"), "utm_x": ("utm_x", "utm_y")}
_DAY_NS = 86_400 * 10**9


def propose_fields(
    offers: Mapping[str, str], stamped: Mapping[str, Sequence[str]], log_time_ns: Sequence[int]
) -> tuple[dict[str, Any], list[str]] | None:
    """The likeliest fields, `read:` without its topic, and the needed keys without a field.

    None where no list looks like objects. `stamped`: by path of a possible time stamp its words in the messages logged
    at `log_time_ns`, from which the unit is told.
    """
    best: tuple[tuple[int, int, int], dict[str, Any], list[str]] | None = None
    for level in list_levels(offers):
        if not level:
            continue
        inside = {path[len(level) + 1 :]: what for path, what in offers.items() if path.startswith(f"{level}.")}
        fields = {key: choices[0] for key, choices in _guess_object_fields(inside) if choices}
        missing = [key for key in NEEDED if key not in fields]
        if {"x_m", "y_m"} & {*missing} or len(missing) > 3:
            continue
        rank = (-len(missing), len(fields), -level.count("[]"))
        if best is None or rank > best[0]:
            best = rank, {"objects": level, **fields}, missing
    if best is None:
        return None
    _, read, missing = best
    head = {"objects": read["objects"]}
    if (stamp := _guess_stamp(offers, stamped, log_time_ns)) is not None:
        head["stamp"] = stamp
    if (frame := next((p for p in _FRAMES if offers.get(p) == "text"), None)) is not None:
        head["frame"] = frame
    return head | read, missing


def stamp_paths(offers: Collection[str]) -> list[str]:
    """Paths of a message that may hold its time."""
    return [path for name in _STAMPS for path in find_stamp_paths(offers, name)[:1] if "[" not in path]


def _guess_stamp(offers: Collection[str], stamped: Mapping[str, Sequence[str]], log_time_ns: Sequence[int]) -> Any:
    """The first path that is a time: two parts, a date, or a number that in some unit is near the time of logging."""
    for name in _STAMPS:
        paths = find_stamp_paths(offers, name)
        if len(paths) == 2:
            return name
        for path in paths:
            words = stamped.get(path, ())
            if words and re.match(r"\d{4}-\d\d-\d\d[T ]", words[0]):
                return path
            try:
                offset_ns = {
                    unit: max(abs(float(w) * scale - t) for w, t in zip(words, log_time_ns, strict=False))
                    for unit, scale in UNIT_NS.items()
                }
            except ValueError:  # no number, or no message
                continue
            unit = min(offset_ns, key=lambda name: offset_ns[name])
            if offset_ns[unit] < _DAY_NS:
                return path if unit == "s" else {"path": path, "unit": unit}
    return None


def _guess_object_fields(kind_of: Mapping[str, str]) -> Iterator[tuple[str, list[Any]]]:
    """By key of `read:` the paths that an object may have for it, the likeliest first; `kind_of`: by path."""
    single_values = {path: what for path, what in kind_of.items() if "[]" not in path}
    numbers = [path for path, what in single_values.items() if what == "number"]
    yield "id", _match_names(single_values, _IDS, _INNER_IDS)
    yield "class", _guess_classes(kind_of)
    places = [at for at in _guess_vectors(kind_of, _PLACE, bare=True) if not _NO_PLACE.search(at[0].rpartition(".")[0])]
    for k, axis in enumerate(_AXES):
        yield f"{axis}_m", [at[k] for at in places if len(at) > k]
    yield "yaw_rad", _guess_yaws(kind_of, numbers)
    sizes = _guess_vectors(kind_of, _SIZE)
    for k, side in enumerate(("length", "width", "height")):
        # a single letter counts only where `l` and `w` are both there: a lone `w` may be of a quaternion
        both = [p for p in numbers if len(p.rpartition(".")[2]) > 1 or {p[:-1] + "l", p[:-1] + "w"} <= {*numbers}]
        named_sides = _match_names(dict.fromkeys(both, "number"), (side, f"{side}_m", side[0]), ())
        yield f"{side}_m", named_sides or [at[k] for at in sizes if len(at) > k]
    speeds = [at for at in _guess_vectors(kind_of, _SPEED) if not re.search(r"(?i)angular|accel|covar|std", at[0])]
    flat_speeds = [[x, y] for x, y in (("vx", "vy"), ("vx_mps", "vy_mps"), ("vel_x", "vel_y")) if {x, y} <= {*numbers}]
    for k, axis in enumerate("xy"):
        yield f"v{axis}_mps", [at[k] for at in [*flat_speeds, *speeds]][:1]


def _match_names(paths: Mapping[str, str], names: Sequence[str], inner: Sequence[str]) -> list[Any]:
    """Paths that end with one of these names, or with `inner` of one: in the order of the names, outer ones first."""

    def place(path: str) -> tuple[int, int] | None:
        parts = path.lower().split(".")
        if len(parts) > 1 and parts[-1] in inner and parts[-2] in names:
            return names.index(parts[-2]), len(parts)
        return (names.index(parts[-1]), len(parts)) if parts[-1] in names else None

    ranked = [(rank, path) for path in paths if (rank := place(path)) is not None]
    return [path for _, path in sorted(ranked)]


def _guess_classes(kind_of: Mapping[str, str]) -> list[Any]:
    """Paths of the class, the likeliest first; one in a list of guesses with the probability beside it."""
    single = _match_names(
        {p: w for p, w in kind_of.items() if "[]" not in p}, _CLASSES, ("label", "class_id", "name", "type")
    )
    lists = []
    for path in _match_names(
        {p: w for p, w in kind_of.items() if p.count("[]") == 1}, _CLASSES, ("label", "class_id", "name")
    ):
        level = list_level(path)
        share = next(
            (f"{level}.{n}" for n in ("probability", "score", "confidence") if f"{level}.{n}" in kind_of), None
        )
        if path != level:
            lists.append({"path": path} | ({"probability": share} if share else {}))
    return [*lists, *single] if lists and not any(kind_of[p] == "text" for p in single) else [*single, *lists]


def _guess_vectors(kind_of: Mapping[str, str], kind: str, *, bare: bool = False) -> list[list[str]]:
    """Vectors, by paths of their axes: x, y, z of a structure `kind`, `kind_x`, or list items; `bare`: unnamed too."""
    candidates: dict[str, list[str]] = {}
    for path, what in kind_of.items():
        if what != "number":
            continue
        parent_path, _, last = path.rpartition(".")
        name = parent_path.rpartition(".")[2]
        axes: Sequence[str] | None = _FLAT.get(last.lower()) if bare else None
        if last == "x" and (re.fullmatch(f"(?i).*{kind}", name) or (bare and name in ("", "pose"))):
            axes = _AXES
        if axes is not None:
            candidates[path] = [f"{parent_path}.{axis}" if parent_path else axis for axis in axes]
        elif re.fullmatch(f"(?i){kind}_x(_m)?", last):
            candidates[path] = [re.sub(r"(?i)_x(?=(_m)?$)", f"_{axis}", path) for axis in _AXES]
        elif path.endswith("[]") and path.count("[]") == 1 and re.fullmatch(f"(?i).*{kind}", last.removesuffix("[]")):
            candidates[path] = [f"{path.removesuffix('[]')}[{k}]" for k in range(3)]
    vectors = []
    for path, components in candidates.items():
        numbers = components if path.endswith("[]") else [axis for axis in components if kind_of.get(axis) == "number"]
        if len(numbers) >= 2 and numbers[:2] == components[:2]:
            vectors.append(numbers)
    return sorted(vectors, key=lambda at: (at[0].count("."), at[0]))


def _guess_yaws(kind_of: Mapping[str, str], numbers: Sequence[str]) -> list[Any]:
    plain = dict.fromkeys(numbers, "number")
    radians = _match_names(plain, ("yaw", "yaw_rad", "heading", "heading_rad", "psi", "theta", "rotation_z", "rz"), ())
    degrees = _match_names(plain, ("yaw_deg", "heading_deg", "yaw_degrees", "heading_degrees"), ())
    quaternions = [
        {"quaternion": head}
        for path in numbers
        if (head := path.rpartition(".")[0]) and path.endswith(".w") and all(f"{head}.{a}" in kind_of for a in _AXES)
    ]
    return [*radians, *({"degrees": path} for path in degrees), *quaternions]


# Proposals for the channels of a recording, tried on it.

_CHANNELS = 30
"""Channels of a recording that are tried, at most; more: slower."""
_SAMPLES = 50
"""Messages of each channel that are looked at, at most; more: slower."""
_OFFERS = 40
"""Fields that are listed where not all were found, at most: about a screen."""


def try_proposals(log: Log, name: str) -> Iterator[tuple[ProposalFound, Recording | None]]:
    """Each channel that looks like a list of objects, and the recording as read so; None where it cannot be."""
    unknown = [c for c in foreign_channels(log) if not is_list(c) and not is_pose(c)]
    for channel in unknown[:_CHANNELS]:
        try:
            proposal = _propose_channel(log, channel)
        except (DefinitionError, BrokenIndexError, RecordingError):
            continue
        if proposal is None:
            continue
        recording, problem = None, None
        if not proposal.missing:
            try:
                recording = read_log(log, name=name, topic=channel.topic, fields=parse_fields(proposal))
            except RecordingError as error:
                problem = "; ".join(error.within(log.path))
            except BrokenIndexError as error:
                problem = error.reason
            except ValidationError as error:
                problem = str(error)
        yield replace(proposal, problem=problem), recording


def parse_fields(proposal: ProposalFound) -> Fields:
    """The proposed fields. Raises ValidationError."""
    return Fields.model_validate({key: value for key, value in proposal.read.items() if key != "topic"})


def _propose_channel(log: Log, channel: Channel) -> ProposalFound | None:
    """A proposal of `read:` for the messages of a channel; None: nothing in them looks like objects."""
    samples = list(itertools.islice(log.payloads(frozenset({channel.number})), _SAMPLES))
    payloads, times = [data for _, _, data in samples], [at for _, at, _ in samples]
    definition = make_definition(channel, payloads)
    offers = definition.offers()
    paths = stamp_paths(offers)
    level = shred_messages(definition, payloads, texts=paths).levels[""]
    words = {p: [level.texts[p].words[k] if k >= 0 else "" for k in level.texts[p].code] for p in paths}
    proposal = propose_fields(offers, words, [times[m] for m in level.parent])
    if proposal is None:
        return None
    return ProposalFound(
        topic=channel.topic,
        schema=channel.schema,
        read={"topic": channel.topic, **proposal[0]},
        missing=proposal[1],
        offers=list(offers)[:_OFFERS],
    )
