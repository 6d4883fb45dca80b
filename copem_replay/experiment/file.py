"""Experiment files: every problem with file, line and key."""

from __future__ import annotations

import difflib
import glob
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

from pydantic import ValidationError

from copem_replay.core.errors import ExperimentError
from copem_replay.core.yaml import AliasesError, Key, NotYamlError, read
from copem_replay.experiment.schema import Experiment


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
        experiment = Experiment.model_validate(source.data)
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
    """A line per key: the alternatives of one key are said in one, and only what was meant of several is said."""
    found: dict[Key, list[Any]] = {}
    for item in error.errors(include_url=False):
        if item["type"] == "too_short" and len(item["input"]) >= item["ctx"]["min_length"]:
            continue  # long enough, but what is in it was refused, which has its own line
        found.setdefault(_file_key(source.data, item), []).append(item)
    for key, items in found.items():
        if any(other[: len(key)] == key and len(other) > len(key) for other in found):
            continue  # another alternative fits so far, and says where it does not
        yield source.at(key, _message(items, key, source.data))


def _file_key(data: Any, item: Any) -> Key:
    """The location pydantic gives, without what is not in the file (names of alternatives, `[key]`)."""
    key: list[str | int] = []
    here, location = data, item["loc"]
    for k, part in enumerate(location):
        if isinstance(here, dict) and (part in here or (k == len(location) - 1 and item["type"] == "missing")):
            key.append(part)
            here = here.get(part)
        elif isinstance(here, list) and isinstance(part, int):
            key.append(part)
            here = here[part] if part < len(here) else None
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


def _unit(written: str, meant: str) -> str:
    """That a key has another unit than the one it was taken for, where names say so."""
    (name, _, unit), (other, _, right) = written.rpartition("_"), meant.rpartition("_")
    return f" (in {right}, not {unit})" if name == other and name else ""


def _message(items: Sequence[Any], key: Key, data: Any) -> str:
    first = items[0]
    if first["type"] == "extra_forbidden":
        known = _names_at(key[:-1], data)
        near = difflib.get_close_matches(str(key[-1]), known, n=1)
        hint = f"did you mean {near[0]}?{_unit(str(key[-1]), near[0])}" if near else f"known here: {', '.join(known)}"
        if _RENAMED.get(str(key[-1])) in known:
            return f"`{key[-1]}` is called `{_RENAMED[str(key[-1])]}` now"
        if key[-1] in _DEVIATIONS and "covariance_m2" in known:
            hint = f"{_variances(first['input'])} says it"
        return "unknown key" + (f"; {hint}" if known else "")
    if first["type"] == "missing":
        return "missing"
    if own := [item for item in items if item["type"] not in _EXPECTED]:
        return str(own[0]["msg"]).removeprefix("Value error, ")
    if first["type"] == "too_short" and isinstance(first["input"], Mapping):
        return "expected at least one, found none"
    words = dict.fromkeys(_EXPECTED[item["type"]].format(**item.get("ctx", {})) for item in items)
    return f"expected {', or '.join(words)}, found {_short(first['input'])}{_percent(first)}"


_RENAMED = {"share": "penetration_rate"}
"""Keys of version 0.1, and what they are called now."""
_DEVIATIONS = ("sigma_m", "sigma", "std_m", "std", "stddev_m", "stddev")


def _variances(sigma_m: object) -> str:
    """How a covariance is written that was given as a standard deviation."""
    variance = f"{sigma_m**2:g}" if isinstance(sigma_m, int | float) else "σ²"
    return f"`covariance_m2: [[{variance}, 0], [0, {variance}]]`"


def _percent(item: Any) -> str:
    """How a fraction is written that seems to have been given in per cent."""
    is_share = item["type"] == "less_than_equal" and item["ctx"]["le"] == 1
    if not is_share or not 2 < item["input"] <= 100:  # 1.5 and 2 are other mistakes (chosen)
        return ""
    return f"; a fraction: {item['input']:g} % is {item['input'] / 100:g}"


def _names_at(key: Key, data: Any) -> list[str]:
    """The keys that are known at a place of the file."""
    schema = Experiment.model_json_schema()

    def alternatives(part: Any) -> Iterator[dict[str, Any]]:
        if isinstance(part, dict):
            if "$ref" in part:
                part = schema["$defs"][part["$ref"].rpartition("/")[2]]
            yield part
            for inner in (*part.get("anyOf", ()), *part.get("oneOf", ())):
                yield from alternatives(inner)

    places = [*alternatives(schema)]
    for step in key:
        data = data[step]
        if isinstance(step, int):
            inner = [p.get("items") or (p.get("prefixItems") or [{}])[0] for p in places]
        else:
            inner = [p.get("properties", {}).get(step) or p.get("additionalProperties") for p in places]
        places = [found for part in inner for found in alternatives(part)]
    names = [place["properties"] for place in places if "properties" in place]
    meant = [place for place in names if _is_meant(place.get("kind", {}), data.get("kind"))]
    return sorted({name for place in meant or names for name in place})


def _is_meant(kinds: Mapping[str, Any], kind: object) -> bool:
    """Whether keys go with `kind:` as the file says it, or leaves it to the default."""
    known = [kinds["const"]] if "const" in kinds else kinds.get("enum", [])
    return kind in known or (kind is None and "default" in kinds)


def _short(value: object) -> str:
    words = {None: "nothing", True: "true", False: "false"}
    text = words[value] if value is None or isinstance(value, bool) else repr(value)
    return text if len(text) <= 60 else text[:57] + "…"


def log_paths(source: Source) -> tuple[dict[Path, Key | None], list[str]]:
    """The recordings to replay and where the file names each, globs resolved (sorted); which patterns match none."""
    paths: dict[Path, Key | None] = {}
    problems: list[str] = []
    for pattern in source.logs:
        found = matching(pattern, Path())
        paths |= dict.fromkeys(found)
        problems += [] if found else [f"{source.logs_option}: no file matches {pattern!r}"]
    named = source.data.get("logs")
    for k, pattern in enumerate(named if isinstance(named, list) and not source.logs else []):
        if isinstance(pattern, str):
            found = matching(pattern, source.path.parent)
            paths |= dict.fromkeys(found, ("logs", k))
            problems += [] if found else [source.at(("logs", k), f"no file matches {pattern!r}")]
    return paths, problems


def named_paths(source: Source) -> Iterator[tuple[str, Path]]:
    """Each recording as often as it is named, and by what: `logs[0]`, `--log`."""
    for pattern in source.logs:
        yield from ((source.logs_option, path) for path in matching(pattern, Path()))
    named = source.data.get("logs")
    for k, pattern in enumerate(named if isinstance(named, list) and not source.logs else []):
        if isinstance(pattern, str):
            yield from ((f"logs[{k}]", path) for path in matching(pattern, source.path.parent))


def matching(pattern: str, folder: Path) -> list[Path]:
    """The files a path relative to `folder` names, sorted; a path without wildcards names itself, there or not."""
    if is_there(folder / pattern) or not glob.has_magic(pattern):
        return [folder / pattern]
    return [folder / name for name in sorted(glob.glob(pattern, root_dir=folder, recursive=True))]


def is_there(path: Path) -> bool:
    """Whether there is something of this name; a name no file can have is none."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False
