"""Experiment files: read as plain data, parsed, with every problem by file, line and key; the recordings they name."""

from __future__ import annotations

import difflib
import glob
import os
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self, TypeAlias

from pydantic import ValidationError

from copem_replay.core.components import UNKNOWN_KEY
from copem_replay.core.errors import (
    ExperimentError,
    InputError,
    RemoteFile,
    find_remote_files,
    is_url,
    local_path,
    strip_credentials,
)
from copem_replay.core.yaml import AliasesError, Key, NotYamlError, parse_yaml
from copem_replay.experiment.schema import Experiment, LogEntry, LogSettings
from copem_replay.io.open import DriveRecordings, File, Place, first_recording, name_log

# Problems of shape in the words of the file: the key, what was expected, what was found.


def describe_by_key(error: ValidationError, data: dict[str, Any], prefix: Key = ()) -> Iterator[tuple[Key, str]]:
    """A message per key, which joins the alternatives of the key.

    `data`: the validated value, which stands at the key `prefix`.
    """
    items_by_key: dict[Key, list[Any]] = {}
    for item in error.errors(include_url=False):
        if item["type"] == "too_short" and len(item["input"]) >= item["ctx"]["min_length"]:
            continue  # long enough, but its items were refused, which have their own lines
        items_by_key.setdefault((*prefix, *_file_key(data, item)), []).append(item)
    above_others = {key[:n] for key in items_by_key for n in range(len(key))}
    misspelt = {
        (*key[:-1], *find_meant_key(key, items[0]["ctx"]["known"]))
        for key, items in items_by_key.items()
        if items[0]["type"] == UNKNOWN_KEY
    }
    for key, items in items_by_key.items():
        # Another alternative fits so far, and its message names the deeper key; or the key is told of as it is written.
        if key in above_others or (key in misspelt and items[0]["type"] == "missing"):
            continue
        yield key, _problem_message(items, key)


def _file_key(data: Any, item: Any) -> Key:
    """The key in the file of a problem that pydantic reports: its location without names of alternatives."""
    key: list[str | int] = []
    value, location = data, item["loc"]
    for k, part in enumerate(location):
        if isinstance(value, dict) and (part in value or (k == len(location) - 1 and item["type"] == "missing")):
            key.append(part)
            value = value.get(part)
        elif isinstance(value, list) and isinstance(part, int):
            key.append(part)
            value = value[part] if part < len(value) else None
    return tuple(key)


_EXPECTED = {
    "tuple_type": "a list",
    "list_type": "a list",
    "dict_type": "keys and values",
    "model_type": "keys and values",
    "model_attributes_type": "keys and values",
    "string_type": "text",
    "bool_type": "true or false",
    "float_type": "a number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "finite_number": "a finite number",
    "greater_than": "more than {gt:g}",
    "greater_than_equal": "at least {ge:g}",
    "less_than": "less than {lt:g}",
    "less_than_equal": "at most {le:g}",
    "string_too_short": "at least {min_length} character",
    "too_short": "at least {min_length} in the list",
    "too_long": "at most {max_length} in the list",
    "literal_error": "{expected}",
}


def _unit_hint(written: str, meant: str) -> str:
    """A hint that the key that was meant has another unit, where only the units of the names differ; else empty."""
    (name, _, unit), (other, _, right) = written.rpartition("_"), meant.rpartition("_")
    return f" (in {right}, not {unit})" if name == other and name else ""


def find_meant_key(key: Key, known: Sequence[str]) -> list[str]:
    """The known key most like an unknown one, if any is."""
    return difflib.get_close_matches(str(key[-1]), known, n=1)


def _problem_message(items: Sequence[Any], key: Key) -> str:
    """One line on the problems at a key: unknown (with a hint), missing, or what was expected and found."""
    first = items[0]
    if first["type"] == UNKNOWN_KEY:
        known = first["ctx"]["known"]
        near = find_meant_key(key, known)
        hint = (
            f"did you mean {near[0]}?{_unit_hint(str(key[-1]), near[0])}" if near else f"known here: {', '.join(known)}"
        )
        if _RENAMED.get(str(key[-1])) in known:
            return f"`{key[-1]}` is called `{_RENAMED[str(key[-1])]}` now"
        if key[-1] in _DEVIATIONS and "covariance_m2" in known:
            hint = f"{_variance_hint(first['input'])} says it"
        return "unknown key" + (f"; {hint}" if known else "")
    if first["type"] == "missing":
        return "missing"
    if own_messages := [item for item in items if item["type"] not in _EXPECTED]:
        return str(own_messages[0]["msg"]).removeprefix("Value error, ")
    if first["type"] == "too_short" and isinstance(first["input"], Mapping):
        return "expected at least one, found none"
    words = dict.fromkeys(_EXPECTED[item["type"]].format(**item.get("ctx", {})) for item in items)
    hint = _percent_hint(first) or _list_hint(items, key)
    return f"expected {', or '.join(words)}, found {_shorten_value(first['input'])}{hint}"


_RENAMED = {"share": "penetration_rate"}
"""Keys of version 0.1 and their names now."""
_DEVIATIONS = ("sigma_m", "sigma", "std_m", "std", "stddev_m", "stddev")


def _variance_hint(sigma_m: object) -> str:
    """The `covariance_m2` that stands for a standard deviation."""
    variance = f"{sigma_m**2:g}" if isinstance(sigma_m, int | float) else "σ²"
    return f"`covariance_m2: [[{variance}, 0], [0, {variance}]]`"


LIST_EXAMPLES = {
    "at": "[0, 0]",
    "at_m": "[[12, 3]]",
    "classes": "[vru]",
    "covariance_m2": "[[0.4, 0.0], [0.0, 0.4]]",
    "ids": "[7, 12]",
    "inputs": "[car, rsu]",
    "logs": "[drive.mcap]",
    "mean_m": "[0.2, 0.0]",
    "metrics": '[{kind: "my_package.metrics:Late"}]',
    "obstacles": "[{polygon_m: [[20, -1], [22, -1], [22, 1]], height_m: 3}]",
    "offset_m": "[0.4, 0.0]",
    "polygon_m": "[[0, 8], [4, 8], [4, 9]]",
    "range_m": "[0, 80]",
    "together": "[ego.mcap, rsu.mcap]",
    "window_s": "[0, 20]",
}
"""A list for each key that takes one, for who writes a single value: as docs/reference/keys.md has it."""


def _list_hint(items: Sequence[Any], key: Key) -> str:
    """An example where a list is expected and a single value found; else empty."""
    name = str(key[-1]) if key else ""
    if key[:1] == ("show",):  # whose logs are names
        return ""
    wants_list = any(item["type"] in ("list_type", "tuple_type") for item in items)
    if not wants_list or isinstance(items[0]["input"], Mapping) or name not in LIST_EXAMPLES:
        return ""
    return f"; such as `{name}: {LIST_EXAMPLES[name]}`"


def _percent_hint(item: Any) -> str:
    """A hint where a share was probably given in per cent; else empty."""
    is_share = item["type"] == "less_than_equal" and item["ctx"]["le"] == 1
    if not is_share or not 2 < item["input"] <= 100:  # 1.5 or 2 is hardly a percentage
        return ""
    return f"; a fraction: {item['input']:g} % is {item['input'] / 100:g}"


def _shorten_value(value: object) -> str:
    words = {None: "nothing", True: "true", False: "false"}
    text = words[value] if value is None or isinstance(value, bool) else repr(value)
    return text if len(text) <= 60 else text[:57] + "…"


Listed: TypeAlias = dict[str, list[File] | InputError]
"""By URL the files that it matches, or why it cannot be listed; each is listed once."""


class Problem(str):
    """A problem of a file in one line of text that names its place. `line`: number of the line in the file."""

    line: int

    def __new__(cls, text: str, line: int) -> Self:
        """Return the text with the number of its line."""
        problem = super().__new__(cls, text)
        problem.line = line
        return problem


@dataclass(frozen=True)
class ExperimentSource:
    """An experiment file as plain data, with the line of each key."""

    path: Path
    data: dict[str, Any]
    lines: dict[Key, int]
    problems: tuple[str, ...]  # of its YAML: the file is refused, but the rest is checked too
    logs: tuple[str, ...] = ()  # replayed instead of those that it names, relative to the working folder
    options: Mapping[Key, str] = field(default_factory=dict)  # of the command line, by the keys that they set
    listed: Listed = field(default_factory=dict)

    @property
    def logs_option(self) -> str:
        """The option that `logs` came by."""
        return self.options.get(("logs",), "--log")

    def at(self, key: Key, message: str, line: int | None = None) -> str:
        """`file:line: key: message`; by default the line of the key, or of the mapping that should have it.

        For a key that an option set: `--option: message`.
        """
        if key in self.options:
            return f"{self.options[key]}: {message}"
        if line is None:
            line = next(self.lines[key[:n]] for n in range(len(key), -1, -1) if key[:n] in self.lines)
        name = format_key(key)
        return Problem(f"{self.path}:{line}: {name + ': ' if name else ''}{message}", line)


@dataclass(frozen=True)
class PlainSource(ExperimentSource):
    """An experiment that is made in Python and stands in no file: it need not name its logs, and keys have no line."""

    def at(self, key: Key, message: str, line: int | None = None) -> str:
        """`experiment: key: message`; for a key that an option set, `option: message`."""
        name = self.options.get(key) or ": ".join(filter(None, (str(self.path), format_key(key))))
        return f"{name}: {message}"


def make_plain_source(data: Mapping[str, Any]) -> PlainSource:
    """The plain data of an experiment as a source. The paths of its logs are relative to the working folder."""
    return PlainSource(Path("experiment"), dict(data), {(): 1}, ())


def format_key(key: Key) -> str:
    """A key as text: `units.ego.height_m`, `logs[0]`."""
    text = ""
    for part in key:
        name = part or "''"
        text += f"[{part}]" if isinstance(part, int) else f".{name}" if text else str(name)
    return text


_RECORDINGS = (".mcap", ".osi", ".db3")


def is_recording(path: Path) -> bool:
    """Whether a path is that of a recording, by its suffix, or of a folder of rosbag2."""
    return path.suffix in _RECORDINGS or os.path.isfile(path / "metadata.yaml")  # False for a name that is too long


def _recording_hint(path: Path) -> str:
    return f"; `copem-replay init {shlex.quote(str(path))} > experiment.yaml` makes one that replays it"


def read_experiment_file(path: Path) -> ExperimentSource:
    """An experiment file as plain data. Raises ExperimentError when it cannot be read or is not YAML."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ExperimentError(f"{path}: no such file") from None
    except IsADirectoryError:
        hint = _recording_hint(path) if is_recording(path) else ""
        raise ExperimentError(f"{path}: is a folder; expected an experiment file (YAML){hint}") from None
    except UnicodeDecodeError as error:
        if is_recording(path):
            raise ExperimentError(
                f"{path}: expected an experiment file (YAML), found a recording{_recording_hint(path)}"
            ) from None
        line, byte = error.object.count(b"\n", 0, error.start) + 1, error.object[error.start]
        raise ExperimentError(f"{path}:{line}: expected YAML text in UTF-8, found byte {byte:#x}") from None
    except OSError as error:
        raise ExperimentError(f"{path}: cannot be read: {error.strerror}") from None
    return read_experiment_text(path, text)


def read_experiment_text(path: Path, text: str) -> ExperimentSource:
    """The text of an experiment file as plain data. Raises ExperimentError when it is not YAML."""
    try:
        data, lines, problems = parse_yaml(text)
    except AliasesError as error:
        raise ExperimentError(f"{path}:{error.line}: {error.why}") from None
    except NotYamlError as error:
        raise ExperimentError(f"{path}:{error.line}: not YAML: {error.why}") from None
    if not isinstance(data, dict):
        found = "an empty file" if data is None else "a list" if isinstance(data, list) else "text"
        raise ExperimentError(f"{path}:1: expected keys and values such as `version: 1`, found {found}")
    source = ExperimentSource(path, data, lines, ())
    return replace(source, problems=tuple(source.at(key, message, line) for key, line, message in problems))


def parse_experiment(source: ExperimentSource) -> tuple[Experiment | None, list[str]]:
    """The experiment, None where there are problems of shape that prevent it, and all problems of shape."""
    problems = list(source.problems)
    try:
        # The paths of a plain experiment are relative to the working folder.
        folder = None if isinstance(source, PlainSource) else source.path.parent
        experiment = Experiment.model_validate(source.data, context={"folder": folder})
    except ValidationError as error:
        shape = list(_list_problems(source, error))
        head = sum(line == source.at(("version",), "missing") for line in shape)  # in the order of the keys
        return None, [*problems, *shape[:head], *_logs_missing(source), *shape[head:]]
    missing = _logs_missing(source)
    return (None if missing else experiment), problems + missing


def _logs_missing(source: ExperimentSource) -> list[str]:
    """The problem of a file that names no logs, not even misspelt; they are optional in Python only."""
    keys = [find_meant_key((key,), list(Experiment.model_fields)) for key in source.data]
    return [] if ["logs"] in keys or isinstance(source, PlainSource) else [source.at(("logs",), "missing")]


def _list_problems(source: ExperimentSource, error: ValidationError) -> Iterator[str]:
    for key, message in describe_by_key(error, source.data):
        yield source.at(key, message)


def log_paths(source: ExperimentSource) -> tuple[dict[Place, Key | None], list[str]]:
    """The recordings to replay by the key that names each, globs resolved and sorted; problems of the patterns."""
    paths: dict[Place, Key | None] = {}
    problems: list[str] = []
    for k, (key, pattern, named) in _list_patterns(source).items():
        places = _find_places(source, k, pattern)
        if reason := _explain_unasked(source, k, pattern):
            problems.append(f"{source.logs_option}: {reason}" if source.logs else source.at(key, reason))
            continue
        paths |= dict.fromkeys(places, None if source.logs else ("logs", k))
        if not places and source.logs:
            problems.append(f"{source.logs_option}: no file matches {pattern!r}")
        elif not places:
            problems.append(source.at(key, f"no file matches {pattern!r}"))
        elif named and len(places) > 1:
            message = f"a name goes with one recording; {pattern!r} matches {len(places)}"
            problems.append(source.at(("logs", k, "name"), message))
    return paths, problems


def list_named_paths(source: ExperimentSource) -> Iterator[tuple[str, Place]]:
    """Each recording as often as it is named, with the key or option that names it: `logs[0]`, `--log`."""
    for k, (_, pattern, _) in _list_patterns(source).items():
        name = source.logs_option if source.logs else f"logs[{k}]"
        yield from ((name, place) for place in _find_places(source, k, pattern))


def _find_places(source: ExperimentSource, k: int, pattern: str | None) -> list[Place]:
    """The places that an entry of `logs` names: the files that match, or several recordings as one."""
    if pattern is not None:
        files = match_files(pattern, source_folder(source), source.listed)
        return [_part_of(file, source.data["logs"], k) for file in files]
    entry = source.data["logs"][k]
    offsets = entry.get("clock_offset_s")
    return [combine_recordings(entry["together"], offsets if isinstance(offsets, dict) else {}, source_folder(source))]


def _part_of(file: File, entries: Sequence[object], k: int) -> Place:
    """The place of entry k of `logs`: its file, or one log of it where several entries name the file."""
    plain_entries = [entry.model_dump() if isinstance(entry, LogSettings) else entry for entry in entries]
    file_names = [entry.get("file") if isinstance(entry, dict) else entry for entry in plain_entries]
    entry = plain_entries[k]
    if isinstance(file, RemoteFile) or file_names.count(file_names[k]) < 2 or not isinstance(entry, dict):
        return file
    name, window_s = entry.get("name"), entry.get("window_s")
    window_ends = [
        float(end) if isinstance(end, int | float) else end
        for end in (window_s if isinstance(window_s, list | tuple) else ())
    ]
    return DriveRecordings((file,), (0.0,), f"{name} {window_ends}") if name or window_ends else file


def _explain_unasked(source: ExperimentSource, k: int, pattern: str | None) -> str | None:
    """Why the places of an entry of `logs` cannot be found; None: they can."""
    if pattern is None:
        elsewhere = filter(is_url, source.data["logs"][k]["together"])
        return next((f"expected recordings on this machine, found {strip_credentials(url)}" for url in elsewhere), None)
    if _searches_everything(source_folder(source) / pattern):
        return f"expected a folder before `**`, found {pattern!r}, which searches all of this machine"
    why = source.listed.get(pattern)
    return why.problems[0] if isinstance(why, InputError) else None


def combine_recordings(names: Sequence[str], offset_s: Mapping[str, object], folder: Path) -> DriveRecordings:
    """Several recordings, by paths relative to a folder, as one log; an offset that is no number counts as 0."""
    offsets = [offset_s.get(name, 0.0) for name in names]
    ahead_s = tuple(float(offset) if isinstance(offset, int | float) else 0.0 for offset in offsets)
    return DriveRecordings(tuple(folder / name for name in names), ahead_s)


def _list_patterns(source: ExperimentSource) -> dict[int, tuple[Key, str | None, bool]]:
    """By number of an entry of `logs`: its key, its pattern (None: several recordings), whether it has a name."""
    entries = source.data.get("logs")
    result: dict[int, tuple[Key, str | None, bool]] = {}
    for k, entry in enumerate(entries if isinstance(entries, list | tuple) else []):
        if isinstance(entry, str):
            result[k] = (("logs", k), entry, False)
        elif isinstance(entry, dict) and isinstance(entry.get("file"), str):
            result[k] = (("logs", k, "file"), entry["file"], entry.get("name") is not None)
        elif isinstance(entry, dict) and _are_texts(entry.get("together")):
            result[k] = (("logs", k, "together"), None, entry.get("name") is not None)
    return result


def _are_texts(names: object) -> bool:
    return isinstance(names, list | tuple) and len(names) > 1 and all(isinstance(name, str) for name in names)


def resolve_entries(experiment: Experiment, source: ExperimentSource) -> tuple[str | LogSettings, ...]:
    """The entries of `logs`, a recording each, relative to the working folder."""
    entries: dict[Place, str | LogSettings] = {}
    for k, (_, pattern, _) in _list_patterns(source).items():
        entry = experiment.logs[k]
        for place in _find_places(source, k, pattern):
            resolved = (
                relocate_settings(entry, place)
                if isinstance(entry, LogSettings)
                else recording_address(first_recording(place))
            )
            entries.setdefault(place, resolved)
    return tuple(entries.values())


def recording_address(file: File) -> str:
    """The path of a recording, or its URL with user and query."""
    return file.url if isinstance(file, RemoteFile) else str(file)


def relocate_settings(
    entry: LogSettings, place: Place, address_of: Callable[[File], str] = recording_address
) -> LogSettings:
    """The settings of an entry for the recording or recordings at `place`, named by `address_of`."""
    if not isinstance(place, DriveRecordings) or len(place.paths) == 1:
        return entry.model_copy(update={"file": address_of(first_recording(place))})
    names = tuple(address_of(path) for path in place.paths)
    offsets = {name: ahead_s for name, ahead_s in zip(names, place.ahead_s, strict=True) if ahead_s}
    return entry.model_copy(update={"together": names} | ({"clock_offset_s": offsets} if offsets else {}))


def settings_places(entries: Sequence[LogEntry], k: int, folder: Path, listed: Listed | None = None) -> list[Place]:
    """The places of the recordings to which the settings of an entry apply."""
    entry = entries[k]
    if isinstance(entry, str):
        return []
    if entry.file is not None:
        return [_part_of(file, entries, k) for file in match_files(entry.file, folder, listed)]
    return [combine_recordings(entry.together or (), entry.clock_offset_s, folder)]


def place_identity(place: Place) -> str:
    """A text that identifies a recording, or several as one, whatever path or link leads there."""
    if isinstance(place, RemoteFile):
        return place.url
    paths, part = ([place], "") if isinstance(place, Path) else (place.paths, place.part)
    try:
        return "\n".join([*map(os.path.realpath, paths), *([part] if part else [])])
    except UnicodeEncodeError:  # half a character: no file has such a name
        return "\n".join(map(str, paths))


def source_folder(source: ExperimentSource) -> Path:
    """The folder that the paths of the logs are relative to."""
    return Path() if source.logs else source.path.parent


def replace_logs(source: ExperimentSource, paths: Sequence[str], option: str = "--log") -> ExperimentSource:
    """The source with other recordings to replay, relative to the working folder; those it names keep settings."""
    named = source.data.get("logs")
    patterns = [
        (entry, entry.get("file")) for entry in (named if isinstance(named, list) else []) if isinstance(entry, dict)
    ]
    entries: list[object] = []
    for path in paths:
        real = path if is_url(path) else os.path.realpath(path)
        matching = [
            entry
            for entry, pattern in patterns
            if isinstance(pattern, str)
            and any(place_identity(found) == real for found in match_files(pattern, source.path.parent, source.listed))
        ]
        alike = [entry for entry in matching if entry.get("file") == matching[0].get("file")]  # several logs of it
        entries += [{**entry, "file": path} for entry in alike] or [path]
    options = dict(source.options) | ({("logs",): option} if option != "--log" else {})
    data = _without_shown(source, _names_of(entries, Path(), source.listed)) | {"logs": entries}
    return replace(source, data=data, logs=tuple(paths), options=options)


def _without_shown(source: ExperimentSource, kept_names: set[str]) -> dict[str, Any]:
    """The data without those names in `show: {logs}` that are of logs of the file, and not among `kept_names`."""
    show, named = source.data.get("show"), source.data.get("logs")
    if not isinstance(show, dict) or not isinstance(show.get("logs"), list) or not isinstance(named, list):
        return source.data
    gone = _names_of(named, source.path.parent, source.listed) - kept_names
    logs = [name for name in show["logs"] if str(name).rpartition("/")[2] not in gone]
    return source.data | {"show": show | {"logs": logs or ["first"]}}


def _names_of(entries: Sequence[object], folder: Path, listed: Listed) -> set[str]:
    """Names of the logs of entries of `logs`, without the folders that tell logs of one name apart."""
    names: set[str] = set()
    for entry in entries:
        name, pattern = (entry.get("name"), entry.get("file")) if isinstance(entry, dict) else (None, entry)
        if name is not None:
            names.add(str(name))
        elif isinstance(pattern, str):
            names |= {
                f.path.stem if isinstance(f, RemoteFile) else name_log(f)
                for f in match_files(pattern, folder, listed)
                if isinstance(f, RemoteFile) or place_exists(f)  # else the name may be an impossible one
            }
    return names


def drop_settings(data: dict[str, Any], keys: Sequence[str]) -> dict[str, Any]:
    """The data of an experiment without these keys in the entries of its logs, as options take precedence."""
    logs = data.get("logs")
    if not isinstance(logs, list):
        return data
    bare = [{k: v for k, v in e.items() if k not in keys} if isinstance(e, dict) else e for e in logs]
    return data | {"logs": bare}


def match_files(pattern: str, folder: Path, listed: Listed | None = None) -> list[File]:
    """The files that a path relative to `folder`, or a URL, names, sorted. Without wildcards it need not exist.

    `listed`: URLs that were listed before; this one is added.
    """
    if is_url(pattern := local_path(pattern)):
        listed = {} if listed is None else listed
        if pattern not in listed:
            try:
                listed[pattern] = list(find_remote_files(pattern))
            except InputError as error:
                listed[pattern] = error
        files = listed[pattern]
        return [] if isinstance(files, InputError) else files
    if place_exists(folder / pattern) or not glob.has_magic(pattern):
        return [folder / pattern]
    if _searches_everything(folder / pattern):
        return []
    return [folder / name for name in sorted(glob.glob(pattern, root_dir=folder, recursive=True))]


def _searches_everything(pattern: Path) -> bool:
    """Whether a pattern searches all folders from the root of the file system on, which does not end."""
    parts = pattern.parts
    return "**" in parts and os.path.realpath(Path(*parts[: parts.index("**")])) == os.path.realpath("/")


def place_exists(place: Place) -> bool:
    """Whether there is a file or folder of this name; False for an impossible name. Raises InputError for a URL."""
    if isinstance(place, RemoteFile):
        return place.there is not None
    if isinstance(place, DriveRecordings):
        return all(map(place_exists, place.paths))
    try:
        return place.exists()
    except (OSError, ValueError):
        return False
