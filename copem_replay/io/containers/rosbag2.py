"""A rosbag2 folder as one recording: the files that its `metadata.yaml` names, in order of log time.

Channels of several files that agree in topic, schema, encoding and metadata are one. A file is opened when its first
message is due, and closed after its last one. A damaged file is read as far as it goes; of several files, one that
cannot be read at all is left out with a note.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath

from mcap.records import Message
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from copem_replay.core.errors import RecordingError, count_noun
from copem_replay.core.yaml import NotYamlError, compose_nodes
from copem_replay.io.channel import Channel
from copem_replay.io.containers.mcap_records import renumber_message
from copem_replay.io.containers.sqlite import DB3, open_sqlite
from copem_replay.io.log import CONVERT, BrokenIndexError, Log, open_from_start, open_mcap, unpacking_advice
from copem_replay.io.window import Window, has_overlap

# `metadata.yaml`: the files of the folder, and reasons why they are not read.

METADATA = "metadata.yaml"
_INFORMATION = "rosbag2_bagfile_information"
_LONGEST_BYTES = 1 << 19
"""A longer file is no description: three hundred topics and a thousand files take half of it."""


def list_bag_files(folder: Path) -> list[Path]:
    """The files of a folder in the order of its description; all of them exist. Raises RecordingError."""
    place = folder / METADATA
    information = _find_information(folder)
    names = _list_file_names(information)
    if not names:
        raise RecordingError("names no file (`relative_file_paths`)", path=place)
    if _node_text(information, "compression_mode").lower() == "message":
        raise RecordingError(f"its messages are compressed one by one, which is not read; {CONVERT}", path=folder)
    return [_bag_file_path(folder, name) for name in names]


def note_unnamed_files(folder: Path, named: Sequence[Path]) -> Iterator[str]:
    """A note if a folder has MCAP files that its description does not name."""
    names = {path.name for path in named}
    others = sorted(path.name for path in folder.glob("*.mcap") if path.name not in names)
    if others:
        more = " …" if len(others) > 1 else ""
        yield f"{count_noun(len(others), 'file')} that {METADATA} does not name not read: {others[0]}{more}"


def _find_information(folder: Path) -> Node:
    """The mapping in the folder's `metadata.yaml`. Raises RecordingError: there is none, or it is unreadable."""
    place = folder / METADATA
    try:
        with place.open("rb") as file:
            content = file.read(_LONGEST_BYTES + 1)
    except FileNotFoundError:
        advice = "; name its files as logs of their own, or let `ros2 bag reindex` write it: then they are one"
        ending = advice if any([*folder.glob("*.mcap"), *folder.glob("*.db3")]) else ""
        raise RecordingError(f"expected a recording, found a folder without {METADATA}{ending}", path=folder) from None
    except OSError as error:
        raise RecordingError(f"cannot be opened: {error.strerror}", path=place) from None
    if len(content) > _LONGEST_BYTES:
        raise RecordingError("expected the description of a rosbag2 folder, found more than 512 KiB", path=place)
    try:
        root = compose_nodes(content.decode())
    except UnicodeDecodeError:
        raise RecordingError("expected YAML, found text that is not UTF-8", path=place) from None
    except NotYamlError as error:
        raise RecordingError(f"not YAML: line {error.line}: {error.why}", path=place) from None
    information = _inner_node(root, _INFORMATION)
    if not isinstance(information, MappingNode):
        raise RecordingError(f"expected the description of a rosbag2 folder, found no `{_INFORMATION}`", path=place)
    return information


def _list_file_names(information: Node) -> list[str]:
    """The named files, each once: `relative_file_paths`, then those that only `files` has."""
    listed = _inner_node(information, "relative_file_paths")
    names = [item.value for item in _item_nodes(listed) if isinstance(item, ScalarNode)]
    names += [_node_text(item, "path") for item in _item_nodes(_inner_node(information, "files"))]
    return list(dict.fromkeys(name for name in names if name))


def _bag_file_path(folder: Path, name: str) -> Path:
    """The path of a named file, or of what it was unpacked to. RecordingError: outside, missing, compressed."""
    path = folder / name
    if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts or "\0" in name:
        raise RecordingError(f"expected files of the folder, found {name!r}", path=folder / METADATA)
    advice = unpacking_advice(path)
    try:
        if advice is not None and path.with_suffix("").is_file():  # it was unpacked, and its description left as it was
            return path.with_suffix("")
        exists = path.exists()
        if not exists and (folder / PurePosixPath(name).name).exists():  # before Foxy names began with the folder's
            return _bag_file_path(folder, PurePosixPath(name).name)
    except OSError:  # a name that no file can have
        exists = False
    if not exists:
        raise RecordingError(f"no such file, but {METADATA} names it", path=path)
    if advice is not None:
        raise RecordingError(advice, path=path)
    return path


def _inner_node(node: Node | None, name: str) -> Node | None:
    """The value of a key of a mapping; aliases are not expanded, so that nothing can grow."""
    if not isinstance(node, MappingNode):
        return None
    return next((v for k, v in node.value if isinstance(k, ScalarNode) and k.value == name), None)


def _item_nodes(node: Node | None) -> list[Node]:
    return list(node.value) if isinstance(node, SequenceNode) else []


def _node_text(node: Node | None, name: str) -> str:
    inner = _inner_node(node, name)
    return str(inner.value) if isinstance(inner, ScalarNode) else ""


def merge_streams(streams: Sequence[tuple[int, Callable[[], Iterator[Message]]]]) -> Iterator[Message]:
    """Messages of several streams in order of log time. A stream, in order itself: (first log time, how to open it)."""
    waiting: list[tuple[int, int, Message | None]] = [(start, k, None) for k, (start, _) in enumerate(streams)]
    heapq.heapify(waiting)
    running: dict[int, Iterator[Message]] = {}
    while waiting:
        _, k, message = waiting[0]
        if message is None:
            running[k] = streams[k][1]()
        else:
            yield message
        if (following := next(running[k], None)) is None:
            heapq.heappop(waiting)
            del running[k]
        else:
            heapq.heapreplace(waiting, (following.log_time, k, following))


@dataclass(frozen=True)
class BagFile:
    """One file of a folder."""

    log: Log
    numbers: Mapping[int, int]  # channel numbers of the folder, by those of the file


@dataclass(frozen=True)
class BagLog(Log):
    """The log of a folder."""

    parts: tuple[BagFile, ...] = ()
    lost: tuple[str, ...] = ()  # files that cannot be read at all, and why

    def messages(self, numbers: Set[int], *, sort: bool = False) -> Iterator[Message]:
        """Messages of these channels by log time; at equal times in the order of files. Raises BrokenIndexError."""
        streams: list[tuple[int, Callable[[], Iterator[Message]]]] = []
        for part in self.parts:
            numbers_in_log = {theirs: ours for theirs, ours in part.numbers.items() if ours in numbers}
            filled = {c.number for c in part.log.channels if c.number in numbers_in_log and c.messages}
            if has_overlap(part.log.spans(filled).values(), part.log.start_ns, part.log.end_ns):
                streams.append((part.log.start_ns, partial(_read_renumbered, part.log, numbers_in_log, sort)))
        yield from merge_streams(streams)

    def file_bytes(self) -> int:
        """Size of the files that are read."""
        return sum(part.log.file_bytes() for part in self.parts)

    def within(self, window: Window | None) -> Log:
        """The log with every file restricted to a window."""
        parts = tuple(replace(part, log=part.log.within(window)) for part in self.parts)
        return replace(self, window=window, parts=parts)

    def from_start(self, error: BrokenIndexError) -> Log:
        """The log with every file opened without its index. Raises RecordingError."""
        logs, unread = [], list(self.lost)
        for part in self.parts:
            log = part.log
            try:
                cause = error.__cause__ if log.path == error.path else None
                logs.append(open_from_start(log.path, cause, log.channels) if log.indexed else log)
            except RecordingError as failure:
                unread.append(_error_in_file(log.path, failure))
        return _join_bag_files(self.path, logs, unread, self.notes).within(self.window)


def _read_renumbered(log: Log, numbers: Mapping[int, int], sort: bool) -> Iterator[Message]:
    return (renumber_message(message, numbers) for message in log.messages(numbers.keys(), sort=sort))


def open_bag(folder: Path) -> BagLog:
    """The log of a rosbag2 folder. Raises RecordingError: none of rosbag2, a file is missing or not read."""
    logs, unread = [], []
    paths = list_bag_files(folder)
    for path in paths:
        try:
            logs.append(open_sqlite(path) if path.suffix == DB3 else open_mcap(path))
        except RecordingError as error:
            unread.append(_error_in_file(path, error))
    return _join_bag_files(folder, logs, unread, tuple(note_unnamed_files(folder, paths)))


def _join_bag_files(folder: Path, logs: Sequence[Log], unread: Sequence[str], notes: tuple[str, ...]) -> BagLog:
    """One log of a bag's files. `unread`: a line for each that cannot be read. Raises RecordingError: no file can."""
    if not logs:
        first, *others = unread
        more = f"; and so on, {count_noun(len(unread), 'file')} in all" if others else ""
        raise RecordingError(f"{first}{more}", path=folder)
    damages = [f"{log.path.name}: {log.damage}" for log in logs if log.damage]
    numbers: dict[tuple[object, ...], int] = {}
    channels: dict[int, Channel] = {}
    parts = []
    for log in logs:
        numbers_of_log = {}
        for c in log.channels:
            key = (c.topic, c.schema, c.encoding, c.schema_encoding, c.schema_data, tuple(sorted(c.metadata.items())))
            number = numbers_of_log[c.number] = numbers.setdefault(key, len(numbers) + 1)
            channels[number] = _merge_channels(channels[number], c) if number in channels else replace(c, number=number)
        parts.append(BagFile(log, numbers_of_log))
    last_start_ns = max(log.start_ns for log in logs)
    of_files = [f"{log.path.name}: {note}" for log in logs for note in log.notes]
    return BagLog(
        path=folder,
        channels=tuple(channels[number] for number in sorted(channels)),
        indexed=all(log.indexed for log in logs),
        damage="; ".join([*damages, *unread]) or None,
        complete=not unread and all(log.complete for log in logs),
        went_on=bool(unread) or any(log.went_on or log.start_ns < last_start_ns for log in logs if not log.complete),
        start_ns=min(log.start_ns for log in logs),
        end_ns=max(log.end_ns for log in logs),
        notes=tuple(dict.fromkeys([*notes, *of_files])),
        parts=tuple(parts),
        tags={name: value for log in reversed(logs) for name, value in log.tags.items()},
        lost=tuple(unread),
    )


def _merge_channels(first: Channel, second: Channel) -> Channel:
    """One channel for two files: the messages of both, counted."""
    expected = [c.messages if c.expected is None else c.expected for c in (first, second)]
    has_expected = first.expected is not None or second.expected is not None
    return replace(first, messages=first.messages + second.messages, expected=sum(expected) if has_expected else None)


def _error_in_file(path: Path, error: RecordingError) -> str:
    """`file.mcap: …`: what is wrong with a file of the folder."""
    return f"{path.name}: {'; '.join(error.within(path))}"
