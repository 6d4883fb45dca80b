"""How time and memory grow with runs, units, objects, configurations and length: one of them at a time, all else equal.

Every line is a command in a process of its own, after one that compiles: processor seconds of all its threads, seconds
of the clock, the most memory. An exponent is the slope of the logarithms from the smallest to the largest size, of what
is above the command that has next to nothing to do (`idle`): 1 is in proportion. More objects have more room, so that
as many are around each; more of the others leave the rest as it is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from benches import common


@dataclass(frozen=True)
class Size:
    """A recording of some objects at 20 Hz, some of which carry units, and what is computed of it."""

    runs: int = 20
    units: int = 4
    objects: int = 60
    configurations: int = 4
    frames: int = 200


IDLE = Size(runs=1, units=1, objects=4, configurations=1, frames=4)
SIZES: Mapping[str, tuple[int, ...]] = {
    "runs": (20, 80, 320),
    "units": (4, 12, 36),
    "objects": (60, 250, 1000),
    "configurations": (4, 12, 36),
    "frames": (200, 800, 3200),
}
"""Chosen: a few seconds each, the largest ones a minute."""
EXPERIMENT = """
version: 1
logs: [scaling.mcap]
ego: 0
runs: {runs}
measure: {{began: [log_start, crossed, appeared]}}
seed: 1
show: null
pems:
  around:
    - when: {{range_m: [0, 70]}}
      detection: {{kind: visible_share}}
      error: {{kind: gaussian, covariance_m2: [[0.25, 0.0], [0.0, 0.25]]}}
units:
{units}
configurations:
{configurations}
"""


def spent_on(size: Size, folder: Path) -> common.Spent:
    """By the command `run` of one size, on one thread."""
    common.write_truth(folder / "scaling.mcap", common.spread_boxes(size.frames, size.objects))
    units = "\n".join(f"  u{k}: {{on: {k}, height_m: 1.8, pem: around, rate_hz: 10}}" for k in range(size.units))
    configurations = "\n".join(
        f"  c{k}: {{units: all, latency_s: {0.01 * k:.2f}, fusion: {{kind: {('ideal', 'gnn')[k % 2]}}}}}"
        for k in range(size.configurations)
    )
    text = EXPERIMENT.format(runs=size.runs, units=units, configurations=configurations)
    (folder / "scaling.yaml").write_text(text)
    return common.spent(["run", "scaling.yaml", "--out", "out", "--overwrite", "--jobs", "1"], folder)


def exponent(sizes: tuple[float, ...], costs: tuple[float, ...]) -> float:
    """The slope of the logarithms from the smallest to the largest: 1 is in proportion, 2 with the square."""
    return math.log(costs[-1] / costs[0]) / math.log(sizes[-1] / sizes[0])


def grown(of: str, idle: common.Spent, folder: Path) -> Iterator[common.Line]:
    """A line for each size of one kind, and the exponents."""
    found = []
    for size in SIZES[of]:
        spent = spent_on(replace(Size(), **{of: size}), folder)
        found.append(spent)
        yield {"scaling": of, of: size} | common.as_line(spent)
    above = [
        tuple(max(at - least, 0.01) for at in column)
        for column, least in zip(zip(*found, strict=True), idle, strict=True)
    ]
    names = ("cpu", "seconds", "peak")
    yield {"scaling": of} | {
        f"{name}_exponent": round(exponent(SIZES[of], costs), 2) for name, costs in zip(names, above, strict=True)
    }


def scaling() -> Iterator[common.Line]:
    """A table over runs, units, objects, configurations and frames, with exponents and peaks of memory."""
    with common.scratch() as folder:
        spent_on(Size(), folder)  # compiles
        idle = spent_on(IDLE, folder)
        yield {"scaling": "idle"} | common.as_line(idle)
        for of in SIZES:
            yield from grown(of, idle, folder)
