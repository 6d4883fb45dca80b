"""Models that do something to their process where an object is 45.5 m away."""

from __future__ import annotations

import os
import signal

import numpy as np

import copem_replay as cr


class _At45m5(cr.DetectionModel):
    spare: int = 0  # a process to which nothing is done
    range_m: float = 45.5

    def probability(self, view):  # type: ignore[no-untyped-def]
        if os.getpid() != self.spare and (np.abs(view.range_m - self.range_m) < 1e-6).any():
            self.happen()
        return 0.5 * np.ones(len(view.range_m))

    def happen(self) -> None:
        raise NotImplementedError


class Deadly(_At45m5):
    """Kills its process."""

    def happen(self) -> None:
        os.kill(os.getpid(), signal.SIGKILL)


class Failing(_At45m5):
    """Raises, which is a defect of the model."""

    def happen(self) -> None:
        raise LookupError("this model fails")


class Halting(_At45m5):
    """Says so in a FIFO, and goes on when something is in another."""

    said: str
    go_on: str

    def happen(self) -> None:
        with open(self.said, "wb") as file:
            file.write(b".")
        with open(self.go_on, "rb") as file:
            file.read()


class DeadlyFusion(cr.StepFusion):
    """Kills its process where an entry is about that far north: when pieces are computed, not in the survey."""

    spare: int = 0

    def step(self, now_s, inbox, memory):  # type: ignore[no-untyped-def]
        fused = np.concatenate([cr.entries_of(0), *(one.entries for one in inbox.newest)])
        if os.getpid() != self.spare and (fused["y_m"] > 38).any():
            self.happen()
        return fused, memory

    def happen(self) -> None:
        os.kill(os.getpid(), signal.SIGKILL)


class HaltingFusion(DeadlyFusion):
    """Says so in a FIFO, and does not go on."""

    said: str

    def happen(self) -> None:
        with open(self.said, "wb") as file:
            file.write(b".")
        signal.pause()
