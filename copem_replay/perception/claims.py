"""Claims of entries beside their states: existence, class probabilities, and the unit's own track id.

Where nothing of it is drawn it is the same in all runs; what is drawn is asked for one run at a time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.draws import Draws
from copem_replay.core.lasting import renewal_stamps
from copem_replay.core.random import RandomKey
from copem_replay.core.tracks import CLASSES, Float, Int
from copem_replay.perception.observation import Observations, rows_by_unit
from copem_replay.perception.pem.scores import Claimed, Scores

if TYPE_CHECKING:
    from copem_replay.perception.config import PerceptionSetup
    from copem_replay.perception.pem.model import Pem

TRACK_ID_BITS = 52
"""Of a track id (chosen: JSON has no more; of a million ids two are equal with probability 1e-4)."""


@dataclass(frozen=True)
class DrawnClaims:
    """Row by row: existence (P,), class probabilities (P, C) and track ids (P,), −1: none."""

    existence: Float
    class_probability: Float
    track_id: Int


def claims_of(found: Observations, setup: PerceptionSetup, draws: Draws, ghost_sort: Int | None = None) -> DrawnClaims:
    """What the units claim of rows (P,) in one run, the one of `draws`.

    `ghost_sort (P,)`: the rows are ghosts, of these sorts of their PEMs; None: they are objects.
    """
    claims = DrawnClaims(
        found.existence.copy(), np.eye(len(CLASSES))[found.view.class_ix], np.full(len(found.couple_ix), -1)
    )
    for unit, rows in zip(setup.modelled.values(), rows_by_unit(found.tracks), strict=True):
        pem = setup.pems[str(unit.pem)]
        if not len(rows) or not pem.draws_claims:
            continue
        mine = draws.take(rows)
        sort = None if ghost_sort is None else ghost_sort[rows]
        claims.existence[rows] = _existence(pem, found, rows, mine, sort)
        claims.class_probability[rows] = _classes(pem, found, rows, mine, of_ghosts=sort is not None)
        if pem.tracks is not None:
            claims.track_id[rows] = _track_ids(mine, pem.tracks.lasts_s)
    return claims


def _existence(pem: Pem, found: Observations, rows: Int, draws: Draws, sort: Int | None) -> Float:
    existence = found.existence[rows]
    couple_ix = found.couple_ix[rows]
    for c, couple in enumerate(pem.couples):
        for n in range(1 if sort is None else len(pem.ghosts)):
            some = np.flatnonzero((couple_ix == c) & (True if sort is None else sort == n))
            said: Claimed = couple.existence
            if sort is not None and (own := pem.ghosts[n].existence) is not None:
                said = own
            if not len(some):
                continue
            if isinstance(said, Scores):
                [uniform] = draws.take(some).uniform("existence", pem.memory_of(c).get("existence", ()))
                existence[some] = said.claimed(uniform, of_ghosts=sort is not None, ghosts_in_list=pem.ghosts_in_list)
            else:
                existence[some] = found.view.visible_share[rows[some]] if said == "visible_share" else said
    return existence


def _classes(pem: Pem, found: Observations, rows: Int, draws: Draws, *, of_ghosts: bool) -> Float:
    """(P, C) class probabilities; what a ghost is listed as is drawn at its birth."""
    class_ix = found.view.class_ix[rows].astype(np.int64)
    if pem.classes is None:
        return np.eye(len(CLASSES))[class_ix]
    if pem.classes.confusion and not of_ghosts:
        couple_ix, true = found.couple_ix[rows], class_ix.copy()
        for c in range(len(pem.couples)):
            some = np.flatnonzero(couple_ix == c)
            if len(some):
                [uniform] = draws.take(some).uniform("class", pem.memory_of(c).get("class", ()))
                class_ix[some] = pem.classes.listed(true[some], uniform)
    return pem.classes.stated(class_ix)


def _track_ids(draws: Draws, lasts_s: float) -> Int:
    """(P,) a number for each renewal: which is in force is the identity."""
    key, run = draws.random_key, draws.runs
    [renewal] = renewal_stamps(draws.rng, "track id", key, run, lasts_s)
    drawn = draws.rng.uniform("track id number", RandomKey(key.units, key.unit_ix, key.object_word, renewal), run)
    ids: Int = (drawn[0] * 2.0**TRACK_ID_BITS).astype(np.int64)
    return ids
