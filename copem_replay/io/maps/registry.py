"""Which map formats there are, and what tells them apart: a file's content, never its name."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Final

from copem_replay.core.errors import InputError
from copem_replay.core.site_map import SiteMap

FORMATS: Final[dict[str, tuple[Callable[[bytes], bool], str]]] = {
    "OpenDRIVE": (lambda head: b"<OpenDRIVE" in head, "copem_replay.io.maps.opendrive:read_opendrive"),
    "Lanelet2": (lambda head: b"<osm" in head, "copem_replay.io.maps.lanelet2:read_lanelet2"),
    "Argoverse 2": (lambda head: head.lstrip()[:1] == b"{", "copem_replay.io.maps.argoverse2:read_argoverse2_map"),
}
"""By name: whether the first 4,096 bytes of a file are of this format, and the function that reads it."""


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
