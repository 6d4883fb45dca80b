"""The fused lists of a stack as they were recorded: of when their states are, and when each became available.

A state is of the `last_measurement_time` of its list where the message says one, else `delay_s` before its stamp. A
list is available at its stamp where the message says both, else when it was logged.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from copem_replay.core.text import counted
from copem_replay.core.tracks import SAME_INSTANT_NS
from copem_replay.io.config import RecordedOutput
from copem_replay.io.plausibility import MAX_GAP_S
from copem_replay.io.recorded_osi import RecordedLists
from copem_replay.io.recorded_units import beside_truth, recorded_unit
from copem_replay.io.recording import Recording

SAME_CLOCK_S = 60.0
"""Lists logged farther from their stamps were stamped by another clock (chosen: no stack takes so long)."""
_PREDICTED = "by `tells_of` its states are of when it is available, a delay of 0"


def recorded_output(
    recording: Recording, name: str, asked: RecordedOutput, *, gate_m: float = 3.0, max_gap_s: float = MAX_GAP_S
) -> tuple[RecordedLists, list[str]]:
    """A stack's lists, captured when their states were so and arriving when available; and what has to be said.

    Raises RecordingError as `recorded_unit`.
    """
    predicted = asked.tells_of == "available"
    found, notes = recorded_unit(
        recording, name, asked, gate_m=gate_m, max_gap_s=max_gap_s, called="configuration", held=not predicted
    )
    stamp_ns = recording.scene.t0_ns + np.rint(found.tracks.common_arrives_s * 1e9).astype(np.int64)
    behind_ns = found.logged_ns - stamp_ns
    asks = ~found.capture_said & found.stamped
    away_s = float(np.median(behind_ns[asks])) * 1e-9 if asks.any() else 0.0
    other_clock = abs(away_s) > SAME_CLOCK_S
    early = int((asks & (behind_ns < -SAME_INSTANT_NS)).sum())
    if other_clock:
        notes.append(
            f"configuration {name}: logged {away_s:.6g} s from its stamps, by another clock: its lists are taken as "
            "available at their stamps, and its latency is not known"
        )
    elif early:
        said = counted(early, "list was logged before its stamp", "lists were logged before their stamps")
        notes.append(f"configuration {name}: {said}; taken as available then")
    available_ns = stamp_ns if other_clock else np.where(asks, np.maximum(found.logged_ns, stamp_ns), stamp_ns)
    arrives_s = (available_ns - recording.scene.t0_ns) * np.float64(1e-9)
    stamped = found.stamped & (not other_clock)
    if predicted:  # its states are of when it is available, whatever it says of captures
        then = replace(found.tracks, stamp_ns=available_ns, captured_s=arrives_s)
        shown = replace(found, tracks=then, capture_said=np.zeros_like(found.capture_said))
        lines = beside_truth(recording, shown, then, _PREDICTED, 0.0, gate_m=gate_m, max_gap_s=max_gap_s)
        notes += [f"configuration {name}: {line}" for line in lines]
    return replace(found, tracks=replace(found.tracks, arrives_s=arrives_s[None]), stamped=stamped), notes
