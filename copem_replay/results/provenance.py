"""Where results come from: `provenance.json`, read back."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from copem_replay.core.errors import InputError
from copem_replay.metrics.config import Measure
from copem_replay.results.belongings import MARK
from copem_replay.results.tables import AGAIN, FORMAT


@dataclass(frozen=True)
class LogFile:
    """A recording that was replayed: its name in the tables, the topic of its truth, the SHA-256 of its content.

    `truth`: the SHA-256 of its truth, None: an older version did not say it.
    """

    name: str
    topic: str | None
    sha256: str
    truth: str | None = None


@dataclass(frozen=True)
class Provenance:
    """`provenance.json`. `measure` has every default filled in. `data`: the whole file."""

    logs: tuple[LogFile, ...]
    seed: int
    runs: int
    visibility: str | None
    max_gap_s: float | None
    window_s: object
    measure: dict[str, Any]
    braking: dict[str, Any] | None
    horizon_used_s: float | None
    run_shown: dict[str, int]  # by log
    data: dict[str, Any]


def check_format(folder: Path) -> None:
    """Raises InputError, one line, where results are of another format than this version reads; none says nothing."""
    if (folder / MARK).is_file():
        read_provenance(folder / MARK)


def read_provenance(path: Path) -> Provenance:
    """Read `provenance.json`. Raises InputError."""
    try:
        data: Any = json.loads(path.read_text(encoding="utf-8"))
        if (found := dict(data).get("format", 1)) != FORMAT:
            raise InputError(f"{path.parent}: expected results of format {FORMAT}, found format {found}; {AGAIN}")
        logs = tuple(
            LogFile(str(log["log"]), log.get("topic"), str(log["sha256"]), log.get("truth")) for log in data["logs"]
        )
        measure, braking, gap_s = dict(data["measure"]), data.get("braking"), data.get("max_gap_s")
        used_s, run_shown = measure.pop("horizon_used_s", None), data.get("run_shown") or {}
        return Provenance(
            logs=logs,
            seed=int(data["seed"]),
            runs=int(data["runs"]),
            visibility=data.get("visibility"),
            max_gap_s=None if gap_s is None else float(gap_s),
            window_s=data.get("window_s"),
            # A key that an older version did not have stood for its default.
            measure=Measure().model_dump(mode="json", by_alias=True) | measure,
            braking=None if braking is None else dict(braking),
            horizon_used_s=None if used_s is None else float(used_s),
            run_shown={str(log): int(run) for log, run in run_shown.items() if run is not None},
            data=data,
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        why = f"no {error}" if isinstance(error, KeyError) else " ".join(str(error).split())
        raise InputError(f"{path}: expected the provenance of results, found damage: {why}; {AGAIN}") from None
