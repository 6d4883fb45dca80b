"""Experiment files: every problem with file, line and key."""

from __future__ import annotations

import glob
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self, TypeAlias

from pydantic import ValidationError

from copem_replay.core.errors import ExperimentError, InputError
from copem_replay.core.remote import Remote, bare, is_url, local_path, matches
from copem_replay.core.yaml import AliasesError, Key, NotYamlError, read
from copem_replay.experiment.schema import Experiment, LogSettings
from copem_replay.experiment.shape_problems import by_key
from copem_replay.io.together import File, Place, Together, first_of

Listed: TypeAlias = dict[str, list[File] | InputError]
"""What URLs match, or why they cannot be asked, by the URL: asked once."""


class Problem(str):
    """What is wrong with a file, in one line that names its place. `line`: which line of the file it names."""

    line: int

    def __new__(cls, text: str, line: int) -> Self:
        """Return the text with the number of its line."""
        problem = super().__new__(cls, text)
        problem.line = line
        return problem


@dataclass(frozen=True)
class Source:
    """An experiment file as plain data, and where each key stands."""

    path: Path
    data: dict[str, Any]
    lines: dict[Key, int]
    problems: tuple[str, ...]  # of its YAML: the file is refused, but the rest is checked all the same
    logs: tuple[str, ...] = ()  # to replay instead of those it names, relative to where we are
    options: Mapping[Key, str] = field(default_factory=dict)  # of the command line: keys that they have set
    listed: Listed = field(default_factory=dict)

    @property
    def logs_option(self) -> str:
        """What `logs` were given by."""
        return self.options.get(("logs",), "--log")

    def at(self, key: Key, message: str, line: int | None = None) -> str:
        """`file:line: key: message`; by default the line of the key, or of what it should be in.

        Where an option set the key, `--option: message`.
        """
        if key in self.options:
            return f"{self.options[key]}: {message}"
        if line is None:
            line = next(self.lines[key[:n]] for n in range(len(key), -1, -1) if key[:n] in self.lines)
        name = dotted(key)
        return Problem(f"{self.path}:{line}: {name + ': ' if name else ''}{message}", line)


@dataclass(frozen=True)
class PlainSource(Source):
    """An experiment that is made in Python and stands in no file: it need not name its logs, and keys have no line."""

    def at(self, key: Key, message: str, line: int | None = None) -> str:
        """`experiment: key: message`; where an option set the key, `option: message`."""
        name = self.options.get(key) or ": ".join(filter(None, (str(self.path), dotted(key))))
        return f"{name}: {message}"


def plain(data: Mapping[str, Any]) -> PlainSource:
    """The plain data of an experiment as a source. Paths of its logs are relative to the working folder."""
    return PlainSource(Path("experiment"), dict(data), {(): 1}, ())


def dotted(key: Key) -> str:
    """`units.ego.height_m`, `logs[0]`."""
    text = ""
    for part in key:
        name = part or "''"
        text += f"[{part}]" if isinstance(part, int) else f".{name}" if text else str(name)
    return text


def load(path: Path) -> Source:
    """A file as plain data. Raises ExperimentError when it cannot be read or is not YAML."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ExperimentError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise ExperimentError(f"{path}: is a folder; expected an experiment file (YAML)") from None
    except UnicodeDecodeError as error:
        line, byte = error.object.count(b"\n", 0, error.start) + 1, error.object[error.start]
        raise ExperimentError(f"{path}:{line}: expected YAML text in UTF-8, found byte {byte:#x}") from None
    except OSError as error:
        raise ExperimentError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        data, lines, problems = read(text)
    except AliasesError as error:
        raise ExperimentError(f"{path}:{error.line}: {error.why}") from None
    except NotYamlError as error:
        raise ExperimentError(f"{path}:{error.line}: not YAML: {error.why}") from None
    if not isinstance(data, dict):
        found = "an empty file" if data is None else "a list" if isinstance(data, list) else "text"
        raise ExperimentError(f"{path}:1: expected keys and values such as `version: 1`, found {found}")
    source = Source(path, data, lines, ())
    return replace(source, problems=tuple(source.at(key, message, line) for key, line, message in problems))


def parse(source: Source) -> tuple[Experiment | None, list[str]]:
    """The experiment, or None, and every problem of its shape."""
    problems = list(source.problems)
    try:
        # What a plain experiment names is relative to where we are.
        folder = None if isinstance(source, PlainSource) else source.path.parent
        experiment = Experiment.model_validate(source.data, context={"folder": folder})
    except ValidationError as error:
        found = list(_problems(source, error))
        first = sum(line == source.at(("version",), "missing") for line in found)  # in the order of the keys
        return None, [*problems, *found[:first], *_logs_missing(source), *found[first:]]
    missing = _logs_missing(source)
    return (None if missing else experiment), problems + missing


def _logs_missing(source: Source) -> list[str]:
    """That a file names no logs; they are optional in Python only."""
    given = "logs" in source.data or isinstance(source, PlainSource)
    return [] if given else [source.at(("logs",), "missing")]


def _problems(source: Source, error: ValidationError) -> Iterator[str]:
    for key, message in by_key(Experiment, error, source.data):
        yield source.at(key, message)


def log_paths(source: Source) -> tuple[dict[Place, Key | None], list[str]]:
    """The recordings to replay and where the file names each, globs resolved (sorted); which patterns match none."""
    paths: dict[Place, Key | None] = {}
    problems: list[str] = []
    for k, (key, pattern, named) in _patterns(source).items():
        found = _places(source, k, pattern)
        if why := _unasked(source, k, pattern):
            problems.append(f"{source.logs_option}: {why}" if source.logs else source.at(key, why))
            continue
        paths |= dict.fromkeys(found, None if source.logs else ("logs", k))
        if not found and source.logs:
            problems.append(f"{source.logs_option}: no file matches {pattern!r}")
        elif not found:
            problems.append(source.at(key, f"no file matches {pattern!r}"))
        elif named and len(found) > 1:
            message = f"a name goes with one recording; {pattern!r} matches {len(found)}"
            problems.append(source.at(("logs", k, "name"), message))
    return paths, problems


def named_paths(source: Source) -> Iterator[tuple[str, Place]]:
    """Each recording as often as it is named, and by what: `logs[0]`, `--log`."""
    for k, (_, pattern, _) in _patterns(source).items():
        name = source.logs_option if source.logs else f"logs[{k}]"
        yield from ((name, place) for place in _places(source, k, pattern))


def _places(source: Source, k: int, pattern: str | None) -> list[Place]:
    """What an entry of `logs` names: files that match, or several recordings as one."""
    if pattern is not None:
        return list(matching(pattern, folder_of(source), source.listed))
    entry = source.data["logs"][k]
    offsets = entry.get("clock_offset_s")
    return [together(entry["together"], offsets if isinstance(offsets, dict) else {}, folder_of(source))]


def _unasked(source: Source, k: int, pattern: str | None) -> str | None:
    """Why it cannot be told what an entry of `logs` names."""
    if pattern is None:
        elsewhere = filter(is_url, source.data["logs"][k]["together"])
        return next((f"expected recordings on this machine, found {bare(url)}" for url in elsewhere), None)
    why = source.listed.get(pattern)
    return why.problems[0] if isinstance(why, InputError) else None


def together(names: Sequence[str], offset_s: Mapping[str, object], folder: Path) -> Together:
    """Several recordings, by paths relative to a folder, as one log; what is no offset counts as none."""
    said = [offset_s.get(name, 0.0) for name in names]
    ahead_s = tuple(float(one) if isinstance(one, int | float) else 0.0 for one in said)
    return Together(tuple(folder / name for name in names), ahead_s)


def _patterns(source: Source) -> dict[int, tuple[Key, str | None, bool]]:
    """By its number what each entry of `logs` matches: its key, the pattern (None: several), whether it has a name."""
    entries = source.data.get("logs")
    result: dict[int, tuple[Key, str | None, bool]] = {}
    for k, entry in enumerate(entries if isinstance(entries, list | tuple) else []):
        if isinstance(entry, str):
            result[k] = (("logs", k), entry, False)
        elif isinstance(entry, dict) and isinstance(entry.get("file"), str):
            result[k] = (("logs", k, "file"), entry["file"], entry.get("name") is not None)
        elif isinstance(entry, dict) and _all_text(entry.get("together")):
            result[k] = (("logs", k, "together"), None, entry.get("name") is not None)
    return result


def _all_text(names: object) -> bool:
    return isinstance(names, list | tuple) and len(names) > 1 and all(isinstance(name, str) for name in names)


def entries_of(experiment: Experiment, source: Source) -> tuple[str | LogSettings, ...]:
    """The entries of `logs`, a recording each, relative to the working folder."""
    entries: dict[Place, str | LogSettings] = {}
    for k, (_, pattern, _) in _patterns(source).items():
        entry = experiment.logs[k]
        for place in _places(source, k, pattern):
            alone = at_place(entry, place) if isinstance(entry, LogSettings) else address(first_of(place))
            entries.setdefault(place, alone)
    return tuple(entries.values())


def address(file: File) -> str:
    """What leads to a recording: a path, or a URL with all that lets us in."""
    return file.url if isinstance(file, Remote) else str(file)


def at_place(entry: LogSettings, place: Place, called: Callable[[File], str] = address) -> LogSettings:
    """The settings of a recording, or of several as one, that lie elsewhere, or are called otherwise."""
    if not isinstance(place, Together):
        return entry.model_copy(update={"file": called(place)})
    names = tuple(called(path) for path in place.paths)
    offsets = {name: ahead_s for name, ahead_s in zip(names, place.ahead_s, strict=True) if ahead_s}
    return entry.model_copy(update={"together": names} | ({"clock_offset_s": offsets} if offsets else {}))


def places_of(entry: LogSettings, folder: Path, listed: Listed | None = None) -> list[Place]:
    """The recordings that settings are for."""
    if entry.file is not None:
        return list(matching(entry.file, folder, listed))
    return [together(entry.together or (), entry.clock_offset_s, folder)]


def identity(place: Place) -> str:
    """The same for the same recordings, whatever leads there."""
    if isinstance(place, Remote):
        return place.url
    return os.path.realpath(place) if isinstance(place, Path) else "\n".join(map(os.path.realpath, place.paths))


def folder_of(source: Source) -> Path:
    """What the paths of its logs are relative to."""
    return Path() if source.logs else source.path.parent


def with_logs(source: Source, paths: Sequence[str], option: str = "--log") -> Source:
    """The source with other recordings to replay, relative to where we are; those it names keep their settings."""
    named = source.data.get("logs")
    mine = [
        (entry, entry.get("file")) for entry in (named if isinstance(named, list) else []) if isinstance(entry, dict)
    ]
    entries: list[object] = []
    for path in paths:
        real = path if is_url(path) else os.path.realpath(path)
        same = (
            entry
            for entry, pattern in mine
            if isinstance(pattern, str)
            and any(identity(found) == real for found in matching(pattern, source.path.parent, source.listed))
        )
        entries.append({**entry, "file": path} if (entry := next(same, None)) is not None else path)
    options = dict(source.options) | ({("logs",): option} if option != "--log" else {})
    return replace(source, data=source.data | {"logs": entries}, logs=tuple(paths), options=options)


def without_settings(data: dict[str, Any], keys: Sequence[str]) -> dict[str, Any]:
    """The data of an experiment without these keys in the entries of its logs: options go before them."""
    logs = data.get("logs")
    if not isinstance(logs, list):
        return data
    bare = [{k: v for k, v in e.items() if k not in keys} if isinstance(e, dict) else e for e in logs]
    return data | {"logs": bare}


def matching(pattern: str, folder: Path, listed: Listed | None = None) -> list[File]:
    """The files a path relative to `folder`, or a URL, names, sorted; without wildcards it names itself, there or not.

    `listed`: what URLs were found to match, or why they cannot be asked.
    """
    if is_url(pattern := local_path(pattern)):
        listed = {} if listed is None else listed
        if pattern not in listed:
            try:
                listed[pattern] = list(matches(pattern))
            except InputError as error:
                listed[pattern] = error
        found = listed[pattern]
        return [] if isinstance(found, InputError) else found
    if is_there(folder / pattern) or not glob.has_magic(pattern):
        return [folder / pattern]
    return [folder / name for name in sorted(glob.glob(pattern, root_dir=folder, recursive=True))]


def is_there(place: Place) -> bool:
    """Whether there is something of this name; a name no file can have is none. Raises InputError."""
    if isinstance(place, Remote):
        return place.there is not None
    if isinstance(place, Together):
        return all(map(is_there, place.paths))
    try:
        return place.exists()
    except (OSError, ValueError):
        return False
