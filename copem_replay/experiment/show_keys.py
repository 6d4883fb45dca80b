"""Which runs are shown: keys of an experiment file."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from copem_replay.core.components import Frozen, Id

WhichRun = Annotated[int, Field(strict=True, ge=0)] | Literal["median", "worst", "best"]


def _each_once(runs: tuple[WhichRun, ...]) -> tuple[WhichRun, ...]:
    twice = [run for k, run in enumerate(runs) if run in runs[:k]]
    if twice:
        raise ValueError(f"expected each run once, found {twice[0]} twice")
    return runs


class Show(Frozen):
    """Which logs, run or runs, and configurations (by default all) are written to MCAP and .rrd.

    `run: null` writes none; `pipeline/selected_runs.py` says which run is `median`, `worst` or `best`.
    """

    logs: Annotated[tuple[Id, ...], Field(min_length=1)] = ("first",)
    run: WhichRun | Annotated[tuple[WhichRun, ...], Field(min_length=1), AfterValidator(_each_once)] | None = 0
    configurations: Annotated[tuple[Id, ...], Field(min_length=1)] | None = None

    def asked(self) -> tuple[WhichRun, ...]:
        """The runs, one or several or none, in their order."""
        if isinstance(self.run, tuple):
            return self.run
        return () if self.run is None else (self.run,)
