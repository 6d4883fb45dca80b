"""Commands that look at recordings and experiments: info, init, check, schema."""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING, Annotated

import typer

from copem_replay.cli.options import Ego, ExperimentFile, FromS, LogFiles, Logs, OneDrive, ToS
from copem_replay.cli.terminal import complain, note, say, say_blocks, width_of
from copem_replay.core.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from copem_replay.core.yaml import Key
    from copem_replay.experiment.file import Source


def info(
    logs: LogFiles,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON: one array, an entry per recording.")] = False,
    together: OneDrive = False,
) -> int:
    """Describe recordings: what is in them, what is missing.

    Topics, object lists, objects, span, rate, ego vehicle. The exit code is 0 when at least one object list is
    readable, else 2.
    """
    if together:
        return _clocks(logs, as_json=as_json)
    from copem_replay.experiment.draft.findings import as_json as plain
    from copem_replay.experiment.draft.survey import survey
    from copem_replay.experiment.draft.survey_text import describe

    surveys = [survey(log) for log in logs]
    if as_json:
        print(json.dumps([plain(s) for s in surveys], indent=1, ensure_ascii=False))
    else:
        say_blocks(describe(s, width_of(sys.stdout)) for s in surveys if s.topics)
    complain(s.reason for s in surveys if s.reason is not None)
    return 0 if any(s.readable or any(u.problem is None for u in s.units) for s in surveys) else 2


def _clocks(logs: Sequence[Path], *, as_json: bool) -> int:
    """Say how far the clocks of recordings are ahead of the first one's."""
    from copem_replay.experiment.draft.clocks import clocks

    if len(logs) < 2:
        raise InputError(f"--together: expected several recordings of one drive, found {len(logs)}")
    told = clocks(logs)
    if as_json:
        plain = [{"recording": str(one.path), "against": str(logs[0]), **one.plain()} for one in told]
        print(json.dumps(plain, indent=1, ensure_ascii=False))
        return 0
    for found in told:
        say(f"{found.path}: clock_offset_s against {logs[0]}: {found.words()}; by {' and '.join(found.lists)}")
    return 0


def init(logs: LogFiles, together: OneDrive = False) -> int:
    """Print an experiment that replays a recording, with comments.

    copem-replay init LOG > experiment.yaml. Its paths are relative to the working folder. For lists of an unknown
    schema, `read:` is proposed from the names of their fields. The exit code is 2 when no list of true objects is
    readable.
    """
    from copem_replay.cli.api.recordings import draft_of, draft_together, encodable
    from copem_replay.experiment.draft.template import unfinished

    if len(logs) > 1 and not together:
        raise InputError(f"{logs[1]}: expected one recording, found {len(logs)}; `--together`: they are of one drive")
    for log in logs:
        encodable(log)
    text, found = draft_of(logs[0]) if len(logs) == 1 else draft_together(logs)
    if text is None:
        print(unfinished(found), end="")
        raise InputError(found.reason or f"{logs[0]}: no list of true objects")
    print(text, end="")
    return 0


def check(
    experiment: ExperimentFile,
    log: Logs = None,
    ego: Ego = None,
    from_s: FromS = None,
    to_s: ToS = None,
) -> int:
    """Report every problem of an experiment, with file and line.

    It reports all problems at once, and checks the experiment against its recordings, too.
    """
    from copem_replay.cli.api.study import prepared, read_study

    study = read_study(source_with(experiment, {"ego": ego}, log or (), (from_s, to_s)))
    from copem_replay.pipeline.notes import notes_of

    ready, warnings = prepared(study)
    note([*notes_of(study.recordings, ready, study.experiment, replayed=False), *warnings])
    say(f"{experiment}: no problem found; logs: {', '.join(r.scene.log for r in study.recordings)}")
    return 0


def schema() -> int:
    """Print the JSON Schema of the experiment file.

    It includes all installed components.
    """
    from copem_replay.experiment.schema import Experiment

    described = Experiment.model_json_schema(by_alias=True) | {
        "$schema": "https://json-schema.org/draft/2020-12/schema"
    }
    print(json.dumps(described, indent=1))
    return 0


def source_with(
    path: Path,
    changes: Mapping[str, object],
    logs: Sequence[str],
    window_s: tuple[float | None, float | None],
) -> Source:
    """The experiment file, with the options that are given in the place of its keys."""
    from dataclasses import replace

    from copem_replay.experiment.file import load, with_logs, without_settings

    source = load(path)
    given = {name: value for name, value in changes.items() if value is not None}
    options: dict[Key, str] = {(name,): f"--{name}" for name in given}
    ends = {k: option for k, option in enumerate(("--from", "--to")) if window_s[k] is not None}
    if ends:
        written = source.data.get("window_s")
        window = written if isinstance(written, list) and len(written) == len(window_s) else [None, None]
        given["window_s"] = [window_s[k] if k in ends else window[k] for k in range(len(window_s))]
        options |= {("window_s",): ", ".join(ends.values())} | {("window_s", k): o for k, o in ends.items()}
    data = without_settings(source.data, [key for key in ("ego", "window_s") if key in given])
    source = replace(source, data=data | given, options=options)
    return with_logs(source, logs) if logs else source
