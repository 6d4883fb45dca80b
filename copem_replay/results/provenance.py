"""The provenance of results: what made them, in `provenance.json`, and read back from there; recordings, read again.

Versions, logs, seed, metric parameters and what each configuration is; no clock, no host.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from copem_replay.core.components import MOST_RUNS, UNKNOWN_KEY
from copem_replay.core.errors import InputError, RecordingError, RemoteFile
from copem_replay.core.files import parse_json
from copem_replay.experiment.file import relocate_settings
from copem_replay.experiment.schema import Experiment, LogSettings
from copem_replay.experiment.validate import read_logs, resolve_place
from copem_replay.io.findings import Finding
from copem_replay.io.open import File, Place, fetch_place, first_recording, read_file_stamps, sha256_of
from copem_replay.io.recording import KnownLog, Recording
from copem_replay.metrics.columns import TABLES
from copem_replay.metrics.config import Measure
from copem_replay.pipeline.expansion import ConfigurationFacts, find_facts
from copem_replay.pipeline.one_run import choose_logs, select_shown_runs
from copem_replay.pipeline.run import StudyTables
from copem_replay.pipeline.study_log import read_content_digest
from copem_replay.results.folder import MARK
from copem_replay.results.seals import read_seals
from copem_replay.results.table_files import AGAIN

FORMAT = 6
"""The format of results folders: raised when columns, files or their meaning change so that readers have to know."""

_LIBRARIES = (
    "foxglove-schemas-protobuf", "mcap", "numba", "numpy", "osi-python", "pandas", "protobuf", "pyarrow", "rerun-sdk",
    "scipy", "shapely",
)  # fmt: skip


_WAYS_OUT = "put the log back (a link to it does), or run the experiment again"


@dataclass(frozen=True)
class RecordedLog:
    """A recording that was replayed: its name in the tables, the topic of its truth, the SHA-256 of its content.

    `truth`: the SHA-256 of its truth. `tags`: by name.
    """

    name: str
    topic: str | None
    sha256: str
    truth: str
    tags: Mapping[str, str] = field(default_factory=dict)

    def check_same(self, digest: str, path: File) -> None:
        """Raise RecordingError where a recording is another than the one that was replayed."""
        if digest != self.sha256:
            raise RecordingError(
                f"expected the log that was replayed, SHA-256 {self.sha256[:12]}…, found {digest[:12]}…; " + _WAYS_OUT,
                path=path,
            )


@dataclass(frozen=True)
class Provenance:
    """`provenance.json`. `measure` has every default filled in. `data`: the whole file."""

    logs: tuple[RecordedLog, ...]
    seed: int
    runs: int
    visibility: str | None
    max_gap_s: float | None
    window_s: object
    measure: dict[str, Any]
    braking: dict[str, Any] | None
    horizon_used_s: float
    run_shown: dict[str, int]  # by log
    facts: dict[str, ConfigurationFacts]  # by configuration
    seals: dict[str, str]  # by file of the results; empty: an older version's
    data: dict[str, Any]

    def kinds(self, name: str, *, compared: bool = False) -> dict[str, str]:
        """Kinds of a table's required columns: all, or those that comparisons read."""
        needless = self.braking and self.braking.get("needless") if self.measure["accuracy"] else None
        asked = {"braking": self.braking, "conflict": self.measure["conflict"], "needless": needless}
        return TABLES[name].kinds(*(key for key, of in asked.items() if of is not None), compared=compared)


def check_format(folder: Path) -> None:
    """Raise InputError, one line, where a folder has results of another format; without results nothing is raised."""
    if (folder / MARK).is_file():
        read_provenance(folder / MARK)


_SKIPPED = ("log", "reason")
"""Keys of each of `logs_skipped`."""


def read_provenance(path: Path) -> Provenance:
    """Read `provenance.json`. Raises InputError."""
    try:
        return parse_provenance(parse_json(path.read_text(encoding="utf-8")), path.parent)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        why = f"no {error}" if isinstance(error, KeyError) else " ".join(str(error).split())
        raise InputError(f"{path}: expected the provenance of results, found damage: {why}; {AGAIN}") from None


def parse_provenance(data: Any, place: Path) -> Provenance:
    """The content of `provenance.json` of the results at a place. Raises InputError for another format."""
    if (found := dict(data).get("format", 1)) != FORMAT:
        raise InputError(f"{place}: expected results of format {FORMAT}, found format {found}; {AGAIN}")
    logs = tuple(
        RecordedLog(str(log["log"]), log.get("topic"), str(log["sha256"]), str(log["truth"]), _parse_tags(log))
        for log in data["logs"]
    )
    notes = [*data.get("notes", []), *(log[name] for log in data.get("logs_skipped", []) for name in _SKIPPED)]
    if not all(isinstance(note, str) for note in notes):
        raise ValueError("expected text in notes and logs_skipped")
    # A missing key, from an older version, stands for its default.
    defaults = Measure().model_dump(mode="json", by_alias=True)
    measure = defaults | dict(data["measure"])
    braking, gap_s = data.get("braking"), data.get("max_gap_s")
    used_s, run_shown = float(measure.pop("horizon_used_s")), data.get("run_shown") or {}
    _check_measure(measure)
    measure["gospa"] = defaults["gospa"] | measure["gospa"]
    if not 1 <= int(data["runs"]) <= MOST_RUNS:
        raise ValueError(f"expected 1 to {MOST_RUNS} runs, found {data['runs']}")
    return Provenance(
        logs=logs,
        seed=int(data["seed"]),
        runs=int(data["runs"]),
        visibility=data.get("visibility"),
        max_gap_s=None if gap_s is None else float(gap_s),
        window_s=data.get("window_s"),
        measure=measure,
        braking=None if braking is None else dict(braking),
        horizon_used_s=used_s,
        run_shown={str(log): int(run) for log, run in run_shown.items() if run is not None},
        facts={str(name): ConfigurationFacts(**of) for name, of in dict(data["configurations"]).items()},
        seals=read_seals(data),
        data=data,
    )


def _check_measure(measure: dict[str, Any]) -> None:
    """Raise ValueError where a key of `measure` has a value that no experiment gives it; unknown keys may be there."""
    try:
        Measure.model_validate(measure)
    except ValidationError as error:
        for wrong in error.errors(include_url=False, include_context=False):
            if wrong["type"] != UNKNOWN_KEY:
                raise ValueError(f"measure.{'.'.join(map(str, wrong['loc']))}: {wrong['msg']}") from None


def _parse_tags(log: Any) -> dict[str, str]:
    tags = dict(log.get("tags", {}))
    if not all(isinstance(text, str) for text in (*tags, *tags.values())):
        raise ValueError(f"expected text in tags of log {log['log']}")
    return tags


def reread_recording(log: RecordedLog, place: Place, experiment: Experiment) -> Recording:
    """A recording that results name, read again for the experiment resolved for it.

    Raises RecordingError, one line, where the recording is missing or not the one that was replayed.
    """
    try:
        with fetch_place(place) as here:
            stamps, digest = read_file_stamps(here), sha256_of(here)
    except InputError as error:
        raise RecordingError(f"{error}; {_WAYS_OUT}") from None
    log.check_same(digest, first_recording(place))
    recordings, refused = read_logs(experiment, [place], None)
    if refused:
        raise RecordingError([f"{refusal.path}: {refusal.reason}" for refusal in refused])
    (read,) = recordings
    assert isinstance(read, Recording)
    if read.stamps != stamps:  # a copy of its own, or it has changed since
        log.check_same(read_content_digest(read), first_recording(place))
    # Draws are addressed by the log's name, which depends on what else was replayed.
    return replace(read, scene=replace(read.scene, log=log.name))


# What is written.


def build_provenance(
    study: StudyTables, skipped: Sequence[tuple[File, str]], notes: Sequence[str]
) -> dict[str, object]:
    """The provenance of results: versions, logs, seed, metric parameters; no clock, no host."""
    experiment = study.experiment
    shown = {log: select_shown_runs(study, log) for log in choose_logs(experiment, [log.name for log in study.logs])}
    return {
        "format": FORMAT,
        **list_versions(),
        "seed": experiment.seed,
        "runs": experiment.runs,
        "logs": [
            {"log": log.name, "topic": log.recording.topic, **{n: log.digests[n] for n in ("sha256", "truth")}}
            | ({"tags": dict(log.recording.scene.tags)} if log.recording.scene.tags else {})
            | ({"read": found} if (found := list_read(log.recording)) else {})
            for log in study.logs
        ],
        "logs_skipped": [{"log": escape_name(path.name), "reason": reason} for path, reason in skipped],
        "visibility": experiment.visibility.label,
        "max_gap_s": experiment.max_gap_s,
        "window_s": experiment.window_s,
        "measure": experiment.measure.model_dump(mode="json", by_alias=True) | {"horizon_used_s": study.horizon_s},
        "braking": experiment.braking and experiment.braking.model_dump(mode="json", by_alias=True),
        "configurations": {name: asdict(of) for name, of in find_facts(experiment).items()},
        "run_shown": {log: runs[0].run for log, runs in shown.items()},
        "runs_shown": {
            log: [{"file": each.stem, "run": each.run, "run_is": each.why or None} for each in runs]
            for log, runs in shown.items()
        },
        "notes": list(notes),
    }  # fmt: skip


def list_read(recording: KnownLog) -> list[dict[str, object]]:
    """What was left out or mended of a recording: how many, and the line that says what and why."""
    return [
        {"number": note.number, "what": str(note), "changes": note.changes}
        for note in recording.notes
        if isinstance(note, Finding) and note.rule
    ]


def escape_name(name: str) -> str:
    """A file's name as text that can be written: bytes that are not UTF-8 escaped."""
    return name.encode(errors="backslashreplace").decode()


def log_entries(logs: Sequence[Any], recordings: Sequence[KnownLog], folder: Path) -> list[Any]:
    """`logs` of the folder's experiment: paths relative to the folder, with settings where logs have them."""

    def called(file: File) -> str:
        return recording_name(file, folder)

    settings = [entry for entry in logs if isinstance(entry, LogSettings)]
    if len(settings) < len(recordings):
        return [called(first_recording(recording.place)) for recording in recordings]
    moved = (relocate_settings(one, r.place, called) for one, r in zip(settings, recordings, strict=True))
    return [one.model_dump(mode="json", by_alias=True) for one in moved]


def recording_name(file: File, folder: Path) -> str:
    """The name of a recording in results: its path relative to the folder, or its URL without user and query."""
    return str(file) if isinstance(file, RemoteFile) else relative_path(resolve_place(file), folder)


def relative_path(path: str | Path, folder: Path) -> str:
    """A path from a folder; the whole path where there is none, being on another drive of Windows."""
    try:
        return os.path.relpath(path, folder)
    except ValueError:
        return os.path.abspath(path)


def list_versions() -> dict[str, object]:
    """Versions of this project, of Python, and of the libraries that results depend on."""
    return {
        "copem_replay": version("copem-replay"),
        "python": platform.python_version(),
        "libraries": {name: version(name) for name in _LIBRARIES},
    }
