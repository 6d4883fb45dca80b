"""Ready: a list is there to be sent some time after its capture, as long as its unit works on it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from copem_replay.communication.latency import LatencyModel, delays_of
from copem_replay.core.lasting import shared
from copem_replay.core.random import CounterRng, RandomKey
from copem_replay.core.tracks import Int, Tracks


def when_ready(seen: Tracks, ready: Mapping[str, LatencyModel], rng: CounterRng, runs: Int) -> Tracks:
    """The same lists, those of some units later by what these take for each. Drawn times are those of one run (1,).

    Raises InputError where a model of the user's own fails.
    """
    if not ready:
        return seen
    arrives_s = seen.common_arrives_s.copy()
    for name, model in ready.items():
        mine = np.flatnonzero(seen.frame_unit_ix == seen.units.index(name))
        if model.fixed_s is not None:
            arrives_s[mine] += model.fixed_s
            continue
        of_unit = np.zeros(len(mine), dtype=np.int64)
        random_key = shared(RandomKey((name,), of_unit, of_unit.astype(np.uint64), seen.stamp_ns[mine]), "unit")
        [uniform] = rng.uniform("ready", random_key, runs)
        arrives_s[mine] += delays_of(model, uniform, f"units.{name}.ready")
    return seen.with_values(arrives_s=arrives_s[None])
