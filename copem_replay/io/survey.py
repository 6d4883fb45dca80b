"""What is known of a recording from before: so much that it is read again only where its objects are needed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from copem_replay.io.recording import Recording


@dataclass(frozen=True)
class Survey:
    """`said`: as it was kept. `read`: the recording, as it was read then. `about`: what it was found by."""

    said: Mapping[str, Any]
    read: Callable[[], Recording]
    about: str = ""


def whole(recording: Recording) -> Recording:
    """A recording with its truth and its lists: itself, unless only a survey of it is there."""
    if recording.survey is None:
        return recording
    return replace(recording.survey.read(), scene=recording.scene, notes=recording.notes)
