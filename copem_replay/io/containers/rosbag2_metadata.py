"""`metadata.yaml` of a rosbag2 folder: which files it has, and what keeps them from being read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from copem_replay.core.errors import RecordingError
from copem_replay.core.text import counted
from copem_replay.core.yaml import NotYamlError, composed
from copem_replay.io.containers.unsupported import CONVERT, unpacking

METADATA = "metadata.yaml"
_INFORMATION = "rosbag2_bagfile_information"
_LONGEST_BYTES = 1 << 19
"""A longer description is none (chosen: three hundred topics and a thousand files take half of it)."""


def files_of(folder: Path) -> list[Path]:
    """The MCAP files of a folder in the order it names them: all are there. Raises RecordingError."""
    place = folder / METADATA
    information = _information(folder)
    storage = _text(information, "storage_identifier")
    names = _names(information)
    if not names:
        raise RecordingError("names no file (`relative_file_paths`)", path=place)
    if storage == "sqlite3" or any(name.endswith(".db3") for name in names):
        raise RecordingError(f"its files are of SQLite (.db3), which is not read; {CONVERT}", path=folder)
    if _text(information, "compression_mode").lower() == "message":
        raise RecordingError(f"its messages are compressed one by one, which is not read; {CONVERT}", path=folder)
    return [_file(folder, name) for name in names]


def unnamed_in(folder: Path, named: Sequence[Path]) -> Iterator[str]:
    """Say that there are more MCAP files in a folder than it names."""
    known = {path.name for path in named}
    others = sorted(path.name for path in folder.glob("*.mcap") if path.name not in known)
    if others:
        more = " …" if len(others) > 1 else ""
        yield f"{counted(len(others), 'file')} that {METADATA} does not name not read: {others[0]}{more}"


def _information(folder: Path) -> Node:
    place = folder / METADATA
    try:
        with place.open("rb") as file:
            content = file.read(_LONGEST_BYTES + 1)
    except FileNotFoundError:
        how = "; name its files as logs of their own, or let `ros2 bag reindex` write it: then they are one"
        inside = how if any(folder.glob("*.mcap")) else ""
        raise RecordingError(f"expected a recording, found a folder without {METADATA}{inside}", path=folder) from None
    except OSError as error:
        raise RecordingError(f"cannot be opened: {error.strerror}", path=place) from None
    if len(content) > _LONGEST_BYTES:
        raise RecordingError("expected the description of a rosbag2 folder, found more than 512 KiB", path=place)
    try:
        root = composed(content.decode())
    except UnicodeDecodeError:
        raise RecordingError("expected YAML, found text that is not UTF-8", path=place) from None
    except NotYamlError as error:
        raise RecordingError(f"not YAML: line {error.line}: {error.why}", path=place) from None
    information = _inner(root, _INFORMATION)
    if not isinstance(information, MappingNode):
        raise RecordingError(f"expected the description of a rosbag2 folder, found no `{_INFORMATION}`", path=place)
    return information


def _names(information: Node) -> list[str]:
    """Each file once: `relative_file_paths`, and those that only `files` has."""
    listed = _inner(information, "relative_file_paths")
    names = [item.value for item in _items(listed) if isinstance(item, ScalarNode)]
    names += [_text(item, "path") for item in _items(_inner(information, "files"))]
    return list(dict.fromkeys(name for name in names if name))


def _file(folder: Path, name: str) -> Path:
    path = folder / name
    if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts or "\0" in name:
        raise RecordingError(f"expected files of the folder, found {name!r}", path=folder / METADATA)
    how = unpacking(path)
    try:
        if how is not None and path.with_suffix("").is_file():  # it was unpacked; what describes it stays as it is
            return path.with_suffix("")
        there = path.exists()
    except OSError:  # a name that no file can have
        there = False
    if not there:
        raise RecordingError(f"no such file, but {METADATA} names it", path=path)
    if how is not None:
        raise RecordingError(how, path=path)
    return path


def _inner(node: Node | None, name: str) -> Node | None:
    """What a key of a mapping holds; aliases are not followed through, so that nothing can grow."""
    if not isinstance(node, MappingNode):
        return None
    return next((v for k, v in node.value if isinstance(k, ScalarNode) and k.value == name), None)


def _items(node: Node | None) -> list[Node]:
    return list(node.value) if isinstance(node, SequenceNode) else []


def _text(node: Node | None, name: str) -> str:
    inner = _inner(node, name)
    return str(inner.value) if isinstance(inner, ScalarNode) else ""
