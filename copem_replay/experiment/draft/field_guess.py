"""Which fields of messages of an unknown schema look like a list of objects, by their names: `read:`, to begin with."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

from copem_replay.io.encodings.columns import level_of, levels_to
from copem_replay.io.schemas.timestamps import UNIT_NS, stamps_in

NEEDED = ("id", "x_m", "y_m", "length_m", "width_m")
"""Without these there are no true objects."""
_AXES = ("x", "y", "z")
_PLACE = r"(?:pos(?:ition)?|cent(?:er|re)|loc(?:ation)?|translation|coordinates?|place|point|xyz)"
_SIZE = r"(?:size|dimensions?|dims?|extents?|scale|lwh)"
_SPEED = r"(?:velocity|vel|speed|linear)"
_NO_PLACE = re.compile(
    r"(?i)vel|twist|linear|angular|accel|size|dim|extent|scale|orient|quat|rotat|covar|std|sigma|colou?r|offset|min|max"
    r"|prev|predict|path|future|goal|footprint|polygon|corner|vertex|vertices"
)
_IDS = (
    "id",
    "track_id",
    "object_id",
    "tracking_id",
    "obj_id",
    "objectid",
    "trackid",
    "uuid",
    "uid",
    "identifier",
    "track",
)
_INNER_IDS = ("uuid", "value", "id")
_CLASSES = (
    "class", "class_name", "classname", "class_id", "category", "category_name", "classification", "label",
    "object_type", "object_class", "obj_type", "type", "kind", "subtype",
)  # fmt: skip
_STAMPS = ("header.stamp", "header.timestamp", "timestamp", "stamp", "header.time", "time", "t", "measurement_time")
_FRAMES = ("header.frame_id", "frame_id", "header.frame", "frame")
_FLAT = {
    "x_m": ("x_m", "y_m", "z_m"),
    "easting": ("easting", "northing", "altitude"),
    "utm_x": ("utm_x", "utm_y"),
}
_DAY_NS = 86_400 * 10**9


def propose(
    offers: Mapping[str, str], stamped: Mapping[str, Sequence[str]], log_time_ns: Sequence[int]
) -> tuple[dict[str, Any], list[str]] | None:
    """The likeliest fields, `read:` without its topic, and needed keys nothing was found for.

    None where no list has anything of an object.

    `stamped`: of paths that may be time stamps the words of the messages logged at `log_time_ns`, for their units.
    """
    best: tuple[tuple[int, int, int], dict[str, Any], list[str]] | None = None
    for level in levels_to(offers):
        if not level:
            continue
        inside = {path[len(level) + 1 :]: what for path, what in offers.items() if path.startswith(f"{level}.")}
        found = {key: choices[0] for key, choices in _of_object(inside) if choices}
        missing = [key for key in NEEDED if key not in found]
        if {"x_m", "y_m"} & {*missing} or len(missing) > 3:
            continue
        rank = (-len(missing), len(found), -level.count("[]"))
        if best is None or rank > best[0]:
            best = rank, {"objects": level, **found}, missing
    if best is None:
        return None
    _, read, missing = best
    head = {"objects": read["objects"]}
    if (stamp := _stamp(offers, stamped, log_time_ns)) is not None:
        head["stamp"] = stamp
    if (frame := next((p for p in _FRAMES if offers.get(p) == "text"), None)) is not None:
        head["frame"] = frame
    return head | read, missing


def stamp_paths(offers: Collection[str]) -> list[str]:
    """Paths of a message that may say its time."""
    return [path for name in _STAMPS for path in stamps_in(offers, name)[:1] if "[" not in path]


def _stamp(offers: Collection[str], stamped: Mapping[str, Sequence[str]], log_time_ns: Sequence[int]) -> Any:
    """The first that is a time: of two parts, a date, or a number that in some unit is near the time of logging."""
    for name in _STAMPS:
        paths = stamps_in(offers, name)
        if len(paths) == 2:
            return name
        for path in paths:
            words = stamped.get(path, ())
            if words and re.match(r"\d{4}-\d\d-\d\d[T ]", words[0]):
                return path
            try:
                apart = {
                    unit: max(abs(float(w) * scale - t) for w, t in zip(words, log_time_ns, strict=False))
                    for unit, scale in UNIT_NS.items()
                }
            except ValueError:  # no number, or no message
                continue
            unit = min(apart, key=lambda name: apart[name])
            if apart[unit] < _DAY_NS:
                return path if unit == "s" else {"path": path, "unit": unit}
    return None


def _of_object(inside: Mapping[str, str]) -> Iterator[tuple[str, list[Any]]]:
    """What an object may have of each key, the likeliest first."""
    plain = {path: what for path, what in inside.items() if "[]" not in path}
    numbers = [path for path, what in plain.items() if what == "number"]
    yield "id", _named(plain, _IDS, _INNER_IDS)
    yield "class", _classes(inside)
    places = [at for at in _vectors(inside, _PLACE, bare=True) if not _NO_PLACE.search(at[0].rpartition(".")[0])]
    for k, axis in enumerate(_AXES):
        yield f"{axis}_m", [at[k] for at in places if len(at) > k]
    yield "yaw_rad", _yaws(inside, numbers)
    sizes = _vectors(inside, _SIZE)
    for k, side in enumerate(("length", "width", "height")):
        # a lone `w` is of a quaternion, say
        both = [p for p in numbers if len(p.rpartition(".")[2]) > 1 or {p[:-1] + "l", p[:-1] + "w"} <= {*numbers}]
        named = _named(dict.fromkeys(both, "number"), (side, f"{side}_m", side[0]), ())
        yield f"{side}_m", named or [at[k] for at in sizes if len(at) > k]
    speeds = [at for at in _vectors(inside, _SPEED) if not re.search(r"(?i)angular|accel|covar|std", at[0])]
    flat = [[x, y] for x, y in (("vx", "vy"), ("vx_mps", "vy_mps"), ("vel_x", "vel_y")) if {x, y} <= {*numbers}]
    for k, axis in enumerate("xy"):
        yield f"v{axis}_mps", [at[k] for at in [*flat, *speeds]][:1]


def _named(paths: Mapping[str, str], names: Sequence[str], inner: Sequence[str]) -> list[Any]:
    """Paths that end with one of these names, or with `inner` of one: in the order of the names, outer ones first."""

    def place(path: str) -> tuple[int, int] | None:
        parts = path.lower().split(".")
        if len(parts) > 1 and parts[-1] in inner and parts[-2] in names:
            return names.index(parts[-2]), len(parts)
        return (names.index(parts[-1]), len(parts)) if parts[-1] in names else None

    ranked = [(rank, path) for path in paths if (rank := place(path)) is not None]
    return [path for _, path in sorted(ranked)]


def _classes(inside: Mapping[str, str]) -> list[Any]:
    """A field, or the one of a list of guesses, with its probability."""
    single = _named({p: w for p, w in inside.items() if "[]" not in p}, _CLASSES, ("label", "class_id", "name", "type"))
    lists = []
    for path in _named(
        {p: w for p, w in inside.items() if p.count("[]") == 1}, _CLASSES, ("label", "class_id", "name")
    ):
        beside = level_of(path)
        share = next(
            (f"{beside}.{n}" for n in ("probability", "score", "confidence") if f"{beside}.{n}" in inside), None
        )
        if path != beside:
            lists.append({"path": path} | ({"probability": share} if share else {}))
    return [*lists, *single] if lists and not any(inside[p] == "text" for p in single) else [*single, *lists]


def _vectors(inside: Mapping[str, str], kind: str, *, bare: bool = False) -> list[list[str]]:
    """Fields x, y and z of a structure named so, `kind_x`, or items of a list; `bare`: or of the object itself."""
    found: dict[str, list[str]] = {}
    for path, what in inside.items():
        if what != "number":
            continue
        head, _, last = path.rpartition(".")
        name = head.rpartition(".")[2]
        axes: Sequence[str] | None = _FLAT.get(last.lower()) if bare else None
        if last == "x" and (re.fullmatch(f"(?i).*{kind}", name) or (bare and name in ("", "pose"))):
            axes = _AXES
        if axes is not None:
            found[path] = [f"{head}.{axis}" if head else axis for axis in axes]
        elif re.fullmatch(f"(?i){kind}_x(_m)?", last):
            found[path] = [re.sub(r"(?i)_x(?=(_m)?$)", f"_{axis}", path) for axis in _AXES]
        elif path.endswith("[]") and path.count("[]") == 1 and re.fullmatch(f"(?i).*{kind}", last.removesuffix("[]")):
            found[path] = [f"{path.removesuffix('[]')}[{k}]" for k in range(3)]
    vectors = []
    for path, whole in found.items():
        there = whole if path.endswith("[]") else [axis for axis in whole if inside.get(axis) == "number"]
        if len(there) >= 2 and there[:2] == whole[:2]:
            vectors.append(there)
    return sorted(vectors, key=lambda at: (at[0].count("."), at[0]))


def _yaws(inside: Mapping[str, str], numbers: Sequence[str]) -> list[Any]:
    plain = dict.fromkeys(numbers, "number")
    radians = _named(plain, ("yaw", "yaw_rad", "heading", "heading_rad", "psi", "theta", "rotation_z", "rz"), ())
    degrees = _named(plain, ("yaw_deg", "heading_deg", "yaw_degrees", "heading_degrees"), ())
    turned = [
        {"quaternion": head}
        for path in numbers
        if (head := path.rpartition(".")[0]) and path.endswith(".w") and all(f"{head}.{a}" in inside for a in _AXES)
    ]
    return [*radians, *({"degrees": path} for path in degrees), *turned]
