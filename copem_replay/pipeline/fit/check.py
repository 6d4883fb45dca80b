"""The replay check of a fit: on passes it has not seen, where there are any, and beside it the same without memory."""

from __future__ import annotations

from dataclasses import replace

from copem_replay.core.yaml import without_notes
from copem_replay.perception.pem.model import Pem
from copem_replay.perception.unit_errors import PoseError
from copem_replay.pipeline.fit.fit import Fit, ReplayChecks
from copem_replay.pipeline.fit.model import pem_of
from copem_replay.pipeline.fit.replay_check import Check, replay_check, without_memory


def checked(fit: Fit, *, seed: int = 0) -> Fit:
    """The fit with its replay check."""
    gathered = fit.held or fit.gathered
    pem = Pem.model_validate(without_notes(pem_of(fit)))
    keys = fit.parts.rest.placed.keys()
    placed = PoseError.model_validate(keys) if keys else None
    mine = replay_check(pem, gathered.rows, gathered.lists, placed=placed, seed=seed)
    fresh: tuple[Check, ...] = ()
    if pem.remembers:
        always_new = None if placed is None else placed.model_copy(update={"memory": None})
        fresh = replay_check(without_memory(pem), gathered.rows, gathered.lists, placed=always_new, seed=seed)
    return replace(fit, checks=ReplayChecks(fit.held is not None, mine, fresh))
