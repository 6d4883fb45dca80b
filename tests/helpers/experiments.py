"""A small experiment and its recording, as users write them, for tests of files and commands.

The ego (1) stands at the origin. Another car (2), 70 m ahead, drives towards it at 10 m/s, 10 Hz, for 3 s: 60 m away
at 1 s, 50 m at 2 s. A parked car (3) is 30 m to the left.
"""

from __future__ import annotations

import math
from pathlib import Path

from copem_replay.experiment.file import ExperimentSource, read_experiment_file
from tests.helpers.recordings import Obj, write_recording

TEXT = """\
version: 1
logs: [drive.mcap]
runs: 4
seed: 1
pems:
  onboard:
    - when: {range_m: [0, 80]}
      detection: {kind: constant, probability: 0.5}
      error: {kind: gaussian, covariance_m2: [[0.5, 0.0], [0.0, 0.5]]}
units:
  ego: {on: ego, height_m: 1.8, pem: onboard}
  mast: {at: [12.0, -4.5], height_m: 5.0, pem: onboard}
configurations:
  GT: {units: truth}
  PEM: {units: [ego]}
  coPEM: {units: all, latency_s: 0.5}
measure: {onset: {kind: in_range, range_m: 60}, horizon_s: 2}
show: null
"""


def drive(path: Path, *, host: int | None = 1, first: int = 1) -> Path:
    """The recording above; `first`: id of the ego, the others follow."""
    frames = [
        (
            0.1 * k,
            [
                Obj(id=first, x=0.0),
                Obj(id=first + 1, x=70.0 - k, vx=-10.0, yaw=math.pi),
                Obj(id=first + 2, x=0.0, y=30.0, stationary=True),
            ],
        )
        for k in range(31)
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_recording(path, frames, host=host)


ALL_COUNT = "measure: {onset: {kind: in_range, range_m: 60}, horizon_s: 2, began: [log_start, crossed, appeared]}"
"""A line for drives whose objects are within range from the start."""


def changed(*changes: str) -> str:
    """The text with lines replaced: each of `changes` takes the place of the line that starts with the same key.

    A change without such a line comes at the end.
    """
    lines = TEXT.splitlines()
    for change in changes:
        key = change.partition(":")[0] + ":"
        at = next((k for k, line in enumerate(lines) if line.startswith(key)), len(lines))
        lines[at : at + 1] = [change]
    return "\n".join(lines) + "\n"


def source_of(folder: Path, text: str) -> ExperimentSource:
    path = folder / "experiment.yaml"
    path.write_text(text, encoding="utf-8")
    return read_experiment_file(path)


def files(folder: str) -> dict[str, bytes]:
    """All files of a folder, by their paths in it."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in Path(folder).rglob("*") if path.is_file()}
