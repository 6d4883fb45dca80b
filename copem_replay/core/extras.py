"""Extras: what the main job does not need, in `copem_replay/extras/`. The core finds them by this table alone."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from copem_replay.core.errors import InputError

EXTRAS: Final[Mapping[str, Mapping[str, str]]] = {
    "command": {
        "why": "why.command:why",
        "fit": "fitting.command:fit",
        "require": "require.command:require",
        "history": "history.command:history",
        "film": "film.command:film",
        "layout": "layout.command:layout",
        "export": "exports.command:export",
        "convert": "convert.command:app",  # commands of its own, one a data set
    },
    "name of the API": {
        "Explanation": "why.api:Explanation",
        "why": "why.api:why",
        "FittedPem": "fitting.api:FittedPem",
        "fit": "fitting.api:fit",
        "Requirement": "require.api:Requirement",
        "require": "require.api:require",
        "write_requirement": "require.outputs:write_requirement",
        "write_film": "film.film:write_film",
        "write_history": "history.history:write_history",
    },
    "section of the report": {  # in their order; (title, parts), None: nothing to show
        "stories": "stories.stories:write_section",
        "play": "player.player:write_section",
        "why": "why.report:write_section",
    },
    "reader": {"map": "maps.registry:read_map", "map format": "maps.registry:find_format"},
    "preview": {"fit": "fitting.fit:preview_fit"},
    "workers": {
        "executor": "cluster.crew:gather_crew",
        "cluster": "cluster.command:connect_crew",
        "address": "cluster.dask_workers:check_address",
    },
}
"""Place below `copem_replay.extras` by kind and name."""
_PACKAGE: Final = "copem_replay.extras"
_FOLDER: Final = Path(__file__).parents[1] / "extras"


def load_extra(kind: str, name: str) -> Any:
    """The function, class or app of an extra. Raises InputError where a folder that it needs is not there."""
    module, _, attribute = EXTRAS[kind][name].partition(":")
    extra = module.partition(".")[0]
    try:
        if not (_FOLDER / extra).is_dir():
            raise ModuleNotFoundError(name=f"{_PACKAGE}.{extra}")
        return getattr(import_module(f"{_PACKAGE}.{module}"), attribute)
    except ModuleNotFoundError as error:
        missing = error.name or ""
        if not missing.startswith(_PACKAGE):
            raise
        place = "/".join(missing.split(".")[:3])
        expected = f"expected {place}, found an installation without it"
        raise InputError(f"{kind} {name}: {expected}; install copem-replay whole") from None


def has_extra(kind: str, name: str) -> bool:
    """Whether the extra is installed."""
    try:
        load_extra(kind, name)
    except InputError:
        return False
    return True
