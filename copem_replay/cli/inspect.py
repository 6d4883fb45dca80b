"""Commands before a replay: `info` and `init` on recordings, `check` and `schema` on experiments, `samples`."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from copem_replay.cli.terminal import (
    Ego,
    ExperimentFile,
    FromS,
    LogFiles,
    Logs,
    OneDrive,
    ToS,
    print_blocks,
    print_first_notes,
    print_line,
    print_notes,
    print_problems,
    width_of,
)
from copem_replay.core.errors import InputError
from copem_replay.core.extras import has_extra, load_extra
from copem_replay.core.files import atomic_files

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from copem_replay.core.yaml import Key
    from copem_replay.experiment.file import ExperimentSource


def info(
    logs: LogFiles,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON: one array, an entry per recording.")] = False,
    together: OneDrive = False,
    maps: Annotated[
        list[Path] | None, typer.Option("--map", metavar="FILE", help="A map in the frame of the log. Repeatable.")
    ] = None,
) -> int:
    """Describe recordings: what is in them, what is missing.

    Topics, object lists, objects, span, rate, ego vehicle. The exit code is 0 when at least one object list is
    readable, else 2. With --map: how well lanes agree with the traffic, and the shift at which they would best.
    """
    if maps and (as_json or together):
        raise InputError("--map: expected neither --json nor --together beside it")
    if together:
        return _print_clocks(logs, as_json=as_json)
    from copem_replay.experiment.draft.findings import survey_as_json
    from copem_replay.experiment.draft.survey import survey_recording
    from copem_replay.experiment.draft.template import describe_survey

    surveys = [survey_recording(log) for log in logs]
    if as_json:
        print(json.dumps([survey_as_json(s) for s in surveys], indent=1, ensure_ascii=False))
    else:
        print_blocks(describe_survey(s, width_of(sys.stdout)) for s in surveys if s.topics)
    for log in logs if maps else ():
        from copem_replay.api.recordings import compare_with_map

        for path in maps or ():
            for line in compare_with_map(log, path):
                print_line(f"{log}: {line}")
    print_problems(s.reason for s in surveys if s.reason is not None)
    return 0 if any(s.readable or any(u.problem is None for u in s.units) for s in surveys) else 2


def _print_clocks(logs: Sequence[Path], *, as_json: bool) -> int:
    """Print the clock offset of each recording against the first one."""
    from copem_replay.experiment.draft.survey import compare_clocks

    if len(logs) < 2:
        raise InputError(f"--together: expected several recordings of one drive, found {len(logs)}")
    clocks = compare_clocks(logs)
    if as_json:
        plain = [{"recording": str(clock.path), "against": str(logs[0]), **clock.plain()} for clock in clocks]
        print(json.dumps(plain, indent=1, ensure_ascii=False))
        return 0
    for clock in clocks:
        print_line(f"{clock.path}: clock_offset_s against {logs[0]}: {clock.words()}; by {' and '.join(clock.lists)}")
    return 0


def init(logs: LogFiles, together: OneDrive = False) -> int:
    """Print an experiment that replays recordings, with comments.

    copem-replay init LOG > experiment.yaml. Several recordings are several drives, each with its own ego and masts; or
    one drive, with --together. Paths are relative to the working folder. For lists of an unknown schema, `read:` is
    proposed from the names of their fields. The exit code is 2 when a recording has no readable list of true objects.
    """
    from copem_replay.api.recordings import draft_drives, draft_joint_recordings, explain_undrafted
    from copem_replay.experiment.draft.template import format_unfinished_draft

    text, surveys = draft_joint_recordings(logs) if together and len(logs) > 1 else draft_drives(logs)
    if text is None:
        if len(surveys) == 1:
            print(format_unfinished_draft(surveys[0]), end="")
        raise InputError(explain_undrafted(surveys))
    print(text, end="")
    return 0


def check(
    experiment: ExperimentFile,
    log: Logs = None,
    ego: Ego = None,
    from_s: FromS = None,
    to_s: ToS = None,
    explain: Annotated[bool, typer.Option("--explain", help="Print every note.")] = False,
) -> int:
    """Report every problem of an experiment, with file and line.

    It reports all problems at once, and checks the experiment against its recordings, too. Of recorded units it says
    what `fit` would say.
    """
    from copem_replay.api.study import prepare_study, read_study
    from copem_replay.experiment.file import read_experiment_file

    study = read_study(override_source(read_experiment_file(experiment), {"ego": ego}, log or (), (from_s, to_s)))
    from copem_replay.experiment.criteria import note_undecidable
    from copem_replay.metrics.onset import count_counted
    from copem_replay.pipeline.notes import list_began, list_notes

    replays, warnings = prepare_study(study)
    counted = [count_counted(one.episodes.count_began(), study.experiment.measure.began) for one in replays]
    undecided = note_undecidable(study.experiment.criteria, counted, study.experiment.measure)
    print_first_notes(list_notes(study.recordings, replays, study.experiment, replayed=False), explain=explain)
    print_notes([*warnings, *undecided])
    for line in list_began(replays, study.experiment):
        print_line(line)
    print_line(f"{experiment}: no problem found; logs: {', '.join(r.scene.log for r in study.recordings)}")
    for unit in study.experiment.recorded:
        preview = load_extra("preview", "fit") if has_extra("preview", "fit") else lambda *of: ()
        for line in preview(study.experiment, study.recordings, unit):
            print_line(line)
    return 0


def schema() -> int:
    """Print the JSON Schema of the experiment file.

    It includes all installed components.
    """
    from copem_replay.experiment.schema import Experiment

    json_schema = Experiment.model_json_schema(by_alias=True)
    print(json.dumps(json_schema | {"$schema": "https://json-schema.org/draft/2020-12/schema"}, indent=1))
    return 0


def override_source(
    source: ExperimentSource,
    changes: Mapping[str, object],
    logs: Sequence[str],
    window_s: tuple[float | None, float | None],
    by: Sequence[str] | None = None,
) -> ExperimentSource:
    """An experiment with command-line options in place of its keys; None and empty `logs` leave its values.

    `by`: entries of `measure.by` in addition to its own.
    """
    from dataclasses import replace

    from copem_replay.experiment.file import drop_settings, replace_logs

    values = {name: value for name, value in changes.items() if value is not None}
    options: dict[Key, str] = {(name,): f"--{name}" for name in values}
    ends = {k: option for k, option in enumerate(("--from", "--to")) if window_s[k] is not None}
    if ends:
        stated = source.data.get("window_s")
        window = stated if isinstance(stated, list) and len(stated) == len(window_s) else [None, None]
        values["window_s"] = [window_s[k] if k in ends else window[k] for k in range(len(window_s))]
        options |= {("window_s",): ", ".join(ends.values())} | {("window_s", k): o for k, o in ends.items()}
    if by is not None:
        measure = source.data.get("measure")
        measure = dict(measure) if isinstance(measure, dict) else {}
        stated = measure.get("by")
        entries = list(stated) if isinstance(stated, list) else []
        values["measure"] = measure | {"by": [*entries, *(entry for entry in by if entry not in entries)]}
        options |= {("measure", "by", len(entries) + k): "--by" for k in range(len(by))}
    data = drop_settings(source.data, [key for key in ("ego", "window_s") if key in values])
    source = replace(source, data=data | values, options=options)
    return replace_logs(source, logs) if logs else source


_SAMPLES: Final = Path(__file__).with_name("sample_logs")
"""What README and tutorial run, for an installation without the repository."""


def samples(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder to write to.")] = Path("logs"),
) -> int:
    """Write the sample recordings and experiments into a folder.

    The paper's scenario (tc016d) and a busy crossing. No file is replaced.
    """
    names = sorted(path.name for path in _SAMPLES.iterdir())
    if existing := [name for name in names if (folder / name).exists()]:
        raise InputError(
            f"{folder / existing[0]}: expected no such file, found one; samples FOLDER names another folder"
        )
    with atomic_files(folder, names) as scratch:
        for name in names:
            shutil.copyfile(_SAMPLES / name, scratch / name)
    print_line(f"{len(names)} files in {folder}")
    print_line(f"next: copem-replay run {folder / 'tc016d.yaml'}")
    return 0
