"""Object lists of any schema, decoded by a description of their fields.

The formats that are known by name have such descriptions (`io/schemas/formats.py`); for any other schema an experiment
gives one with `read:`.
"""

from __future__ import annotations

import difflib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from copem_replay.core.tracks import CLASSES, VALUES, Bool, Float, Int
from copem_replay.io.class_names import class_from_name
from copem_replay.io.decoded_size import check_objects
from copem_replay.io.encodings.columns import (
    Definition,
    DistinctTexts,
    ShreddedMessages,
    ancestor_rows,
    any_item_path,
    common_level,
    format_number,
    list_level,
    list_levels,
    shred_messages,
)
from copem_replay.io.findings import LONGEST_M, MOST_SHARE, find, sift_shares
from copem_replay.io.ground_truth import DecodedObjects
from copem_replay.io.schemas.description import (
    Amount,
    ClassField,
    Description,
    Fields,
    Stamp,
    Yaw,
)
from copem_replay.io.stamps import find_stamp_paths, parse_nanoseconds, settle_stamps

# The columns of messages that a description needs.

_LONGEST_QUATERNION = 1e3
"""A rotation as a quaternion has the length 1; writers are known that do not norm it, but a longer one is none."""
_COMPARED = 2000  # fields that are compared with a missing one for an error: more make it slow
_SHOWN = 12  # fields named in an error, at most


class FieldsError(ValueError):
    """A path that messages do not have: the key that named it, and the paths they have instead."""


class WantedPaths:
    """The paths of a description, from the message down. Raises FieldsError where messages do not offer them.

    `stamp`: one path, or those of seconds and nanoseconds. `numbers` and `texts`: the columns to decode.
    """

    def __init__(self, description: Description, offers: Collection[str]) -> None:
        self._fields, self._described = description.fields, description
        self.made = {self.path(name): made for name, made in description.made.items()}
        self._offers = dict.fromkeys([*offers, *map(any_item_path, self.made)])
        objects = any_item_path(self._fields.objects)
        lists = {level for path in offers for level in list_levels([path]) if level}
        if objects not in lists or not self._fields.objects.endswith("[]"):
            raise self._lacks("objects", self._fields.objects, "list", sorted(lists))
        class_field = self._fields.class_
        self.class_ = ClassField(path=class_field) if isinstance(class_field, str) else class_field
        self.stamp = self._stamp_paths()
        self.numbers, self.texts = self._columns()

    def path(self, path: str) -> str:
        """The path from the message down, of one that is relative to an object unless it begins with `/`."""
        return path[1:] if path.startswith("/") else f"{self._fields.objects}.{path}"

    def _lacks(self, key: str, path: str, noun: str = "", candidates: Collection[str] = ()) -> FieldsError:
        """The error for a missing path, with similar ones of `candidates`, else of all that are offered."""
        offered = list(candidates or self._offers)
        near = difflib.get_close_matches(path, offered[:_COMPARED], n=3, cutoff=0.5)
        near += [p for p in offered if p.rpartition(".")[2] == path.rpartition(".")[2] and p not in near][:3]
        shown = near or offered[:_SHOWN]
        more = f", … ({len(offered)} in all)" if len(offered) > len(shown) else ""
        noun = f"{noun} " if noun else ""
        return FieldsError(
            f"read.{key}: the messages have no {noun}{path!r}; they have {', '.join(shown) or 'nothing'}{more}"
        )

    def _need(self, key: str, path: str, owner_path: str | None = None) -> str:
        """The path. Raises FieldsError: messages lack it, or have several values of it for one `owner_path`."""
        if any_item_path(path) not in self._offers:
            raise self._lacks(key, path)
        if owner_path is not None and list_level(path) not in list_levels([owner_path]):
            level = list_level(path)
            raise FieldsError(
                f"read.{key}: {path!r} is several values for each of {list_level(owner_path) or 'the message'}: "
                f"choose one, {level.removesuffix('[]') + '[0]' + path[len(level) :]!r} say"
            )
        return path

    def _of_object(self, key: str, path: str) -> str:
        """The path from the message down; an object has one value of it. Raises FieldsError."""
        return self._need(key, self.path(path), f"{self._fields.objects}.")

    def _columns(self) -> tuple[list[str], list[str]]:
        """The paths of numbers and of texts to decode. Raises InputError where messages lack one."""
        fields, described = self._fields, self._described
        numbers: list[str] = []
        texts: list[str] = []
        for key in ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "vx_mps", "vy_mps", "existence"):
            path = getattr(fields, key)
            if isinstance(path, str):
                numbers.append(self._of_object(key, path))
        numbers += [self._of_object(key, path) for key, path in described.said.items()]
        if described.footprint is not None:
            numbers += [self._need("footprint", self.path(f"{described.footprint}.{axis}")) for axis in "xy"]
        if isinstance(fields.yaw_rad, str):
            numbers.append(self._of_object("yaw_rad", fields.yaw_rad))
        elif isinstance(fields.yaw_rad, Yaw):
            if fields.yaw_rad.degrees is not None:
                numbers.append(self._of_object("yaw_rad.degrees", fields.yaw_rad.degrees))
            elif fields.yaw_rad.quaternion is not None:
                quaternion_path = fields.yaw_rad.quaternion
                numbers += [self._of_object("yaw_rad.quaternion", f"{quaternion_path}.{axis}") for axis in "xyzw"]
        if fields.covariance is not None:
            numbers += [self._of_object("covariance", f"{fields.covariance}[{k}]") for k in (0, 1, 7)]
        if fields.id is not None:
            texts.append(self._of_object("id", fields.id))
        if (class_field := self.class_) is not None:
            class_path = self._need("class", self.path(class_field.path))
            texts.append(class_path)
            if class_field.probability is not None:
                numbers.append(self._need("class.probability", self.path(class_field.probability), class_path))
            if class_field.key is not None:
                texts.append(self._need("class.key", self.path(class_field.key), class_path))
        if fields.frame is not None:
            texts.append(self._of_object("frame", f"/{fields.frame}"))
        texts += [self._of_object("only", path) for path in described.only]
        if described.within is not None:
            texts.append(self._of_object("id", described.within))
        self.lifetime: list[str] = []
        self.removal: list[str] = []
        if (stays := described.stays) is not None:
            self.lifetime = find_stamp_paths(self._offers, stays.lifetime)
            paths = [path for path in (stays.kind, stays.id) if path is not None]
            self.removal = paths if {*paths} <= {*self._offers} else []
            texts += self.lifetime + self.removal
        texts += self.stamp
        numbers += [self._need("made", self.path(path)) for _, *of in self.made.values() for path in of]
        return numbers, texts

    def shred(self, definition: Definition, payloads: Sequence[bytes]) -> ShreddedMessages:
        """The columns of messages, with those that the description makes of others."""
        plain = ([path for path in paths if path not in self.made] for paths in (self.numbers, self.texts))
        shredded = shred_messages(definition, payloads, *plain)
        for name, (make, *of) in self.made.items():
            rows, parts = shredded.levels[list_level(name)], [(path, list_level(path)) for path in map(self.path, of)]
            columns = (shredded.levels[at].numbers[p][ancestor_rows(shredded, list_level(name), at)] for p, at in parts)
            rows.numbers[name] = values = make(*columns)
            if name in self.texts:
                distinct, code = np.unique(values, return_inverse=True)
                words = tuple(map(format_number, distinct.tolist()))
                rows.texts[name] = DistinctTexts(np.where(np.isnan(values), -1, code), words)
        return shredded

    def _stamp_paths(self) -> list[str]:
        stamp = self._fields.stamp
        if stamp is None:
            return []
        path = stamp.path if isinstance(stamp, Stamp) else stamp
        paths = find_stamp_paths(self._offers, path)
        if not paths:
            raise self._lacks("stamp", path)
        return paths


# Boxes of objects whose shape is an outline, or several bodies.

_YAW = VALUES.index("yaw_rad")
_SIZE = slice(VALUES.index("length_m"), VALUES.index("width_m") + 1)
_SIZES = slice(VALUES.index("length_m"), VALUES.index("height_m") + 1)


def fit_outlines(values: Float, shredded: ShreddedMessages, objects: str, footprint: str) -> None:
    """Set the box of objects in `values (P, V)` without length and width to that around their points at `footprint`."""
    level = list_level(f"{footprint}.x")
    points = shredded.levels[level]
    owner = ancestor_rows(shredded, level, objects)
    least, most = (np.full((len(values), 2), end) for end in (np.inf, -np.inf))
    for k, axis in enumerate("xy"):
        along = points.numbers[f"{footprint}.{axis}"]
        along = np.where(np.abs(along) <= LONGEST_M, along, np.nan)  # with a point that is none there is no box
        np.minimum.at(least[:, k], owner, along)
        np.maximum.at(most[:, k], owner, along)
    size = values[:, _SIZE]
    flat = np.flatnonzero(~(size > 0).all(axis=1) & (most > least).all(axis=1))  # of no point: never
    middle, yaw = (least[flat] + most[flat]) / 2, values[flat, _YAW]
    values[flat, _SIZE] = most[flat] - least[flat]
    values[flat, 0] += middle[:, 0] * np.cos(yaw) - middle[:, 1] * np.sin(yaw)
    values[flat, 1] += middle[:, 0] * np.sin(yaw) + middle[:, 1] * np.cos(yaw)


def find_largest(values: Float, is_meant: Bool, shredded: ShreddedMessages, objects: str, list_path: str) -> Bool:
    """(P,) the largest object of each item of the list `list_path`, among `is_meant (P,)`; of equal ones the first."""
    owner = ancestor_rows(shredded, objects, list_path)
    sizes = np.where(np.abs(values[:, _SIZES]) <= LONGEST_M, np.abs(values[:, _SIZES]), 0.0)
    volume = np.where(is_meant, sizes.prod(axis=1), -np.inf)
    order = np.lexsort((-volume, owner))
    first = np.ones(len(order), dtype=bool)
    first[1:] = np.diff(owner[order]) != 0
    is_largest = is_meant.copy()
    is_largest[order[~first]] = False
    return is_largest


# What stays until a message removes it.

_STOOD_M = 0.1
"""An object that was sent twice no farther apart stood."""


def find_standing(
    number: Int, rank: Int, at_m: Float, forever: Bool, removed: Int, removed_rank: Int, lists: int
) -> tuple[Int, Int, int]:
    """Rows (R,) of objects that stand, the lists (R,) that do not repeat them, and how many states move unsaid.

    Rows (P,): objects `number` in the lists `rank`, of `lists` in order of time, at `at_m (P, 2)`; those that are not
    there `forever` end by themselves. `removed`: objects, −1: all, from the list `removed_rank` on.
    """
    order = np.lexsort((rank, number))
    number, rank, at_m, forever = number[order], rank[order], at_m[order], forever[order]
    same_object = np.diff(number) == 0
    until = np.append(np.where(same_object, rank[1:], lists), lists)
    key = number * lists + rank
    for rows, mine in ((removed >= 0, key), (removed < 0, rank)):
        ends = np.unique(np.where(removed[rows] < 0, 0, removed[rows]) * lists + removed_rank[rows])
        ends = np.append(ends, (number.max() + 1) * lists)
        until = np.minimum(until, rank + ends[np.searchsorted(ends, mine, side="right")] - mine)
    same_object &= until[:-1] == rank[1:]  # what was removed and comes again is another thing
    stood = same_object & (np.hypot(*np.diff(at_m, axis=0).T) <= _STOOD_M)
    last, alone = np.append(~same_object, True), np.append(~same_object, True) & np.append(True, ~same_object)
    stands = np.where(last, alone | np.append(False, stood), np.append(stood, False)) & forever
    gaps = until - rank - 1
    n_unsaid = int(gaps[~stands & ~last & forever].sum())
    gaps = np.where(stands, gaps, 0)
    check_objects(int(gaps.sum()) // max(lists, 1))
    step = np.arange(gaps.sum()) - np.repeat(np.cumsum(gaps) - gaps, gaps)
    return np.repeat(order, gaps), np.repeat(rank + 1, gaps) + step, n_unsaid


# Decoding.

__all__ = ["ClassField", "DecodedLists", "Description", "Fields", "FieldsError", "Stamp", "Yaw", "decode_lists"]


@dataclass(frozen=True)
class Station:
    """The station that lists are relative to. `place (F, 2)`: latitude and longitude in degrees, NaN: not said.

    `after_s (P,)`: when objects were measured, in s after the stamp of their list.
    """

    place: Float
    after_s: Float


@dataclass(frozen=True)
class DecodedLists:
    """The lists of one topic, with properties of entries that only recorded units need, (P,) each.

    `frame_code` indexes `frames`, −1: no frame is named. `covariance_m2 (P, 3)` is xx, xy, yy of the position in the
    list's frame, NaN: not stated. `probability (P, C)` of each class sums to 1.
    """

    columns: DecodedObjects
    frame_code: Int
    frames: tuple[str, ...]
    existence: Float
    covariance_m2: Float
    probability: Float
    named: bool  # whether its objects have ids
    part: str = ""  # the recording they are from, of several of one drive
    station: Station | None = None  # that positions are relative to, in m east and north of it

    def take_rows(self, keep: Bool) -> DecodedLists:
        """The lists with the entries `keep` (P,)."""
        columns, station = self.columns, self.station
        message = np.repeat(np.arange(len(columns.rows)), columns.rows)[keep]
        of_rows = {name: getattr(columns, name)[keep] for name in ("object_ix", "class_ix", "values")}
        own_columns = {n: getattr(self, n)[keep] for n in ("frame_code", "existence", "covariance_m2", "probability")}
        columns = replace(columns, rows=np.bincount(message, minlength=len(columns.rows)), **of_rows)
        station = station and replace(station, after_s=station.after_s[keep])
        return replace(self, columns=columns, station=station, **own_columns)


def decode_lists(
    definition: Definition,
    description: Description,
    payloads: Sequence[bytes],
    log_time_ns: Int,
    ahead_ns: int = 0,
    since_ns: int = 0,
) -> DecodedLists:
    """The lists in messages that were logged at `log_time_ns (F,)`; `ahead_ns`: their clock against that of log times.

    `since_ns`: of messages logged before only what stays is taken.
    Raises FieldsError, OversizeError.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # states that are not finite are left out later
        return _BatchReader(definition, description, payloads).listed(log_time_ns, ahead_ns, since_ns)


class _BatchReader:
    """Columns of one batch of messages."""

    def __init__(self, definition: Definition, description: Description, payloads: Sequence[bytes]) -> None:
        self._fields = description.fields
        self._description = description
        self._notes: list[str] = []
        self._wanted = WantedPaths(description, definition.offers())
        self._found = self._wanted.shred(definition, payloads)
        self._names = definition.names
        check_objects(int(np.bincount(ancestor_rows(self._found, self._fields.objects, "")).max(initial=0)))
        self._messages = len(payloads)

    def rows(self, level: str) -> int:
        """Number of rows of a level."""
        return len(self._found.levels[level].parent)

    def number(self, path: str) -> Float:
        """(P,) numbers of the objects at a path, of their own level or one above."""
        whole = self._wanted.path(path)
        level = list_level(whole)
        column: Float = self._found.levels[level].numbers[whole]
        return column[ancestor_rows(self._found, self._fields.objects, level)]

    def text(self, path: str) -> DistinctTexts:
        """(P,) texts of the objects at a path, of their own level or one above."""
        whole = self._wanted.path(path)
        level = list_level(whole)
        texts = self._found.levels[level].texts[whole]
        return DistinctTexts(texts.code[ancestor_rows(self._found, self._fields.objects, level)], texts.words)

    def _stamps(self, log_time_ns: Int) -> tuple[Int, Bool]:
        """(F,) time stamps (ns) of all messages, else their log times, and (F,) whether they state one."""
        stamp_ns, stamped = log_time_ns.copy(), np.zeros(len(log_time_ns), dtype=bool)
        paths, stamp = self._wanted.stamp, self._fields.stamp
        if not paths:
            return stamp_ns, stamped
        level = list_level(paths[0])
        rows = self._found.levels[level]
        message = self._found.levels[""].parent[ancestor_rows(self._found, level, "")]
        unit = stamp.unit if isinstance(stamp, Stamp) else "s"
        stated_ns, has_stamp, impossible = parse_nanoseconds([rows.texts[p] for p in paths], unit)
        self._impossible = impossible
        first = np.flatnonzero(has_stamp)[::-1]  # of several in one message the first
        stamp_ns[message[first]], stamped[message[first]] = stated_ns[first], True
        return stamp_ns, stamped

    def _settled_stamps(self, log_time_ns: Int, ahead_ns: int) -> tuple[Int, Int, Bool]:
        """The decoded messages that are kept (K,), their stamps by the clock of log times, and whether stated."""
        self._impossible = 0
        stamp_ns, stamped = self._stamps(log_time_ns)
        self._notes += find("stamp impossible", self._impossible)
        rows = np.flatnonzero(self._found.decoded)
        moved_ns = stamp_ns - np.where(stamped, ahead_ns, 0)
        stamp_ns, stamped, keep, findings = settle_stamps(
            moved_ns[rows], stamped[rows], log_time_ns[rows], ahead_ns=ahead_ns, noted=self._impossible
        )
        self._notes += findings
        return rows[keep], stamp_ns[keep], stamped[keep]

    def _amount(self, amount: Amount | None, otherwise: float) -> Float:
        if isinstance(amount, str):
            return self.number(amount)
        return np.full(self.rows(self._fields.objects), otherwise if amount is None else float(amount))

    def _yaw(self) -> Float:
        yaw_field = self._fields.yaw_rad
        if not isinstance(yaw_field, Yaw):
            return self._amount(yaw_field, 0.0)
        if yaw_field.degrees is not None:
            return np.deg2rad(self.number(yaw_field.degrees))
        x, y, z, w = (self.number(f"{yaw_field.quaternion}.{axis}") for axis in "xyzw")
        empty = (x == 0.0) & (y == 0.0) & (z == 0.0) & (w == 0.0)
        self._notes += find("yaw unset", int(empty.sum()))
        yaw: Float = np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)  # of any usual length
        return np.where(np.hypot(np.hypot(x, y), np.hypot(z, w)) <= _LONGEST_QUATERNION, yaw, np.nan)

    def _classes(self, keep: Int) -> Float:
        """(K, C) probability of each class of the objects `keep`; rows sum to 1. No class stated: `other`."""
        rows = self.rows(self._fields.objects)
        class_field = self._wanted.class_
        probability = np.zeros((rows, len(CLASSES)))
        if class_field is not None:
            class_path = self._wanted.path(class_field.path)
            level = list_level(class_path)
            shared = common_level(level, self._fields.objects)
            texts = self._found.levels[level].texts[class_path]
            known_as = self._by_name(any_item_path(class_path), class_field.map)
            names = [word.strip() and (known_as.get(word) or class_from_name(word) or "other") for word in texts.words]
            class_of_word = np.array([CLASSES.index(name) if name else -1 for name in names] + [-1])
            code = class_of_word[texts.code]
            self._note_other_names(texts, ["" if w in known_as else class_from_name(w) for w in texts.words])
            share = np.ones(len(code))
            if class_field.probability is not None:
                share_path = self._wanted.path(class_field.probability)
                share = self._found.levels[list_level(share_path)].numbers[share_path]
                share = share[ancestor_rows(self._found, level, list_level(share_path))]
                # A class with probability 0 or none is still stated; more than 1 counts as 1.
                share = sift_shares(share, "class share", self._notes, most=MOST_SHARE)
                share = np.clip(np.where(np.isnan(share), 0.0, share), 1e-9, 1.0)
            counted = code >= 0
            if class_field.key is not None:
                key_path = self._wanted.path(class_field.key)
                keys = self._found.levels[list_level(key_path)].texts[key_path]
                key = keys.code[ancestor_rows(self._found, level, list_level(key_path))]
                counted &= np.array([word.lower() in class_field.keys for word in keys.words] + [False])[key]
            owner = ancestor_rows(self._found, level, shared)
            claimed = np.zeros((self.rows(shared), len(CLASSES)))
            np.add.at(claimed, (owner[counted], code[counted]), share[counted])
            probability = claimed[ancestor_rows(self._found, self._fields.objects, shared)]
        probability = probability[keep]
        no_class = probability.sum(axis=1) <= 0
        self._notes += find("class unsaid", 0 if no_class.all() else int(no_class.sum()))
        probability[no_class, CLASSES.index("other")] = 1.0
        normed: Float = probability / probability.sum(axis=1, keepdims=True)
        return normed

    def _note_other_names(self, texts: DistinctTexts, names: Sequence[str | None]) -> None:
        """Note the names of classes that are read as other, the most frequent first: what says nothing, what stands."""
        counts = np.bincount(texts.code[texts.code >= 0], minlength=len(texts.words)).tolist()
        for rule, meant in (("class name", None), ("class other", "other")):
            found = [(-counts[k], word) for k, word in enumerate(texts.words) if names[k] == meant and word.strip()]
            which = ", ".join(f"{word} {-number}" for number, word in sorted(found)[:_SHOWN] if number)
            self._notes += find(rule, sum(-number for number, _ in found), which=which)

    def _by_name(self, path: str, meant: Mapping[str, str]) -> Mapping[str, str]:
        """The class of each value, for values of an enumeration also by their names."""
        names = {name: meant[str(number)] for number, name in self._names(path).items() if str(number) in meant}
        return {**names, **meant}

    def _frame_of(self) -> tuple[Int, tuple[str, ...]]:
        """(P,) index of the frame of each object, −1: none, and the names of frames."""
        path = self._fields.frame
        if path is None:
            return np.full(self.rows(self._fields.objects), -1), ()
        names = self.text(f"/{path}")
        return names.code, names.words

    def _meant(self) -> Bool:
        """(P,) whether an object has the values of `only`."""
        is_meant = np.ones(self.rows(self._fields.objects), dtype=bool)
        for path, values in self._description.only.items():
            texts = self.text(path)
            is_meant &= np.array([word in values for word in texts.words] + [False], dtype=bool)[texts.code]
        return is_meant

    def _ids(self) -> DistinctTexts | None:
        """(P,) ids as texts, made unique by the field `within`; None: no object has one."""
        if self._fields.id is None:
            return None
        ids = self.text(self._fields.id)
        is_empty = np.array([not word for word in ids.words] + [True])[ids.code]  # an empty text is no id
        if is_empty.all():
            return None
        ids = DistinctTexts(np.where(is_empty, -1, ids.code), ids.words)
        if self._description.within is None:
            return ids
        name_spaces = self.text(self._description.within)
        id_count = len(ids.words) + 1
        pairs, code = np.unique((name_spaces.code + 1) * id_count + ids.code + 1, return_inverse=True)
        names = tuple(_join_id(name_spaces, pair // id_count - 1, ids, pair % id_count - 1) for pair in pairs.tolist())
        return DistinctTexts(np.where(ids.code < 0, -1, code), names)

    def _said(self, what: Literal["yaw", "velocity", "covariance"]) -> Bool:
        """(P,) whether an object states this property."""
        path = self._description.said.get(what)
        if path is None:
            return np.ones(self.rows(self._fields.objects), dtype=bool)
        stated: Bool = self.number(path) != 0
        return stated

    def _shaped(self, values: Float, is_meant: Bool) -> Bool:
        """(P,) which objects remain meant, after boxes in `values (P, V)` were set by their shapes."""
        described, objects = self._description, self._fields.objects
        if described.footprint is not None:
            fit_outlines(values, self._found, objects, self._wanted.path(described.footprint))
        if described.largest_of is None:
            return is_meant
        is_largest = find_largest(values, is_meant, self._found, objects, described.largest_of)
        self._notes += find("cube", int((is_meant & ~is_largest).sum()))
        return is_largest

    def _velocity(self, yaw: Float) -> tuple[Float, Float]:
        """(P,) velocities along each axis of the list's frame, NaN: not stated."""
        vx, vy = (self._amount(path, np.nan) for path in (self._fields.vx_mps, self._fields.vy_mps))
        if self._fields.velocity == "object":
            cos, sin = np.cos(yaw), np.sin(yaw)
            vx, vy = vx * cos - vy * sin, vx * sin + vy * cos
        stated = self._said("velocity")
        return np.where(stated, vx, np.nan), np.where(stated, vy, np.nan)

    def _values(self) -> Float:
        """(P, V) values of the objects, in the order of VALUES; NaN: not stated."""
        fields, yaw = self._fields, self._yaw()
        return np.stack(
            [
                self.number(fields.x_m),
                self.number(fields.y_m),
                self._amount(fields.z_m, 0.0),
                yaw,
                *self._velocity(yaw),
                self._amount(fields.length_m, np.nan),
                self._amount(fields.width_m, np.nan),
                self._amount(fields.height_m, 0.0),
            ],
            axis=1,
        )

    def _kept(self, is_meant: Bool, ids: DistinctTexts | None) -> Int:
        """(K,) rows of the objects that are meant and, if objects have ids, have one; notes tell of the others."""
        if ids is not None:
            nameless = (ids.code < 0) & is_meant
            is_meant = is_meant & ~nameless
            self._notes += find("no id", int(nameless.sum()))
        keep = np.flatnonzero(is_meant)
        self._notes += find("yaw unsaid", int((~self._said("yaw")[keep]).sum()))
        return keep

    def _covariance(self, keep: Int) -> Float:
        """(K, 3) xx, xy, yy of the positions, NaN: not stated."""
        path = self._fields.covariance
        if path is None:
            return np.full((len(keep), 3), np.nan)
        covariance: Float = np.stack([self.number(f"{path}[{k}]")[keep] for k in (0, 1, 7)], axis=1)
        covariance[~self._said("covariance")[keep]] = np.nan
        return covariance

    def _station(self, message: Int, keep: Int) -> Station | None:
        """The station of the messages (F,) and of the objects `keep` (K,)."""
        within, message_columns = self._description.within, self._found.levels[""]
        if not self._description.station or within is None:
            return None
        self._notes += find("stations", max(len(message_columns.texts[self._wanted.path(within)].words) - 1, 0))
        place = np.stack([message_columns.numbers["latitude_deg"], message_columns.numbers["longitude_deg"]], axis=1)
        return Station(place[np.searchsorted(message_columns.parent, message)], self.number("after_s")[keep])

    def _with_standing(
        self, keep: Int, message: Int, ids: DistinctTexts | None, in_time: Int, values: Float
    ) -> tuple[Int, Int]:
        """Rows of objects and the message of each, with what stands added to messages that do not repeat it."""
        stays, paths, entry_message = self._description.stays, self._wanted.lifetime, message[keep]
        if stays is None or ids is None or not len(keep):
            return keep, entry_message
        forever = np.ones(len(keep), dtype=bool)
        if paths:
            level = list_level(paths[0])
            stated_ns, _, _ = parse_nanoseconds([self._found.levels[level].texts[path] for path in paths], "s")
            forever = stated_ns[ancestor_rows(self._found, self._fields.objects, level)][keep] == 0
        rank = np.full(self._messages, -1)
        rank[in_time] = np.arange(len(in_time))
        removed, since = self._removals(ids)
        added, until, unsaid = find_standing(
            ids.code[keep], rank[entry_message], values[keep, :2], forever, removed, rank[since], len(in_time)
        )
        self._notes += find("stays unsaid", unsaid)
        self._notes += find("stands", len(added))
        keep, entry_message = np.append(keep, keep[added]), np.append(entry_message, in_time[until])
        order = np.argsort(entry_message, kind="stable")
        return keep[order], entry_message[order]

    def _removals(self, ids: DistinctTexts) -> tuple[Int, Int]:
        """Things that messages remove (code of the id, −1: all), and the message of each removal."""
        stays = self._description.stays
        if stays is None or not self._wanted.removal:
            return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        level = list_level(stays.kind)
        texts, message = self._found.levels[level].texts, ancestor_rows(self._found, level, "")
        kinds = [*texts[stays.kind].words, ""]
        one, every = (np.array([word in of for word in kinds])[texts[stays.kind].code] for of in (stays.one, stays.all))
        code = ids.code
        if stays.id is not None:
            code_by_id = {word: number for number, word in enumerate(ids.words)}
            code = np.array([*(code_by_id.get(word, -2) for word in texts[stays.id].words), -2])[texts[stays.id].code]
        chosen = every | (one & (code >= 0))
        return np.where(every, -1, code)[chosen], message[chosen]

    def listed(self, log_time_ns: Int, ahead_ns: int, since_ns: int) -> DecodedLists:
        """The objects that are kept, from `since_ns` on. The order of the steps is that of the notes."""
        shredded, is_meant = self._found, self._meant()
        self._notes += find("undecoded", int((~shredded.decoded).sum()))
        kept_message, stamp_ns, stamped = self._settled_stamps(log_time_ns, ahead_ns)
        values = self._values()
        is_meant = self._shaped(values, is_meant)
        ids = self._ids()
        keep = self._kept(is_meant, ids)
        message = shredded.levels[""].parent[ancestor_rows(shredded, self._fields.objects, "")]
        keep = keep[np.isin(message[keep], kept_message)]
        keep, message = self._with_standing(
            keep, message, ids, kept_message[np.argsort(stamp_ns, kind="stable")], values
        )
        is_inside = log_time_ns[kept_message] >= since_ns
        kept_message, stamp_ns, stamped = kept_message[is_inside], stamp_ns[is_inside], stamped[is_inside]
        keep, message = (rows[np.isin(message, kept_message)] for rows in (keep, message))
        number = np.arange(len(keep)) if ids is None else ids.code[keep]
        names = tuple(str(k) for k in range(len(keep))) if ids is None else ids.words
        probability = self._classes(keep)
        station = self._station(kept_message, keep)
        columns = DecodedObjects(
            stamp_ns=stamp_ns,
            stamped=stamped,
            log_time_ns=log_time_ns[kept_message],
            rows=np.bincount(message, minlength=self._messages)[kept_message],
            object_ids=names,
            moving=np.ones(len(names), dtype=bool),
            object_ix=number.astype(np.int64),
            class_ix=probability.argmax(axis=1).astype(np.int8),
            values=values[keep],
            notes=tuple(self._notes),
        )
        frame, frames = self._frame_of()
        return DecodedLists(
            columns,
            frame[keep],
            frames,
            self._amount(self._fields.existence, np.nan)[keep],
            self._covariance(keep),
            probability,
            ids is not None,
            station=station,
        )


def _join_id(spaces: DistinctTexts, space: int, ids: DistinctTexts, ident: int) -> str:
    """`namespace/id`, `id` without a namespace, `""` without an id."""
    if ident < 0:
        return ""
    namespace = spaces.words[space] if space >= 0 else ""
    return f"{namespace}/{ids.words[ident]}" if namespace else ids.words[ident]
