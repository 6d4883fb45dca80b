"""How late the lists of a unit are, over all logs: told by its entries against the truth, or kept as declared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from copem_replay.io.list_checks import delay_of, delay_words
from copem_replay.io.recorded_osi import RecordedLists
from copem_replay.io.recording import Recording
from copem_replay.io.time_offset import TimeOffset
from copem_replay.pipeline.fit.estimate import Estimate

_Z = 1.96


@dataclass(frozen=True)
class Delay:
    """Seconds from capture to stamp of every list that does not say it: `estimate.value`. `notes`: log by log."""

    estimate: Estimate
    notes: tuple[str, ...] = ()

    @property
    def seconds(self) -> float:
        """What is taken."""
        return self.estimate.value


def unit_delay(logs: Sequence[tuple[Recording, RecordedLists]], declared_s: float | None) -> Delay:
    """The delay of the lists of all logs; `declared_s` where it cannot be told from them, None: nothing is declared.

    A delay that cannot be told from a shift along the way is taken only where nothing else is there.
    """
    if all(found.capture_said.all() for _, found in logs):
        late_s = np.concatenate([found.tracks.arrives_s[0] - found.tracks.captured_s for _, found in logs])
        low, middle, high = np.quantile(late_s, [0.025, 0.5, 0.975])
        said = "every list says when it was captured; the interval holds 95 % of the lists"
        return Delay(Estimate(float(middle), float(low), float(high), len(late_s), float(len(late_s))), (said,))
    told = {recording.scene.log: delay_of(found, recording.scene, recording.truth) for recording, found in logs}
    return pooled(told, declared_s)


def pooled(told: Mapping[str, TimeOffset], declared_s: float | None) -> Delay:
    """One delay of several logs: means weighted by precision, wider where the logs disagree more than by chance."""
    notes = tuple(f"delay in {log}: {delay_words(one)}" for log, one in told.items())
    sure = [one for one in told.values() if one.untold is None and not one.unbiased]
    if sure:
        return Delay(_mean(sure), notes)
    usable = [one for one in told.values() if one.untold is None]
    why = "no log tells it from a shift along the way" if usable else "no log tells it"
    if declared_s is not None or not usable:
        return Delay(Estimate(declared_s or 0.0, why=f"{why}; kept as declared"), notes)
    mean = _mean(usable)
    taken = f"{why}; if there is none, {mean.words()}"
    return Delay(Estimate(mean.value, mean.low, mean.high, mean.n, mean.n_effective, why=taken), notes)


def _mean(told: Sequence[TimeOffset]) -> Estimate:
    offset_s = np.array([one.offset_s for one in told])
    sigma_s = np.array([(one.high_s - one.low_s) / (2 * _Z) for one in told])
    weight = 1 / sigma_s**2
    mean_s = float((weight * offset_s).sum() / weight.sum())
    wider = 1.0  # Birge's ratio
    if len(told) > 1:
        wider = max(1.0, float(np.sqrt((weight * (offset_s - mean_s) ** 2).sum() / (len(told) - 1))))
    half_s = float(_Z * wider / np.sqrt(weight.sum()))
    n = sum(one.entries for one in told)
    return Estimate(mean_s, mean_s - half_s, mean_s + half_s, n, float("nan"))
