"""Experiment files: YAML 1.2 in and out, every problem with file, line and key."""

from __future__ import annotations

import difflib
import glob
from collections.abc import Iterator
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, SequenceNode

from copem_replay.errors import ExperimentError
from copem_replay.experiment import Experiment

Key = tuple[str | int, ...]


@dataclass(frozen=True)
class Source:
    """An experiment file as plain data, and where each key stands."""

    path: Path
    data: dict[str, Any]
    lines: dict[Key, int]
    problems: tuple[str, ...]  # duplicate keys: the file is refused, but the rest is checked all the same

    def at(self, key: Key, message: str) -> str:
        """`file:line: key: message`."""
        known = next(key[:n] for n in range(len(key), -1, -1) if key[:n] in self.lines)
        name = dotted(key)
        return f"{self.path}:{self.lines[known]}: {name + ': ' if name else ''}{message}"


def dotted(key: Key) -> str:
    """`units.ego.height_m`, `logs[0]`."""
    text = ""
    for part in key:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else str(part)
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
        raise ExperimentError(
            f"{path}: expected YAML text in UTF-8, found byte {error.object[error.start]:#x}"
        ) from None
    except OSError as error:
        raise ExperimentError(f"{path}: cannot be read: {error.strerror}") from None
    reader = YAML(typ="safe", pure=True)
    try:
        root = reader.compose(StringIO(text))
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else 1
        raise ExperimentError(f"{path}:{line}: not YAML: {error.problem or error.context}") from None
    except YAMLError as error:
        raise ExperimentError(f"{path}:1: not YAML: {' '.join(str(error).split())}") from None
    if not isinstance(root, MappingNode):
        found = "an empty file" if root is None else f"a {root.id}"
        raise ExperimentError(f"{path}:1: expected keys and values such as `version: 1`, found {found}")
    lines: dict[Key, int] = {(): 1}
    duplicates: list[tuple[Key, int]] = []
    data = _plain(root, (), lines, duplicates, reader)
    problems = tuple(f"{path}:{line}: {dotted(key)}: key given twice" for key, line in duplicates)
    return Source(path, data, lines, problems)


def _plain(node: Node, key: Key, lines: dict[Key, int], duplicates: list[tuple[Key, int]], reader: YAML) -> Any:
    if isinstance(node, MappingNode):
        mapping: dict[Any, Any] = {}
        for name_node, value_node in node.value:
            name = reader.constructor.construct_object(name_node, deep=True)
            # Ids may be numbers or text; any other key is text anyway.
            name = str(name) if isinstance(name, int) and not isinstance(name, bool) else name_node.value
            inner = (*key, name)
            line = name_node.start_mark.line + 1
            if name in mapping:
                duplicates.append((inner, line))
                continue
            lines[inner] = line
            mapping[name] = _plain(value_node, inner, lines, duplicates, reader)
        return mapping
    if isinstance(node, SequenceNode):
        items = []
        for k, item in enumerate(node.value):
            lines[(*key, k)] = item.start_mark.line + 1
            items.append(_plain(item, (*key, k), lines, duplicates, reader))
        return items
    return reader.constructor.construct_object(node, deep=True)


def parse(source: Source) -> tuple[Experiment | None, list[str]]:
    """The experiment, or None, and every problem of its shape."""
    problems = list(source.problems)
    try:
        experiment = Experiment.model_validate(source.data)
    except ValidationError as error:
        problems += _problems(source, error)
        return None, problems
    return experiment, problems


def _problems(source: Source, error: ValidationError) -> Iterator[str]:
    seen = set()
    for item in error.errors(include_url=False):
        key = _file_key(source.data, item["loc"])
        if item["type"] == "too_short" and len(item["input"]) >= item["ctx"]["min_length"]:
            continue  # long enough, but what is in it was refused, which has its own line
        if key not in seen:  # alternatives of one key: the first says enough
            seen.add(key)
            yield source.at(key, _message(item, key))


def _file_key(data: Any, location: tuple[str | int, ...]) -> Key:
    """Pydantic's location without what is not in the file (names of alternatives, `[key]`)."""
    key: list[str | int] = []
    here = data
    for k, part in enumerate(location):
        if isinstance(here, dict) and (part in here or k == len(location) - 1):
            key.append(part)
            here = here.get(part)
        elif isinstance(here, list) and isinstance(part, int):
            key.append(part)
            here = here[part] if part < len(here) else None
    while key and key[-1] == "[key]":
        key.pop()
    return tuple(key)


def _message(item: Any, key: Key) -> str:
    kind, found = item["type"], _short(item["input"])
    if kind == "extra_forbidden":
        near = difflib.get_close_matches(str(key[-1]), _known_names(), n=1)
        return "unknown key" + (f"; did you mean {near[0]}?" if near else "")
    if kind == "missing":
        return "missing"
    if kind == "union_tag_invalid":
        return f"expected kind: one of {item['ctx']['expected_tags']}; found {item['ctx']['tag']!r}"
    message: str = item["msg"].removeprefix("Value error, ")
    if kind in ("value_error", "component"):
        return message
    message = message[0].lower() + message[1:].removesuffix(".")
    message = message.replace("input should be", "expected").replace("expected expected", "expected")
    return f"{message}, found {found}"


def _known_names() -> list[str]:
    names: set[str] = set()

    def walk(schema: Any) -> None:
        if isinstance(schema, dict):
            names.update(schema.get("properties", {}))
            for value in schema.values():
                walk(value)
        elif isinstance(schema, list):
            for value in schema:
                walk(value)

    walk(Experiment.model_json_schema())
    return sorted(names)


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "…"


def log_paths(source: Source) -> tuple[list[Path], list[str]]:
    """The recordings of `logs:`, globs resolved (sorted), and what is wrong with them."""
    paths: list[Path] = []
    problems: list[str] = []
    logs = source.data.get("logs")
    for k, pattern in enumerate(logs if isinstance(logs, list) else []):
        if not isinstance(pattern, str):
            continue
        full = source.path.parent / pattern
        if full.exists() or not glob.has_magic(pattern):
            paths.append(full)
            continue
        found = sorted(glob.glob(str(full), recursive=True))
        if not found:
            problems.append(source.at(("logs", k), f"no file matches {pattern!r}"))
        paths += [Path(name) for name in found]
    return paths, problems


def dump(data: dict[str, Any]) -> str:
    """Plain data as YAML 1.2 text, keys in order; short lists on one line."""
    writer = YAML(typ="rt", pure=True)
    writer.default_flow_style = None
    writer.width = 110
    text = StringIO()
    writer.dump(data, text)
    return text.getvalue()
