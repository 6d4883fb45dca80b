"""Folders of ScenarioNet: a pickle per scenario, in folders of their own per worker, and two that say what there is.

`dataset_mapping.pkl` names the files, and the folder of each from where it lies: a data set may be nothing but that,
put together of others. Without it all pickles in the folder and below are its scenarios.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from copem_replay.core.errors import InputError
from copem_replay.io.convert import restricted_pickle
from copem_replay.io.convert.parse import shown

_MAPPING: Final = "dataset_mapping.pkl"
_SUMMARY: Final = "dataset_summary.pkl"  # of the metadata, which the scenarios have themselves


def scenarios(folder: Path) -> dict[str, Path]:
    """Files of the scenarios, in order of their names, by these names without the ending. Raises InputError."""
    mapping = folder / _MAPPING
    files = _mapped(mapping) if mapping.is_file() else sorted(folder.rglob("*.pkl"))
    found: dict[str, Path] = {}
    for path in sorted(files, key=lambda path: path.name):
        if path.name in (_MAPPING, _SUMMARY):
            continue
        if (other := found.setdefault(path.stem, path)) != path:
            raise InputError(f"{folder}: expected one scenario {path.stem}, found {other} and {path}")
    if not found:
        raise InputError(f"{folder}: expected scenarios of ScenarioNet, found no *.pkl in the folder")
    return found


def _mapped(mapping: Path) -> list[Path]:
    places = restricted_pickle.load(mapping)
    if not isinstance(places, dict):
        raise InputError(f"{mapping}: expected the folder of each scenario by its file, found {type(places).__name__}")
    for name, place in places.items():
        if not (isinstance(name, str) and isinstance(place, str)) or not name or Path(name).name != name:
            raise InputError(f"{mapping}: expected files and their folders, found {shown(name)} in {shown(place)}")
    return [mapping.parent / place / name for name, place in places.items()]
