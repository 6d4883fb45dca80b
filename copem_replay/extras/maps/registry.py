"""Which map formats there are, and what tells them apart: a file's content, never its name."""

from __future__ import annotations

import json
import mmap
import re
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, Final, NamedTuple

from copem_replay.core.errors import InputError
from copem_replay.core.site_map import SiteMap
from copem_replay.experiment.maps import DEFAULT_HEIGHTS_M
from copem_replay.io.containers.mcap_records import MAGIC

_LANELET: Final = re.compile(rb"""v\s*=\s*["']lanelet["']""")


class _Candidate(NamedTuple):
    """A file as formats are told by it."""

    path: Path
    head: bytes  # its first 4,096 bytes
    content: dict[str, Any] | None  # of JSON; None: it is none

    def has_lanelets(self) -> bool:
        """Whether a relation is a lanelet: looked for in the whole file."""
        with self.path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
            return _LANELET.search(data) is not None


def _has_key(name: str) -> Callable[[_Candidate], bool]:
    return lambda file: file.content is not None and name in file.content


def _is_geojson(file: _Candidate) -> bool:
    return file.content is not None and file.content.get("type") in ("FeatureCollection", "Feature")


FORMATS: Final[dict[str, tuple[Callable[[_Candidate], bool], str]]] = {
    "OpenDRIVE": (lambda file: b"<OpenDRIVE" in file.head, "copem_replay.extras.maps.opendrive:read_opendrive"),
    "Lanelet2": (
        lambda file: b"<osm" in file.head and file.has_lanelets(), "copem_replay.extras.maps.lanelet2:read_lanelet2",
    ),
    "OpenStreetMap": (lambda file: b"<osm" in file.head, "copem_replay.extras.maps.osm:read_osm"),
    "Overpass": (_has_key("elements"), "copem_replay.extras.maps.osm:read_overpass"),
    "GeoJSON": (_is_geojson, "copem_replay.extras.maps.geojson:read_geojson"),
    "Argoverse 2": (_has_key("lane_segments"), "copem_replay.extras.maps.argoverse2:read_argoverse2_map"),
    "OpenDRIVE in a recording": (
        lambda file: file.head.startswith(MAGIC), "copem_replay.extras.maps.opendrive:read_embedded_map",
    ),
}  # fmt: skip
"""By name: whether a file is of this format, and the function that reads it.

It is called with the path, the content if it is JSON, and the heights where a map does not say them."""
_MOST_BYTES: Final = 64_000_000
"""Of a file of JSON: maps of drives have 1 MB, and what is parsed takes ten times as much memory."""


def read_map(path: Path, heights_m: Mapping[str, float] = DEFAULT_HEIGHTS_M) -> SiteMap:
    """Read a map of any format, with heights by kind where it does not say. Raises InputError: no file, or no map."""
    file = _open_candidate(path)
    if b"OSMHeader" in file.head[:64]:
        line = "osmium extract -b WEST,SOUTH,EAST,NORTH"
        raise InputError(f"{path}: expected XML of OpenStreetMap, found PBF; cut it: `{line} {path.name} -o site.osm`")
    for is_format, function in FORMATS.values():
        if is_format(file):
            module, _, name = function.partition(":")
            read: Callable[..., SiteMap] = getattr(import_module(module), name)
            return read(path, *([file.content] if file.content is not None else []), heights_m)
    raise InputError(f"{path}: expected a map of {', '.join(FORMATS)}, found none of them")


def find_format(path: Path) -> str | None:
    """The name of the format of a map; None: the file is none, or cannot be read."""
    try:
        file = _open_candidate(path)
        return next((name for name, (is_format, _) in FORMATS.items() if is_format(file)), None)
    except InputError:
        return None


def _open_candidate(path: Path) -> _Candidate:
    """A file as formats are told by it. Raises InputError: it cannot be read, or begins as JSON and is none."""
    try:
        with path.open("rb") as stream:
            head = stream.read(4096)
    except OSError as error:
        raise InputError(f"{path}: cannot be opened: {error.strerror}") from None
    parsed = read_json(path) if head.lstrip(b"\xef\xbb\xbf \t\r\n")[:1] in (b"{", b"[") else None
    return _Candidate(path, head, parsed if isinstance(parsed, dict) else None)


def read_json(path: Path) -> Any:
    """The content of a JSON file. Raises InputError with file and line; NaN and Infinity are no JSON."""
    try:
        size = path.stat().st_size
        if size > _MOST_BYTES:
            raise InputError(
                f"{path}: expected JSON of at most {_MOST_BYTES // 1_000_000} MB, found {size / 1e6:.0f} MB"
            )
        return json.loads(path.read_bytes(), parse_constant=_refuse_constant)
    except OSError as error:
        raise InputError(f"{path}: cannot be opened: {error.strerror}") from None
    except json.JSONDecodeError as error:
        raise InputError(
            f"{path}:{error.lineno}: expected JSON, found something else or its end: {error.msg}"
        ) from None
    except RecursionError:
        raise InputError(f"{path}: expected JSON of a map, found values nested without end") from None
    except ValueError as error:  # not UTF-8, a constant, a number of too many digits
        raise InputError(f"{path}: expected JSON, found something else: {error}") from None


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is no number of JSON")
