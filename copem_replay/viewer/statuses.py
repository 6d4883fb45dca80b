"""How far an object has come in a configuration, by number; what each means: `viewer/status.py`."""

from __future__ import annotations

STATUSES = (
    "absent", "not listed", "out of view", "hidden", "visible", "lost", "captured", "unmatched",
    "listed before the onset", "listed, not confirmed", "listed too late", "known",
)  # fmt: skip
(
    ABSENT, UNLISTED, OUT, HIDDEN, VISIBLE, LOST, CAPTURED, UNMATCHED, EARLY, UNCONFIRMED, TOO_LATE, KNOWN,
) = range(len(STATUSES))  # fmt: skip
