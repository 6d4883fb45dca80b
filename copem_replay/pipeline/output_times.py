"""How old the recorded outputs of stacks are when they are available: read off the recordings, whatever the truth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from copem_replay.core.tracks import SAME_INSTANT_NS
from copem_replay.experiment.schema import Experiment, ideal_over, output_unit
from copem_replay.io.recording import Recording
from copem_replay.metrics.output_times import OutputTimes

_TOLERANCE_S = SAME_INSTANT_NS * 1e-9


def output_times(recordings: Sequence[Recording], experiment: Experiment) -> dict[str, OutputTimes]:
    """By configuration the sums over all logs."""
    return {
        name: sum((_of_log(recording, experiment, name) for recording in recordings), OutputTimes())
        for name in experiment.outputs
    }


def _of_log(recording: Recording, experiment: Experiment, name: str) -> OutputTimes:
    found = recording.lists[output_unit(name)]
    available_s, captured_s = found.tracks.common_arrives_s, found.tracks.captured_s
    while_it_lasts = (available_s >= -_TOLERANCE_S) & (available_s <= recording.scene.end_s + _TOLERANCE_S)
    delay_s = np.where(found.capture_said, 0.0, experiment.outputs[name].delay_s)[while_it_lasts]
    says = (found.capture_said | found.stamped)[while_it_lasts]
    # To a nanosecond, as stamps are: .7 − .57 − .13 is not 0.
    latency_s = np.round((available_s - captured_s)[while_it_lasts] - delay_s, 9)
    age_s = available_s[while_it_lasts] - _newest_input_s(recording, experiment, name, available_s[while_it_lasts])
    there = np.isfinite(age_s)
    return OutputTimes(
        float(latency_s[says].sum()), int(says.sum()), float(delay_s.sum()), len(delay_s),
        float(age_s[there].sum()), int(there.sum()),
    )  # fmt: skip


def _newest_input_s(recording: Recording, experiment: Experiment, name: str, at_s: np.ndarray) -> np.ndarray:
    """(K,) the newest capture of any input that has arrived by each instant; −inf: there is none."""
    newest_s = np.full(len(at_s), -np.inf)
    for unit in experiment.configurations[name].inputs or ():
        if unit not in recording.lists:  # its log lacks it
            continue
        lists = recording.lists[unit].tracks
        order = np.argsort(lists.common_arrives_s, kind="stable")
        so_far_s = np.append(-np.inf, np.maximum.accumulate(lists.captured_s[order]))
        arrived = np.searchsorted(lists.common_arrives_s[order], at_s + _TOLERANCE_S, side="right")
        newest_s = np.maximum(newest_s, so_far_s[arrived])
    return newest_s


def notes_on_outputs(experiment: Experiment) -> Iterator[str]:
    """To what the regret of each recorded output is."""
    for name in experiment.outputs:
        inputs = experiment.configurations[name].inputs
        if inputs is None:
            yield f"configuration {name}: no regret, for it has no `inputs`: ideal fusion of what it had is not known"
            continue
        ideal = ideal_over(experiment.configurations, inputs)
        yield f"configuration {name}: its regret is the difference to {ideal}, ideal fusion of {', '.join(inputs)}"
