"""Import paths of version 0.1 that own models used: importing one says where its names are now. For one release."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from types import ModuleType

MOVED = {
    "copem_replay.braking": "Driver, Reaction",
    "copem_replay.fusion.component": "StepFusion, ListFusion, Inbox",
    "copem_replay.fusion.object_list": "ObjectLists, Inputs, entries_of",
    "copem_replay.pem": "DetectionModel, ErrorModel, ViewGeometry, Errors",
    "copem_replay.testing": "check_fusion, FUSION_RULES, NonconformingError",
    "copem_replay.tracks": "Tracks, Scene, CLASSES",
}
"""By module or package, the public names that took its place."""


class _Signpost:
    """A finder that is asked last and finds nothing."""

    def find_spec(self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> None:
        """Raise ModuleNotFoundError where a module has moved."""
        if name in MOVED:
            raise ModuleNotFoundError(f"{name} has moved; `import copem_replay as cr` has {MOVED[name]}", name=name)


def put_up_signposts() -> None:
    """Have old import paths answer with the new names."""
    if not any(isinstance(finder, _Signpost) for finder in sys.meta_path):
        sys.meta_path.append(_Signpost())
