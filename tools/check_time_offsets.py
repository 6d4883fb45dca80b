"""Hold the estimated clock offset of two object lists against the one that was put in: errors, and how often the
interval holds it.

Two units list the traffic of a recording in log coordinates, each at a rate of its own, with misses and errors of half
a metre, in a frame of time that is off by −1 … 1 s; or one of them is the truth.

    python tools/check_time_offsets.py --from 40 --seeds 40 logs/crossing.mcap
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from copem_replay.core.interpolation import interpolate_at_instants
from copem_replay.io.clock_offset import TimeOffset, estimate_time_offset
from copem_replay.io.recording import Recording, read_log
from copem_replay.io.short_tracks import ListPoints, make_list_points

SIGMA_M = 0.5


def listed(
    recording: Recording, rng: np.random.Generator, rate_hz: float, found: float, *, ids: bool, ahead_s: float
) -> ListPoints:
    """What a unit lists of a recording whose clock is ahead: each object with probability `found`, with errors."""
    scene = recording.scene
    since_s = np.arange(rng.uniform(0, 1 / rate_hz), scene.end_s, 1 / rate_hz)
    stamps = scene.t0_ns + np.rint(since_s * 1e9).astype(np.int64)
    world = make_list_points(
        interpolate_at_instants(recording.truth, stamps, t0_ns=scene.t0_ns, max_gap_s=0.5), scene.t0_ns
    )
    world = world.take(np.flatnonzero(rng.uniform(size=len(world.time_s)) < found))
    error_m = rng.normal(0, SIGMA_M, (2, len(world.time_s)))
    track = world.track if ids else np.full(len(world.time_s), -1)
    return ListPoints(world.time_s + ahead_s, world.list_ix, world.x_m + error_m[0], world.y_m + error_m[1], track)


def tried(recording: Recording, seed: int, *, truth: bool) -> tuple[float, TimeOffset]:
    """One pair of lists: the offset that was put in, and what is told of it."""
    rng = np.random.default_rng(seed)
    offset_s = float(rng.uniform(-1, 1))
    rates_hz, shares = rng.choice([4.0, 5.0, 10.0, 12.5, 20.0], 2, replace=False), rng.uniform(0.6, 0.95, 2)
    ids = rng.uniform(size=2) < 0.5
    first = listed(recording, rng, rates_hz[0], shares[0], ids=bool(ids[0]), ahead_s=0.0)
    second = listed(recording, rng, rates_hz[1], shares[1], ids=bool(ids[1]), ahead_s=offset_s)
    return offset_s, estimate_time_offset(
        make_list_points(recording.truth, recording.scene.t0_ns) if truth else first, second
    )


def main() -> None:
    """Print a row per recording and kind of pair."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--from", dest="first", type=int, default=0, metavar="SEED", help="the first of the seeds")
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.seeds)
    print(f"{'recording':<24}{'against':<9}{'told':>6}{'inside':>8}{'rmse_s':>9}{'worst_s':>9}{'half_s':>9}")
    for path in options.recordings:
        recording = read_log(path, name=path.stem)
        for truth in (False, True):
            found = [tried(recording, seed, truth=truth) for seed in seeds]
            told = [(true_s, one) for true_s, one in found if one.untold is None]
            error_s = np.array([one.offset_s - true_s for true_s, one in told])
            inside = sum(one.low_s <= true_s <= one.high_s for true_s, one in told)
            half_s = np.median([one.high_s - one.low_s for _, one in told]) / 2
            print(
                f"{path.stem:<24}{'truth' if truth else 'a list':<9}{len(told):>6}{inside:>8}"
                f"{np.sqrt((error_s**2).mean()):>9.4f}{np.abs(error_s).max():>9.4f}{half_s:>9.4f}"
            )


if __name__ == "__main__":
    main()
