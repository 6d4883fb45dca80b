"""A recording in memory: scene, ground truth and notes, read from a log.

The topic of the truth is found by the names of schemas, unless the experiment names it. Notes list what was skipped,
derived or corrected.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.errors import EgoError, RecordingError, RemoteFile, count_noun
from copem_replay.core.frame import SaidPlace
from copem_replay.core.site_map import Lane
from copem_replay.core.tracks import CLASSES, Float, Scene, Tracks
from copem_replay.io.channel import ENCODINGS, Channel
from copem_replay.io.decoded_size import DecodeAllowance, OversizeError
from copem_replay.io.findings import as_finding, find, find_rule
from copem_replay.io.ground_truth import MAX_GAP_S, DecodedObjects, assemble_truth, list_contents
from copem_replay.io.log import BrokenIndexError, Log, cut_window, window_notes
from copem_replay.io.open import (
    DriveRecordings,
    Local,
    Place,
    Stamps,
    check_files_unchanged,
    find_drive_recordings,
    open_log,
    read_file_stamps,
)
from copem_replay.io.schemas import osi_ground_truth as osi
from copem_replay.io.schemas.poses import is_pose
from copem_replay.io.schemas.registry import is_list, known_lists, names_objects
from copem_replay.io.stamps import refuse_second_run
from copem_replay.io.truth_checks import HeadingUnitError
from copem_replay.io.window import Window, WindowSeconds

if TYPE_CHECKING:
    from copem_replay.io.config import EgoTopic
    from copem_replay.io.frames import LogContext
    from copem_replay.io.recorded_lists import RecordedLists
    from copem_replay.io.schemas.object_lists import Fields


_TOPIC = ("read", "topic")  # the key of an experiment that names the topic of the truth
_NO_TRUTH = "lists of a unit they can be, not the truth"
_SHOWN = 12  # ids or topics named in an error; the rest is counted


@dataclass(frozen=True, kw_only=True, repr=False)
class KnownLog:
    """The facts of a log that was read, whether its content is in memory (`Recording`) or not."""

    scene: Scene
    path: Path
    topic: str
    notes: tuple[str, ...]  # a line per kind of thing derived, corrected, skipped or ignored
    host_id: str | None
    together: DriveRecordings | None = None  # the recordings of the drive, `path` being the first; None: it is one
    remote: RemoteFile | None = None  # where it lies, if not on this machine: `path` was a copy
    sha256: str | None = None  # of the files that were read, where it is known already
    stamps: Stamps | None = None  # of its files on this machine before they were read; None: a copy, or not known

    @property
    def place(self) -> Place:
        """Its place: a file or folder, or several, or a URL."""
        return self.remote or self.local

    @property
    def local(self) -> Local:
        """The place on this machine that it was read from."""
        return self.path if self.together is None else self.together

    @property
    def paths(self) -> tuple[Path, ...]:
        """The files or folders on this machine that it is read from; none of a remote one."""
        if self.remote is not None:
            return ()
        return (self.path,) if self.together is None else self.together.paths


@dataclass(frozen=True, kw_only=True, repr=False)
class Recording(KnownLog):
    """A recording in memory: its scene, its ground truth, and notes on what was derived, corrected or skipped.

    `truth` has the one unit TRUTH, one run, and arrives as it is captured. `host_id` is the host vehicle as
    the log names it, whether or not there is such an object; `scene.ego_ix` is −1 where there is none.

    >>> recording = cr.read_recording("logs/tc016d.mcap")
    >>> recording.topic, recording.truth.units, recording.notes
    ('ground_truth', ('truth',), ())
    """

    truth: Tracks
    damage: str | None = None  # what is wrong with the file and how far it could be read; it is among the notes, too
    lists: Mapping[str, RecordedLists] = field(default_factory=dict)  # of the recorded units, by their names
    around: LogContext | None = None  # frames of reference, where lists other than OSI's are read
    encoding: str = "protobuf"  # of the messages of the truth
    world: str = ""  # name of the frame of reference of the truth, "": none is named, as in OSI
    window: Window | None = None  # the log time that was read; None: all
    lane_boundaries: tuple[Float, ...] = ()  # (K, 3) each, for showing only
    lanes: tuple[Lane, ...] = ()  # with a direction; those of maps, too
    place_said: SaidPlace | None = None  # what it says of its place on earth

    def __repr__(self) -> str:
        objects, frames, lasts_s = len(self.scene.object_ids), len(self.truth.stamp_ns), self.scene.end_s
        return f"Recording({self.path.name}, {self.topic}: {objects} objects, {frames} frames, {lasts_s:.1f} s)"

    @property
    def object_states(self) -> int:
        """Number of states in memory, of the truth and of all recorded lists."""
        return sum(len(tracks.frame_ix) for tracks in (self.truth, *(unit.tracks for unit in self.lists.values())))


def read_log(
    source: Local | str | Log,
    *,
    name: str,
    ego: str | EgoTopic | None = None,
    topic: str | None = None,
    fields: Fields | None = None,
    unit_topics: Collection[str] = (),
    window_s: WindowSeconds = None,
    max_gap_s: float = MAX_GAP_S,
    classes: Mapping[str, str] | None = None,
) -> Recording:
    """Read the truth of the recording at a place, or of an opened log, as the log called `name`.

    `ego`: id of the ego vehicle, or the topic of its poses; None for the host vehicle that the log names, else that of
    the only odometry. `topic`: that of the truth, None where there is only one candidate; `fields`: which fields of its
    messages hold what, None where the schema is known. `unit_topics`: topics that recorded units read.
    `window_s`: read only what was logged from one instant to another, both included, in seconds since the first message
    on the topic of the truth was logged; None: from the beginning, to the end. `max_gap_s`: velocities that messages do
    not state are derived, and poses interpolated, across no longer gap. `classes`: of names, beside
    those that are known.
    Raises RecordingError, one line: no such file, no MCAP file, no truth, no usable object, no such ego, no such topic,
    or several, a file that changes while it is read; EmptyWindowError.
    """

    def read(log: Log) -> Recording:
        return _read(log, name, ego, topic, fields, unit_topics, window_s, max_gap_s, classes or {})

    if isinstance(source, Log):
        return read(source)
    place, stamps = Path(source) if isinstance(source, str) else source, None
    with suppress(RecordingError):  # opening it raises the error
        stamps = read_file_stamps(place)
    try:
        recording = read(open_log(place))
    except RecordingError:
        check_files_unchanged(stamps or ())  # for this is why
        raise
    check_files_unchanged(stamps or ())
    return replace(recording, stamps=stamps, together=place if isinstance(place, DriveRecordings) else None)


@np.errstate(over="ignore", invalid="ignore")  # a state that is not finite is left out later, with a note
def _read(
    log: Log,
    name: str,
    ego: str | EgoTopic | None,
    topic: str | None,
    fields: Fields | None,
    unit_topics: Collection[str],
    window_s: WindowSeconds,
    max_gap_s: float,
    classes: Mapping[str, str],
) -> Recording:
    """The recording of a log: truth, scene, ego and notes, within the window. Raises RecordingError."""
    ego_spec = None if isinstance(ego, str) else ego
    topic, ignored = choose_topic(log, topic, unit_topics, fields, ego_spec)

    def decode(log: Log) -> tuple[Log, tuple[DecodedObjects, LogContext | None, str]]:
        cut = cut_window(log, topic, window_s, max_gap_s)
        return cut, _decode_world(cut, topic, fields, ego_spec, classes, seek_ego=ego is None, max_gap_s=max_gap_s)

    log, (columns, context, world) = log.attempt(decode)
    refuse_second_run(columns.stamp_ns, columns.log_time_ns, partial(list_contents, columns), log.path, topic)
    try:
        scene, truth, truth_notes = assemble_truth(columns, name, max_gap_s)
    except HeadingUnitError as error:
        raise RecordingError(str(error), path=log.path, topic=topic) from None
    notes = [*columns.notes, *truth_notes]
    if scene is None or truth is None:
        messages = count_noun(sum(c.messages for c in log.channels if c.topic == topic), "message")
        inside = "the window" if log.window is not None else messages
        damage = _describe_damage(log, topic, None)
        why = "".join(f"; {note}" for note in ([damage] if damage else []) + notes)
        raise RecordingError(f"no usable object in {inside}{why}", path=log.path, topic=topic)
    host, host_notes = _find_host(columns.hosts)
    if apart_notes := _find_apart(context, truth):
        if ego_spec is not None:
            raise EgoError(f"{apart_notes[0]}; `ego: none` replays without it", path=log.path)
        host, host_notes = None, apart_notes
    ego_ix, ego_notes = _find_ego(log.path, scene, ego if isinstance(ego, str) else None, host)
    damage = _describe_damage(log, topic, scene.end_s)
    window_lines = window_notes(window_s)
    notes = [*([damage] if damage else []), *window_lines, *log.notes, *ignored, *notes, *host_notes, *ego_notes]
    sized = context is None or context.ego is None or (ego_spec is not None and ego_spec.size_m is not None)
    sized = sized or find_rule(columns.notes, "ego listed") is not None
    scene = replace(scene, ego_ix=ego_ix, ego_sized=sized, tags=dict(log.tags), areas=columns.areas)
    all_notes = tuple(map(as_finding, notes))
    encoding = next(c.encoding for c in log.channels if c.topic == topic and c.messages)
    return Recording(
        scene=scene, truth=truth, path=log.path, topic=topic, notes=all_notes, host_id=host, damage=damage,
        around=context, encoding=encoding, world=world, window=log.window, lane_boundaries=columns.lane_boundaries,
        lanes=columns.lanes, place_said=columns.place, together=find_drive_recordings(log),
    )  # fmt: skip


def find_middle(recording: Recording) -> Float:
    """The median (2,) of the places of all objects, in metres of the log."""
    truth = recording.truth
    valid = truth.valid[0]
    return np.array([np.median(truth.x_m[0, valid]), np.median(truth.y_m[0, valid])])


def is_truth(channel: Channel) -> bool:
    """Whether the channel holds the truth in a format of this version."""
    return channel.schema in osi.TRUTH_SCHEMAS and channel.encoding == "protobuf"


def truth_topics(log: Log) -> dict[str, str]:
    """Schema by topic, of topics with messages of the truth: OSI's, else other lists of objects with ids."""
    osis = {c.topic: c.schema for c in log.channels if is_truth(c) and c.messages}
    ours = {c.topic for c in log.channels if c.topic.startswith("copem/")}
    if osis or not foreign_channels(log):
        return osis
    others = {c.topic: c.schema for c in known_lists(log.channels) if names_objects(c)}
    return {t: schema for t, schema in others.items() if t not in ours} or others


def foreign_channels(log: Log) -> list[Channel]:
    """Channels with messages that are not OSI's."""
    return [c for c in log.channels if c.messages and not c.schema.startswith("osi3.")]


def choose_topic(
    log: Log,
    topic: str | None = None,
    unit_topics: Collection[str] = (),
    fields: Fields | None = None,
    ego_spec: EgoTopic | None = None,
) -> tuple[str, list[str]]:
    """The topic of the truth, and notes on what is not read. Raises RecordingError: none, or several candidates."""
    if not any(c.messages for c in log.channels):
        raise RecordingError(
            f"holds no message ({_describe_channels(log.channels) or 'and no channel'})", path=log.path
        )
    topics = truth_topics(log)
    if topic is not None and foreign_channels(log):
        topics |= {c.topic: c.schema for c in known_lists(log.channels) if c.topic == topic}
    if fields is not None:
        topics = {c.topic: c.schema for c in log.channels if c.messages}
        if topic not in topics:
            raise RecordingError(
                f"no true objects on topic {topic!r}; messages are on {_name_topics(topics)}", path=log.path, key=_TOPIC
            )
        return topic, _describe_ignored(log, topic, {topic: topics[topic]}, unit_topics, poses_read=True)
    if not topics:
        units = any(c.messages and (c.schema == osi.SENSOR_DATA or is_list(c)) for c in log.channels)
        raise RecordingError(
            f"no list of true objects; it holds {_describe_channels(log.channels)}; "
            + "beside a recording that has one its lists replay by `together: [THAT, THIS]`; " * units
            + _advise_reading(log),
            path=log.path,
        )
    if topic is not None and topic not in topics:
        raise RecordingError(
            f"no true objects on topic {topic!r}; they are on {_name_topics(topics)}", path=log.path, key=_TOPIC
        )
    truth_topic = topic if topic is not None else _only_topic(topics)
    if truth_topic is None:
        raise RecordingError(
            f"true objects on several topics, {_name_topics(topics)}: "
            "choose one with `read: {topic: …}` in the experiment",
            path=log.path,
            key=() if find_drive_recordings(log) is None else ("together",),
        )
    poses_read = ego_spec is not None or topics[truth_topic] not in osi.TRUTH_SCHEMAS
    return truth_topic, _describe_ignored(log, truth_topic, topics, unit_topics, poses_read=poses_read)


def _advise_reading(log: Log) -> str:
    """What to do with a recording without truth: name fields, where a topic has an encoding that is read."""
    encodings = {c.encoding for c in log.channels if c.messages}
    if encodings & {*ENCODINGS}:
        return "`read: {topic: …, objects: …, id: …}` names the fields of any list (docs/guide/recordings.md)"
    return f"messages encoded as {', '.join(sorted(encodings))} are not read; {', '.join(ENCODINGS)} are"


_SAYS_TRUTH = re.compile(r"ground[_-]?truth|(^|/)gt(/|$)", re.IGNORECASE)
"""A topic that says that it is the truth is taken before those that a tracker or a prediction writes."""


def _only_topic(topics: dict[str, str]) -> str | None:
    """The topic to read where none is named: the only one, the only GroundTruth beside SensorViews, the only one whose
    name says ground truth; else None.
    """
    truths = [t for t, schema in topics.items() if schema == osi.GROUND_TRUTH]
    if len(truths or topics) != 1:
        truths = [t for t in topics if _SAYS_TRUTH.search(t)] or truths
    candidates = truths or list(topics)
    return candidates[0] if len(candidates) == 1 else None


def _describe_ignored(
    log: Log, truth_topic: str, topics: dict[str, str], unit_topics: Collection[str], *, poses_read: bool
) -> list[str]:
    """Notes on topics and messages that are not read; `poses_read`: whether poses are."""
    notes = [f"topic {t} ({schema}) not read: {truth_topic} taken" for t, schema in topics.items() if t != truth_topic]
    skipped = Counter[str]()
    pose_channels: set[int] = set()
    if poses_read and (others := foreign_channels(log)):
        pose_channels = {c.number for c in others if is_pose(c)}
    for channel in log.channels:
        has_messages = channel.messages and channel.number not in pose_channels
        # A topic of the truth may hold messages of another schema, too.
        of_topic = is_truth(channel) or channel.schema == topics.get(channel.topic)
        is_read_otherwise = channel.topic in unit_topics or channel.schema == osi.EMBEDDED_MAP
        if has_messages and not (channel.topic in topics and of_topic) and not is_read_otherwise:
            skipped[channel.schema or f"no schema ({channel.encoding})"] += channel.messages
    return notes + [f"{count_noun(number, 'message')} of {schema} not read" for schema, number in skipped.items()]


def _decode_world(
    log: Log,
    topic: str,
    fields: Fields | None,
    ego_spec: EgoTopic | None,
    classes: Mapping[str, str],
    *,
    seek_ego: bool,
    max_gap_s: float,
) -> tuple[DecodedObjects, LogContext | None, str]:
    """The truth's objects and the ego in the world, the log's frames (None: OSI), and the name of the world's frame.
    Raises RecordingError, BrokenIndexError.
    """
    channels = [c for c in log.channels if c.topic == topic and c.messages]
    if fields is None and any(not is_truth(c) for c in channels):  # channels of one topic may be of several schemas
        channels = [c for c in channels if is_truth(c) or is_list(c)]
        channels.sort(key=lambda c: not names_objects(c))
    if not channels:
        raise RecordingError(
            f"no message can be read{f' ({log.damage})' if log.damage else ''}", path=log.path, topic=topic
        )
    if fields is None and any(is_truth(c) for c in channels):
        columns = _decode_topic(log, topic)
        if ego_spec is None:
            return columns, None, ""
        from copem_replay.io.frames import add_ego, read_log_context

        context = read_log_context(log, ego_spec, seek_ego=False, max_gap_s=max_gap_s)
        return _add_notes(add_ego(columns, context.ego, context.asked, context.ego_topic), context), context, ""
    from copem_replay.io.frames import add_ego, read_decoded_lists, read_log_context, transform_to_world

    context = read_log_context(log, ego_spec, seek_ego=seek_ego, max_gap_s=max_gap_s)
    same_schema = [c for c in channels if (c.schema, c.encoding) == (channels[0].schema, channels[0].encoding)]
    context = replace(context, classes=classes)
    lists = read_decoded_lists(log, same_schema, fields, classes)
    if lists.station is not None:
        raise RecordingError("its positions are relative to stations; " + _NO_TRUTH, path=log.path, topic=topic)
    if (fields is None and not names_objects(same_schema[0])) or (fields is not None and fields.id is None):
        raise RecordingError("its objects have no ids; " + _NO_TRUTH, path=log.path, topic=topic)
    if not lists.named and len(lists.columns.object_ix):
        raise RecordingError("its objects have no ids, all are empty; " + _NO_TRUTH, path=log.path, topic=topic)
    world = context.world_of(lists)
    lists = transform_to_world(lists, context, log.path, topic)
    return _add_notes(add_ego(lists.columns, context.ego, context.asked, context.ego_topic), context), context, world


def _add_notes(columns: DecodedObjects, around: LogContext) -> DecodedObjects:
    assumed = find_rule(columns.notes, "ego listed") is None  # of a listed ego nothing is
    return replace(columns, notes=(*columns.notes, *(n for n in around.notes if assumed or not n.startswith("ego: "))))


def _decode_topic(log: Log, topic: str) -> DecodedObjects:
    """The objects in all messages of the truth on a topic. Raises RecordingError, BrokenIndexError."""
    channels = {c.number: c for c in log.channels if c.topic == topic and is_truth(c)}
    decoder = osi.GroundTruthDecoder(DecodeAllowance(log.file_bytes()))
    try:
        for number, payload in _find_earlier(log, channels):
            decoder.add_earlier(payload, channels[number].schema)
        for number, log_time_ns, payload in log.payloads(frozenset(channels)):
            decoder.add(
                payload, schema=channels[number].schema, log_time_ns=log_time_ns, ahead_ns=channels[number].ahead_ns
            )
        return decoder.columns()
    except OversizeError as error:
        raise RecordingError(str(error), path=log.path, topic=topic) from None


def _find_earlier(log: Log, channels: Mapping[int, Channel]) -> Iterator[tuple[int, bytes]]:
    """Channel number and payload of messages before the window that tell of the road and of what stands: simulators
    send these once. After the first, only until the window's first message repeats them.
    """
    if log.window is None or log.window.from_ns <= 0:
        return
    numbers, before = frozenset(channels), log.within(Window(to_ns=log.window.from_ns - 1))
    first_inside = next(log.payloads(numbers), None)
    all_sent = first_inside is not None and osi.sends_standing(first_inside[2], channels[first_inside[0]].schema)
    try:
        for number, _, payload in before.payloads(numbers):
            yield number, payload
            if all_sent:
                return
    except BrokenIndexError:  # what is damaged outside of the window is not its damage
        return


def _describe_damage(log: Log, topic: str, end_s: float | None) -> str | None:
    """A phrase on what is wrong with the file and how far it could be read (to `end_s`); None: nothing."""
    if log.damage is None:
        return None
    if log.complete:
        return f"damaged: {log.damage}"
    if log.window is not None:
        return f"damaged: what is lost may be of the window ({log.damage})"
    channels = [c for c in log.channels if c.topic == topic]
    number = sum(c.messages for c in channels)
    expected = sum(c.expected for c in channels if c.expected is not None)
    of = f" of {expected}" if expected else ""
    after = "damaged" if end_s is None or log.went_on else f"damaged after {end_s:.3f} s"
    return f"{after}: {number}{of} messages read ({log.damage})"


def _find_host(hosts: Sequence[str]) -> tuple[str | None, list[str]]:
    """The host vehicle's id, None where no message states one, and notes; `hosts`: one id per message."""
    if not hosts:
        return None, []
    counts = Counter(hosts).most_common()  # of equally frequent ones the first
    if len(counts) == 1:
        return counts[0][0], []
    ids = ", ".join(f"{ident} in {count_noun(number, 'message')}" for ident, number in counts[:_SHOWN])
    return counts[0][0], [f"the host vehicle changes ({ids}): the most frequent taken"]


def _find_apart(context: LogContext | None, truth: Tracks) -> list[str]:
    """The finding that the ego's poses and the lists have no instant in common; none: they have."""
    if context is None or context.ego is None:
        return []
    (first, last), (start, end) = ((ns[0] * 1e-9, ns[-1] * 1e-9) for ns in (context.ego.stamp_ns, truth.stamp_ns))
    apart = max(first - end, start - last)
    topic = context.ego_topic
    return [*find("two clocks", int(apart > 0), topic=topic, first=first, last=last, start=start, end=end, apart=apart)]


def _find_ego(path: Path, scene: Scene, ego: str | None, host: str | None) -> tuple[int, list[str]]:
    """Index of the ego vehicle, −1 without one, and notes. Raises RecordingError: no such moving object."""
    wanted = host if ego is None else ego
    index = -1 if wanted is None else scene.object_number.get(wanted, -1)
    if index >= 0 and scene.moving[index]:
        return index, []
    if ego is not None:
        raise EgoError(f"no moving object {ego!r}; there are {moving_ids(scene)}", path=path)
    if host is not None:
        return -1, [f"the host vehicle {host} is not among the moving objects: no ego vehicle"]
    return -1, []


def moving_ids(scene: Scene, shown: int = _SHOWN) -> str:
    """`3 (car), 7 (pedestrian), … (12 in all)`: moving objects, vehicles first, then by appearance."""
    movers = np.flatnonzero(scene.moving)
    names = [(scene.object_ids[k], CLASSES[scene.object_class[k]]) for k in movers]
    names.sort(key=lambda n: n[1] in ("pedestrian", "bicycle", "animal", "other"))
    text = ", ".join(f"{ident} ({what})" for ident, what in names[:shown])
    return f"{text}, … ({len(names)} in all)" if len(names) > shown else text or "none"


def _name_topics(topics: dict[str, str]) -> str:
    return ", ".join(f"{topic} ({schema})" for topic, schema in topics.items())


def _describe_channels(channels: Sequence[Channel]) -> str:
    """`osi3.GroundTruth on ground_truth, …`: schemas and topics of a file, for an error."""
    names = [
        f"{c.schema or 'no schema'}{'' if c.encoding == 'protobuf' else f' ({c.encoding})'} on {c.topic}"
        for c in channels
    ]
    more = f", … ({count_noun(len(names), 'topic')} in all)" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more
