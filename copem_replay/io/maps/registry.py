"""Which map formats there are, and what tells them apart: a file's content, never its name."""

from __future__ import annotations

import json
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from copem_replay.core.errors import InputError
from copem_replay.core.site_map import SiteMap

FORMATS: Final[dict[str, tuple[Callable[[bytes], bool], str]]] = {
    "OpenDRIVE": (lambda head: b"<OpenDRIVE" in head, "copem_replay.io.maps.opendrive:read_opendrive"),
    "Lanelet2": (lambda head: b"<osm" in head, "copem_replay.io.maps.lanelet2:read_lanelet2"),
    "Argoverse 2": (lambda head: head.lstrip()[:1] == b"{", "copem_replay.io.maps.argoverse2:read_argoverse2_map"),
}
"""By name: whether the first 4,096 bytes of a file are of this format, and the function that reads it."""
_MOST_BYTES: Final = 64_000_000
"""Of a file of JSON: maps of drives have 1 MB, and what is parsed takes ten times as much memory."""


def read_map(path: Path) -> SiteMap:
    """Read a map of any format. Raises InputError: no such file, or no map."""
    try:
        with path.open("rb") as stream:
            head = stream.read(4096)
    except OSError as error:
        raise InputError(f"{path}: cannot be opened: {error.strerror}") from None
    for is_format, function in FORMATS.values():
        if is_format(head):
            module, _, name = function.partition(":")
            read: Callable[[Path], SiteMap] = getattr(import_module(module), name)
            return read(path)
    raise InputError(f"{path}: expected a map of {', '.join(FORMATS)}, found none of them")


def read_json(path: Path) -> Any:
    """What a file of JSON holds. Raises InputError with file and line; NaN and Infinity are no JSON."""
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
