"""Clocks: a unit states captures by its own clock, which is off from run to run by another constant and drift."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.lasting import always, shared
from copem_replay.core.random import CounterRng, RandomKey
from copem_replay.core.tracks import Float, Int, Scene

if TYPE_CHECKING:
    from copem_replay.perception.config import PerceptionSetup


def clock_errors_s(
    scene: Scene, units: tuple[str, ...], setup: PerceptionSetup, captured_s: Float, unit_ix: Int, run: int
) -> Float | None:
    """(F,) what the clocks of the units (U,) add to the captures of their lists (F,) in one run; None: nothing ever."""
    clocks = {name: unit.clock for name, unit in setup.modelled.items() if unit.clock is not None and name in units}
    if not clocks:
        return None
    rng, zero = CounterRng(setup.seed, scene.log), np.zeros(1, dtype=np.int64)
    error_s = np.zeros(len(captured_s))
    for name, clock in clocks.items():
        random_key = always(shared(RandomKey((name,), zero, zero.astype(np.uint64), zero), "unit"))
        [[offset]] = rng.normal("clock offset", random_key, np.array([run]))
        [[drift]] = rng.normal("clock drift", random_key, np.array([run]))
        mine = unit_ix == units.index(name)
        error_s[mine] = clock.offset_sigma_s * offset + 1e-6 * clock.drift_sigma_ppm * drift * captured_s[mine]
    return error_s
