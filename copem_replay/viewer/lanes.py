"""Lanes: the status of each shown object in each configuration over time, and lost, late and overtaken lists of units.

An entity per object and configuration, such as `lanes/6_pedestrian/2_PEM`; the number is the configuration's place in
the file. A lane begins with the configuration's name: the viewer's own titles of lanes are paths. Changes too short to
follow are left out, but known begins exactly at `detection_s`, with how long after the onset, “0.60 s known”. Words
that do not fit into their span are shortened or left out, and are never on another span; the time of a short one is
beside the name, “PEM, 0.60 s, lost”, where there is room. A mark ends at the onset, white and black, to stand out in
any theme. A lane is empty while the object is absent.

An entity per configuration and unit, such as `lists/2_bursts/rsu1`, under the lanes of the objects, shows lists sent by
a link, if one did not come in time; events say it in words.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from copem_replay.communication.arrivals import find_overtaken_lists
from copem_replay.core.colours import Rgb
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import CLASSES, SAME_INSTANT_S, Float, Int, Scene
from copem_replay.experiment.schema import Experiment
from copem_replay.pipeline.sight import ABSENT, STEADY_S, Sight, SpanNames, list_spans, name_bodies, smooth_status
from copem_replay.pipeline.status import KNOWN, UNDER_WAY, UNMATCHED, EpisodeClocks, Status, to_nanoseconds
from copem_replay.pipeline.status import LOST as LIST_LOST
from copem_replay.results.shown_objects import AFTER_S, BEFORE_S, LEAST_S
from copem_replay.viewer.sink import (
    ONSET,
    STATUS,
    RecordingSink,
    configuration_part,
    lane_path,
    make_distinct,
    plain_part,
    short_ids,
    show_seconds,
    status_colour,
)
from copem_replay.viewer.status import lane_text

MARK = 1 / 40
"""Length of the mark that ends at the onset, as a share of the axis: just wide enough for both halves."""
FLAG = 6
"""Length of words such as “0.60 s”, as a multiple of the mark's."""
NAME: Rgb = (58, 60, 66)
"""Ground of the configuration's name, where a lane begins: no colour of a status."""
ONSET_IS = ("from here", "from here it counts")
"""The two halves of the mark."""
WIDTH_POINTS, LETTER_POINTS, PADDING_POINTS = 380.0, 7.0, 10.0
"""Width of the narrowest lanes in a window of 1280 × 720, of a letter (rounded up), and of what is beside words."""
MOST_NAME, LEAST_NAME = 0.52, 8
"""Most of a lane's width that is before the onset, for the name, and the letters of one that is cut."""


def write_lanes(
    out: RecordingSink, scene: Scene, experiment: Experiment, sight: Sight, statuses: Mapping[str, Status],
    colours: Mapping[str, Rgb], clocks: Mapping[str, EpisodeClocks], axes: Mapping[int, tuple[float, float]],
) -> None:  # fmt: skip
    """Write a lane per shown object and configuration, with a mark that ends at the onset.

    `axes`: first and last second of each object's lanes, by its index.
    """
    import rerun as rr

    names = SpanNames([*experiment.units], name_bodies(scene, sight.solids, short_ids(scene)))
    for m, k in enumerate(sight.object_ix.tolist()):
        axis_ns = tuple(to_nanoseconds(axes[k]).tolist())
        for place, (name, status) in enumerate(statuses.items()):
            if not len(status.elapsed_ns):
                continue
            clock_ns = int(clocks[name].onset_ns[k]), int(clocks[name].known_ns[k])
            cut, end_ns = np.searchsorted(status.elapsed_ns, clock_ns[0]), status.elapsed_ns[-1] + STEADY_S * 1e9
            timeline = status.elapsed_ns, status.status[:, m], status.unit_ix[:, m], status.frame
            spans = [  # the onset is a border: before it words do not tell why an object is unknown
                span
                for rows, until_ns in ((slice(cut), min(clock_ns[0], end_ns)), (slice(cut, None), end_ns))
                for span in list_spans(sight, m, tuple(of[rows] for of in timeline), names, until_ns * 1e-9, keep=KNOWN)
            ]
            texts = [None if span.status == ABSENT else lane_text(span) for span in spans]
            begins = to_nanoseconds([span.begin_s for span in spans])
            tints = [status_colour(span.status, colours[name]) if span.status else ONSET[0] for span in spans]
            elapsed, values, styles = _tell_lane(begins, texts, tints, name, clock_ns, axis_ns)
            path = lane_path(scene, k, place, name)
            present = [value for value in values if value is not None]  # the row is empty while the object is absent
            states = rr.StateChange.columns(state=pa.array(present, pa.string()))
            out.columns(path, elapsed, states.partition(np.array([v is not None for v in values], dtype=np.int64)))
            labels, drawn = zip(*styles.values(), strict=True)
            out.static(path, rr.StateConfiguration(values=list(styles), labels=list(labels), colors=list(drawn)))


def _tell_lane(
    begins: Int, texts: list[str | None], tints: Sequence[Rgb], name: str, clock_ns: tuple[int, int],
    axis_ns: tuple[int, int],
) -> tuple[Int, list[str | None], dict[str, tuple[str, Rgb]]]:  # fmt: skip
    """Instants and values of a lane with its name, flag and mark; label and colour of each value. `texts`, `tints`: of
    spans that begin at `begins`. `clock_ns`: onset of the object, and when it is known; `axis_ns`: begin and end.
    """
    (onset_ns, known_ns), (first_ns, last_ns) = clock_ns, axis_ns
    mark_ns = round((last_ns - first_ns) * MARK)
    flag = _add_flag(begins, texts, known_ns, onset_ns, FLAG * mark_ns)
    colour_of = {text: tint for text, tint in zip(texts, tints, strict=True) if text}
    elapsed, texts = _insert_onset(begins, texts, onset_ns, mark_ns)
    until_ns = min(onset_ns - mark_ns, known_ns)
    if until_ns - first_ns >= (last_ns - first_ns) * _words_points(min(len(name), LEAST_NAME)) / WIDTH_POINTS:
        title = f"{name}{flag}: "
        elapsed, texts = _insert_title(elapsed, texts, title, first_ns, until_ns)
    else:
        title = f"{name}: "
        _prepend_title(elapsed, texts, title, first_ns)
    colour_of |= dict(zip(ONSET_IS, ONSET, strict=True)) | {title: NAME}
    values, label_of = _fit_words(texts, _measure_spans(elapsed, axis_ns))
    return elapsed, values, {value: (label, _tint(value, title, colour_of)) for value, label in label_of.items()}


def lanes_axis_s(
    axis_s: tuple[float, float], onset_s: float, configurations: Sequence[str], with_times: bool = False
) -> tuple[float, float]:
    """First and last second of an object's lanes: with room for names before the onset, and for the last flag.

    `axis_s`: of the object, from 0.5 s before its onset, or before it is known, to 0.5 s after it is last known.
    `with_times`: with room for times beside the names.
    """
    longest = max(map(len, configurations), default=0) + with_times * len(", 0.00 s, lost")
    name = min((_words_points(longest) + 2) / WIDTH_POINTS + MARK, MOST_NAME)
    flag = _words_points(len("10.00 s known")) / WIDTH_POINTS
    start_s = min(onset_s, axis_s[0] + BEFORE_S)
    end_s = max(axis_s[1] - AFTER_S, start_s)
    length_s = max((end_s - start_s) / (1 - name - flag), LEAST_S)
    if start_s < name * length_s:  # nothing is before the log's start: then names have what room there is
        length_s = max(end_s / (1 - flag), LEAST_S)
    first_s = max(start_s - name * length_s, 0.0)
    return first_s, max(first_s + length_s, end_s + flag * length_s)


def is_briefly_known(statuses: Iterable[Status], m: int, axis_s: tuple[float, float]) -> bool:
    """Whether any lane of object m has a first span of known that is too short for its time on an axis."""
    least_ns = FLAG * MARK * (axis_s[1] - axis_s[0]) * 1e9
    for status in statuses:
        for span in smooth_status(status.elapsed_ns, status.status[:, m], keep=KNOWN):
            if span.status == KNOWN:
                end = min(span.end, len(status.elapsed_ns) - 1)
                if end == span.end and status.elapsed_ns[end] - status.elapsed_ns[span.first] < least_ns:
                    return True
                break
    return False


def _words_points(letters: int) -> float:
    return letters * LETTER_POINTS + PADDING_POINTS


def _measure_spans(begins: Int, axis_ns: tuple[int, int], end_ns: int | None = None) -> Float:
    """(K,) widths in points, on an axis, of spans that begin at `begins` and end at `end_ns`; at most 0: not on it."""
    ends = np.append(begins[1:], axis_ns[1] if end_ns is None else end_ns)
    lasts_ns = np.minimum(ends, axis_ns[1]) - np.maximum(begins, axis_ns[0])
    return np.asarray(lasts_ns * WIDTH_POINTS / (axis_ns[1] - axis_ns[0]))


def _fit_words(texts: Sequence[str | None], points: Float) -> tuple[list[str | None], dict[str, str]]:
    """Values of states, and by value its label: as many words as fit into its width in `points`, all if that is 0.

    A state whose words are shortened here and not elsewhere has a space more at the end of its value. Without words the
    label is a space: for an empty one the viewer takes the value.
    """
    values: list[str | None] = []
    label_of = dict.fromkeys(ONSET_IS, " ")
    for text, width_points in zip(texts, points.tolist(), strict=True):
        if text is None or text in ONSET_IS:
            values.append(text)
            continue
        room = len(text) if width_points <= 0 else int(min((width_points - PADDING_POINTS) / LETTER_POINTS, len(text)))
        label = next((words for words in _shorten_words(text) if len(words) <= room), _cut_name(text, room))
        value = next(text + k * " " for k in range(len(texts) + 1) if label_of.get(text + k * " ", label) == label)
        label_of[value] = label
        values.append(value)
    return values, label_of


def _cut_name(text: str, room: int) -> str:
    """What fits of the name in a text: “old:fus…_gnn”; a space where there is none, or no room."""
    title, colon, _ = text.partition(": ")
    name = re.sub(r", -?[0-9.]+ s(, lost)?$", "", title)
    return f"{name[: room // 2]}…{name[len(name) - (room - 1) // 2 :]}" if colon and room > 2 else " "


_SHORTER = {
    "behind": ("behind",), "seen": ("seen",), "out": ("out of view", "out"), "on": ("on way",), "no": ("no unit",),
    "list": ("lost",), "listed": ("not confirmed", "too late", "listed"),
}  # fmt: skip
"""Words taken from those of spans, by the first of these; the longest first."""


def _shorten_words(text: str) -> Iterator[str]:
    """Shorter and shorter words for a span, the longest first.

    “behind car 3 (from ego)”, “behind car 3”, “behind 3”; “PEM, 0.60 s, lost”, “PEM, 0.60 s”, “PEM”; “seen by ego, not
    listed”, “not listed”, “seen”; “out of range or view”, “out of view”, “out”.
    """
    yield text.removesuffix(": ")
    if ": " in text:
        yield (title := text.partition(": ")[0])
        yield (title := title.removesuffix(", lost"))
        yield re.sub(r", -?[0-9.]+ s$", "", title)
    yield (short := text.partition(" (from ")[0])
    yield re.sub(rf"^behind ({'|'.join(CLASSES)}) ", "behind ", short)
    yield text.partition(" from ")[0]
    yield re.sub("^seen by .*, ", "", text)
    text_words = re.findall(r"\w+", text)
    yield from (words for words in _SHORTER.get(text_words[0], ()) if {*words.split()} <= {*text_words})
    if flag := re.match(r"-?[0-9.]+ s ", text):
        yield flag[0].rstrip()


def _add_flag(begins: Int, texts: list[str | None], known_ns: int, onset_ns: int, room_ns: int) -> str:
    """Say how long after the onset the object is first known, where that begins: “0.60 s known”.

    Returns what is added to the name, “, 0.60 s, lost”, where that lasts for less than `room_ns`, too short for words:
    lost, unless the object is absent then.
    """
    for k in np.flatnonzero(begins == known_ns)[:1].tolist():
        after = f"{show_seconds((known_ns - onset_ns) / 1e9)} s"
        texts[k] = f"{after} {texts[k]}"
        if (begins[k + 1 :] - known_ns < room_ns).any():
            return f", {after}" if texts[k + 1] is None else f", {after}, lost"
    return ""


def _tint(value: str, title: str, colour_of: Mapping[str, Rgb]) -> Rgb:
    """The colour of a value: spaces at its end and a title before it change nothing."""
    plain = value if value in colour_of else value.rstrip().removeprefix(title)
    return colour_of[plain]


def _insert_title(
    elapsed_ns: Int, texts: list[str | None], title: str, first_ns: int, until_ns: int
) -> tuple[Int, list[str | None]]:
    """Put the title from the begin of the axis to `until_ns`, in place of what holds then."""
    before = int(np.searchsorted(elapsed_ns, first_ns))
    after = int(np.searchsorted(elapsed_ns, until_ns, side="right")) - 1  # what holds at `until_ns`
    held = texts[after] if after >= 0 else None
    return np.concatenate([elapsed_ns[:before], [first_ns, until_ns], elapsed_ns[after + 1 :]]), [
        *texts[:before], title, held, *texts[after + 1 :]
    ]  # fmt: skip


def _prepend_title(elapsed_ns: Int, texts: list[str | None], title: str, first_ns: int) -> None:
    """Put the title before the first text on the axis, “PEM: hidden”: it has no room of its own."""
    current = max(int(np.searchsorted(elapsed_ns, first_ns, side="right")) - 1, 0)
    told_at = next((k for k in range(current, len(texts)) if texts[k] not in (None, *ONSET_IS)), None)
    if told_at is not None:
        texts[told_at] = f"{title}{texts[told_at]}"


def _insert_onset(
    elapsed_ns: Int, texts: Sequence[str | None], onset_ns: int, mark_ns: int
) -> tuple[Int, list[str | None]]:
    """Instants (ns) and texts of a lane with a mark before the onset, unless the lane begins later than the mark."""
    begin = onset_ns - mark_ns
    if not elapsed_ns[0] <= begin:
        return elapsed_ns, list(texts)
    before, after = int(np.searchsorted(elapsed_ns, begin)), int(np.searchsorted(elapsed_ns, onset_ns, side="right"))
    marked = [begin, begin + mark_ns // 2, onset_ns]
    return np.concatenate([elapsed_ns[:before], marked, elapsed_ns[after:]]), [
        *texts[:before], *ONSET_IS, texts[after - 1], *texts[after:]
    ]  # fmt: skip


# Lists that units send by a link, in the shown run: lost, late or overtaken.

FATES = ("in time", "lost", "late", "overtaken")
IN_TIME, LOST, LATE, OVERTAKEN = range(len(FATES))
COLOURS: dict[int, Rgb] = {LOST: STATUS[LIST_LOST], LATE: STATUS[UNDER_WAY], OVERTAKEN: STATUS[UNMATCHED]}
"""Colours in lanes, as in an object's lane: lost, captured (under way) and unmatched."""
QUIET_S, TOLD_S = 1.0, 5.0
"""Lists of one fate share a row of the events if they are no more than the first apart, up to the second after the
row's first list, or if no other list is between them. A burst is a row, ten minutes of single losses are 120."""
LANES = 13
"""Most lanes of configurations and units under one object: as many fit into a height of 720 points."""


@dataclass(frozen=True)
class UnitLists:
    """The lists (L,) that one unit sends by a link in one run, in order of capture.

    `arrives_s`: inf for a lost list. `fate`: index into FATES. `path`: the entity of the lane.
    """

    unit: str
    path: tuple[str, ...]
    captured_s: Float
    arrives_s: Float
    fate: Int
    interval_s: float

    @property
    def elapsed_ns(self) -> Int:
        """(L,) captures, ns since the log's start."""
        result: Int = to_nanoseconds(self.captured_s)
        return result


def find_linked_lists(fused_tracks: FusedTracks, place: int, name: str, max_age_s: float) -> list[UnitLists]:
    """The lists of each unit that sends by a link in a configuration; `place`: index of the configuration in the file.

    Late: on its way for longer than `max_age_s`, or for longer than the median by more than one interval of the unit's
    lists. Overtaken: arrives later than a newer list of the unit; lists that arrive at one tick arrive together.
    """
    received, by_link = fused_tracks.received, fused_tracks.by_link
    if by_link is None:
        return []
    late_after_newer, linked = find_overtaken_lists(received), []
    for k, entity in enumerate(make_distinct([plain_part(unit) for unit in received.units])):
        frames = np.flatnonzero(by_link & (received.frame_unit_ix == k))
        if not len(frames):
            continue
        frames = frames[np.argsort(received.captured_s[frames], kind="stable")]
        captured_s, arrives_s = received.captured_s[frames], received.common_arrives_s[frames]
        latency_s, arrived = arrives_s - captured_s, np.isfinite(arrives_s)
        interval_s = float(np.median(np.diff(captured_s))) if len(frames) > 1 else np.inf
        usual_s = float(np.median(latency_s[arrived])) if arrived.any() else np.inf
        late = latency_s > min(max_age_s, usual_s + interval_s) + SAME_INSTANT_S
        fate = np.select([~arrived, late_after_newer[frames], late], [LOST, OVERTAKEN, LATE], IN_TIME)
        path = ("lists", f"{place + 1}_{plain_part(name)}", entity)
        linked.append(UnitLists(received.units[k], path, captured_s, arrives_s, fate, interval_s))
    return linked


def write_list_fates(out: RecordingSink, name: str, lists: Sequence[UnitLists]) -> None:
    """Write an event for each lost, late or overtaken list of a configuration, or for several such lists in a row."""
    import rerun as rr

    rows = sorted(
        (
            float(unit_lists.captured_s[group[0]]),
            "WARN" if fate == LOST else "INFO",
            f"{name}: {_describe_fates(unit_lists, fate, group)}",
        )
        for unit_lists in lists
        for fate in (LOST, LATE, OVERTAKEN)
        for group in group_fates(unit_lists, fate)
    )
    columns = rr.TextLog.columns(text=[text for _, _, text in rows], level=[level for _, level, _ in rows])
    out.columns(
        ["events", configuration_part(name), "lists"], to_nanoseconds([time_s for time_s, _, _ in rows]), columns
    )


def group_fates(unit_lists: UnitLists, fate: int) -> Iterator[list[int]]:
    """Indices of the lists that share a row, as one fate met them in sequence."""
    group: list[int] = []
    for k in np.flatnonzero(unit_lists.fate == fate).tolist():
        if group and k != group[-1] + 1:
            since_s = unit_lists.captured_s[k] - unit_lists.captured_s[[group[-1], group[0]]] - SAME_INSTANT_S
            if since_s[0] > QUIET_S or since_s[1] > TOLD_S:
                yield group
                group = []
        group.append(k)
    if group:
        yield group


def _describe_fates(unit_lists: UnitLists, fate: int, group: list[int]) -> str:
    """“rsu1: 7 lists lost, captured 3.20 to 3.80 s, next arrival 3.95 s”."""
    first, last, n = group[0], group[-1], len(group)
    count = f"{n} of {last - first + 1} lists" if last - first >= n else f"{n} lists" if n > 1 else "list"
    parts = [f"{unit_lists.unit}: {count} {FATES[fate]}", f"captured {_format_times(unit_lists.captured_s[group])}"]
    if fate == LOST:
        next_s = unit_lists.arrives_s[last + 1 :].min(initial=np.inf)
        parts.append(f"next arrival {next_s:.2f} s" if np.isfinite(next_s) else "none arrives after")
    else:
        parts.append(f"arrived {_format_times(unit_lists.arrives_s[group])}")
    return ", ".join(parts)


def _format_times(time_s: Float) -> str:
    first, last = f"{time_s.min():.2f}", f"{time_s.max():.2f}"
    return f"{first} s" if first == last else f"{first} to {last} s"


def write_list_lanes(out: RecordingSink, lists: Sequence[UnitLists], axes: Collection[tuple[float, float]]) -> None:
    """Write a lane for each unit with a lost, late or overtaken list, which lasts until the next capture.

    `axes`: first and last second of the lanes of all objects. Words are left out that do not fit on each that has them.
    """
    import rerun as rr

    axes_ns = [(int(first_ns), int(last_ns)) for first_ns, last_ns in map(to_nanoseconds, axes)]
    for unit_lists in lists:
        if not unit_lists.fate.any():
            continue
        first = np.flatnonzero(np.diff(unit_lists.fate, prepend=IN_TIME))
        counts = np.diff(first, append=len(unit_lists.fate))
        fate, begins = unit_lists.fate[first], unit_lists.elapsed_ns[first]
        texts = [
            None if f == IN_TIME else FATES[f] if n == 1 else f"{n} {FATES[f]}"
            for f, n in zip(fate.tolist(), counts.tolist(), strict=True)
        ]
        end = int(unit_lists.elapsed_ns[-1] + to_nanoseconds(min(unit_lists.interval_s, 1.0)))
        points = np.array([np.zeros(len(texts)), *(_measure_spans(begins, axis, end) for axis in axes_ns)])
        narrowest = np.where(points > 0, points, np.inf).min(axis=0)
        values, label_of = _fit_words(texts, narrowest)
        style = {value: COLOURS[f] for value, f in zip(values, fate.tolist(), strict=True) if value is not None}
        if fate[-1] != IN_TIME:  # the last list ends after an interval
            values, begins = [*values, None], np.append(begins, end)
        states = rr.StateChange.columns(state=pa.array([value for value in values if value is not None], pa.string()))
        out.columns(
            unit_lists.path, begins, states.partition(np.array([v is not None for v in values], dtype=np.int64))
        )
        labels = [label_of[value] for value in style]
        drawn = rr.StateConfiguration(values=list(style), labels=labels, colors=list(style.values()))
        out.static(unit_lists.path, drawn)


def select_list_lanes(lists: Mapping[str, Sequence[UnitLists]], axis_s: tuple[float, float]) -> list[tuple[str, ...]]:
    """Entities of the lanes of lists shown under an object with this time axis, in the order of configurations.

    Lanes with marks on the axis; of too many for `LANES`, those with the most.
    """
    marked = [
        (
            int(
                np.count_nonzero(
                    unit_lists.fate[(unit_lists.captured_s >= axis_s[0]) & (unit_lists.captured_s <= axis_s[1])]
                )
            ),
            unit_lists.path,
        )
        for units in lists.values()
        for unit_lists in units
    ]
    most = sorted(marked, key=lambda entry: -entry[0])[: LANES - len(lists)]
    return [path for count, path in marked if count and (count, path) in most]
