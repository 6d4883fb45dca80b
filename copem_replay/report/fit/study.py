"""What a fit's report is made from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.tracks import Float
from copem_replay.report.figures.style import Colour

if TYPE_CHECKING:
    from copem_replay.pipeline.fit.detection import DetectionFit
    from copem_replay.pipeline.fit.errors import ErrorFit
    from copem_replay.pipeline.fit.estimate import Estimate
    from copem_replay.pipeline.fit.rest import RestFit
    from copem_replay.pipeline.fit.rows import FitLists, FitRows

RECORDED: Colour = (0.0, 114 / 255, 178 / 255)
FITTED: Colour = (213 / 255, 94 / 255, 0.0)
MEMORYLESS: Colour = (204 / 255, 121 / 255, 167 / 255)
"""Of what was recorded, of the fitted model, and of the same without memory; Okabe and Ito's."""


@dataclass(frozen=True)
class FitStudy:
    """A fitted unit. `estimates`: all numbers by name. `delay_s`: what is taken for the delay of its lists.

    `ranks`: of the replay check, by statistic, the rank (0 … 1) of each recorded value among fitted runs;
    `ranks_memoryless`: the same of a model without memory. `verdicts`: what the check says, by statistic. `notes`: what
    else is to be said.
    """

    unit: str
    logs: Sequence[str]
    rows: FitRows
    lists: FitLists
    detection: DetectionFit
    errors: ErrorFit
    rest: RestFit
    delay_s: float
    estimates: Mapping[str, Estimate] = field(default_factory=dict)
    ranks: Mapping[str, Float] = field(default_factory=dict)
    ranks_memoryless: Mapping[str, Float] = field(default_factory=dict)
    verdicts: Mapping[str, str] = field(default_factory=dict)
    notes: Sequence[str] = ()

    @cached_property
    def probability(self) -> Float:
        """(R,) with which probability each row is listed, by the fitted model."""
        return self.detection.probability(self.rows.view)

    @cached_property
    def first_rows(self) -> np.ndarray:
        """(P + 1,) where each pass begins."""
        new = np.flatnonzero(np.diff(self.rows.pass_ix)) + 1
        return np.concatenate([[0], new, [len(self.rows.pass_ix)]])
