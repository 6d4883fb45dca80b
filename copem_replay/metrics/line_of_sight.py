"""The first instants at which units have an object in sight, whether or not they detect it.

In sight is what shows: a visible share above 0, in a list of a modelled unit, whatever its range and field of view.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from copem_replay.core.tracks import SAME_INSTANT_NS, Bool, Float
from copem_replay.metrics.config import MetricsSetup
from copem_replay.metrics.episodes import Episodes
from copem_replay.perception.observation import Observations

_TOLERANCE_S = SAME_INSTANT_NS * 1e-9


def first_sights(found: Observations, episodes: Episodes) -> Float:
    """(U, M) capture of each modelled unit's first list of an episode that has the object in sight; inf: none."""
    tracks = found.tracks
    episode_of = np.full(int(max(episodes.object_ix.max(initial=-1), tracks.object_ix.max(initial=-1))) + 1, -1)
    episode_of[episodes.object_ix] = np.arange(len(episodes.object_ix))
    episode, captured_s = episode_of[tracks.row_object_ix], tracks.row_captured_s
    rows = np.flatnonzero((episode >= 0) & (found.view.visible_share > 0))
    during = captured_s[rows] >= episodes.onset_s[episode[rows]] - _TOLERANCE_S
    rows = rows[during & (captured_s[rows] <= episodes.ended_s[episode[rows]] + _TOLERANCE_S)]
    first_s = np.full((len(tracks.units), len(episodes.object_ix)), np.inf)
    np.minimum.at(first_s, (tracks.row_unit_ix[rows], episode[rows]), captured_s[rows])
    return first_s


def in_sight_s(first_s: Float, experiment: MetricsSetup, names: Sequence[str], equipped: Bool | None) -> Float:
    """(S | 1, M) when any of some units, `names`, first has each episode in sight.

    NaN: never, or not known, of the truth and with recorded units. `first_s` as from `first_sights`; `equipped (S, U)`:
    which of the experiment's units there are in each run, None: all.
    """
    unknown = np.full((1, first_s.shape[1]), np.nan)
    if not names or any(name in experiment.recorded for name in names):
        return unknown
    modelled, every = list(experiment.modelled), list(experiment.units)
    mine_s = first_s[None, [modelled.index(name) for name in names]]
    if equipped is not None:
        there = equipped[:, [every.index(name) for name in names]]
        mine_s = np.where(there[:, :, None], mine_s, np.inf)
    seen_s = mine_s.min(axis=1)
    return np.where(np.isfinite(seen_s), seen_s, np.nan)
