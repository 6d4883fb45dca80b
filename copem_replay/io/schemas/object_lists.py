"""Object lists of any schema, read by the names of their fields.

`Fields` says where a message has what; the formats this version knows by name are such descriptions, too, and so is
`read:` of an experiment.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from copem_replay.core.classes import class_named
from copem_replay.core.text import counted
from copem_replay.core.tracks import CLASSES, Bool, Float, Int
from copem_replay.io.encodings.columns import (
    Definition,
    Shredded,
    Texts,
    any_item,
    common_level,
    level_of,
    rows_above,
    take_apart,
)
from copem_replay.io.schemas.decoded import DecodedObjects
from copem_replay.io.schemas.description import Amount, Class, Description, Fields, Stamp, Yaw
from copem_replay.io.schemas.field_paths import FieldsError, Wanted
from copem_replay.io.schemas.shapes import largest, outlined, rounded
from copem_replay.io.schemas.timestamps import nanoseconds

__all__ = ["Class", "DecodedLists", "Description", "Fields", "FieldsError", "Stamp", "Yaw", "listed"]


@dataclass(frozen=True)
class DecodedLists:
    """The lists of one topic, and what of them only recorded units need: (P,) each.

    `frame_code` indexes `frames`, −1: no frame is said. `covariance_m2 (P, 3)` is xx, xy, yy of the position in the
    list's frame, NaN: not said. `probability (P, C)` of each class sums to 1.
    """

    columns: DecodedObjects
    frame_code: Int
    frames: tuple[str, ...]
    existence: Float
    covariance_m2: Float
    probability: Float
    log_time_ns: Int  # (F,)
    named: bool  # whether its objects have ids
    part: str = ""  # which of several recordings of one drive they are of


def listed(
    definition: Definition, description: Description, payloads: Sequence[bytes], log_time_ns: Int
) -> DecodedLists:
    """The lists that messages hold, logged at `log_time_ns (F,)`. Raises FieldsError."""
    with np.errstate(over="ignore", invalid="ignore"):  # what is no number, or too large a one, is found out later
        return _Reader(definition, description, payloads).listed(log_time_ns)


class _Reader:
    """Columns of one batch of messages."""

    def __init__(self, definition: Definition, description: Description, payloads: Sequence[bytes]) -> None:
        self._fields = description.fields
        self._description = description
        self._notes: Counter[tuple[str, str]] = Counter()
        self._wanted = Wanted(description, definition.offers())
        self._found: Shredded = take_apart(definition, payloads, self._wanted.numbers, self._wanted.texts)
        self._names = definition.names
        self._messages = len(payloads)

    def rows(self, level: str) -> int:
        return len(self._found.levels[level].parent)

    def number(self, path: str) -> Float:
        """(P,) of the objects: from their own level, or one above."""
        whole = self._wanted.path(path)
        level = level_of(whole)
        column: Float = self._found.levels[level].numbers[whole]
        return column[rows_above(self._found, self._fields.objects, level)]

    def text(self, path: str) -> Texts:
        whole = self._wanted.path(path)
        level = level_of(whole)
        found = self._found.levels[level].texts[whole]
        return Texts(found.code[rows_above(self._found, self._fields.objects, level)], found.words)

    def _stamps(self, log_time_ns: Int) -> tuple[Int, Bool]:
        """(F,) time stamps of all messages, and whether they say one."""
        stamp_ns, stamped = log_time_ns.copy(), np.zeros(len(log_time_ns), dtype=bool)
        paths, stamp = self._wanted.stamp, self._fields.stamp
        if not paths:
            return stamp_ns, stamped
        level = level_of(paths[0])
        found = self._found.levels[level]
        message = self._found.levels[""].parent[rows_above(self._found, level, "")]
        unit = stamp.unit if isinstance(stamp, Stamp) else "s"
        said_ns, said, impossible = nanoseconds([found.texts[p] for p in paths], unit)
        if impossible:
            self._notes["message", "with an impossible time stamp: the time of logging taken"] += impossible
        first = np.flatnonzero(said)[::-1]  # of several in one message the first
        stamp_ns[message[first]], stamped[message[first]] = said_ns[first], True
        return stamp_ns, stamped

    def _amount(self, amount: Amount | None, otherwise: float) -> Float:
        if isinstance(amount, str):
            return self.number(amount)
        return np.full(self.rows(self._fields.objects), otherwise if amount is None else float(amount))

    def _yaw(self) -> Float:
        said = self._fields.yaw_rad
        if not isinstance(said, Yaw):
            return self._amount(said, 0.0)
        if said.degrees is not None:
            return np.deg2rad(self.number(said.degrees))
        x, y, z, w = (self.number(f"{said.quaternion}.{axis}") for axis in "xyzw")
        empty = (x == 0.0) & (y == 0.0) & (z == 0.0) & (w == 0.0)
        if empty.any():
            self._notes["object state", "without orientation: yaw 0 taken"] += int(empty.sum())
        yaw: Float = np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)  # of any length
        return yaw

    def _classes(self) -> Float:
        """(P, C) probability of each class, sums to 1."""
        rows = self.rows(self._fields.objects)
        said = self._wanted.class_
        probability = np.zeros((rows, len(CLASSES)))
        if said is not None:
            whole = self._wanted.path(said.path)
            level = level_of(whole)
            shared = common_level(level, self._fields.objects)
            texts = self._found.levels[level].texts[whole]
            known_as = self._by_name(any_item(whole), said.map)
            of_word = np.array([_class_ix(word, known_as) for word in texts.words] + [-1])
            code = of_word[texts.code]
            share = np.ones(len(code))
            if said.probability is not None:
                share = self._found.levels[level_of(self._wanted.path(said.probability))].numbers[
                    self._wanted.path(said.probability)
                ]
                share = share[rows_above(self._found, level, level_of(self._wanted.path(said.probability)))]
                # said with no probability it is still said; more than certain is nothing
                share = np.clip(np.nan_to_num(share), 1e-9, 1.0)
            known = code >= 0
            if said.key is not None:
                keys = self._found.levels[level_of(self._wanted.path(said.key))].texts[self._wanted.path(said.key)]
                key = keys.code[rows_above(self._found, level, level_of(self._wanted.path(said.key)))]
                known &= np.array([word.lower() in said.keys for word in keys.words] + [False])[key]
            owner = rows_above(self._found, level, shared)
            claimed = np.zeros((self.rows(shared), len(CLASSES)))
            np.add.at(claimed, (owner[known], code[known]), share[known])
            probability = claimed[rows_above(self._found, self._fields.objects, shared)]
        none = probability.sum(axis=1) <= 0
        probability[none, CLASSES.index("other")] = 1.0
        normed: Float = probability / probability.sum(axis=1, keepdims=True)
        return normed

    def _by_name(self, path: str, meant: Mapping[str, str]) -> Mapping[str, str]:
        """What values mean, those of an enumeration by their names, too."""
        names = {name: meant[str(number)] for number, name in self._names(path).items() if str(number) in meant}
        return {**names, **meant}

    def _frame_of(self) -> tuple[Int, tuple[str, ...]]:
        path = self._fields.frame
        if path is None:
            return np.full(self.rows(self._fields.objects), -1), ()
        found = self.text(f"/{path}")
        return found.code, found.words

    def _meant(self) -> Bool:
        """(P,) the objects that the format means."""
        meant = np.ones(self.rows(self._fields.objects), dtype=bool)
        for path, values in self._description.only.items():
            found = self.text(path)
            meant &= np.array([word in values for word in found.words] + [False], dtype=bool)[found.code]
        return meant

    def _ids(self) -> Texts | None:
        """(P,) ids; None: objects have none."""
        if self._fields.id is None:
            return None
        ids = self.text(self._fields.id)
        nothing = np.array([not word for word in ids.words] + [True])[ids.code]  # an empty text is no id
        if nothing.all():
            return None
        ids = Texts(np.where(nothing, -1, ids.code), ids.words)
        if self._description.within is None:
            return ids
        spaces = self.text(self._description.within)
        width = len(ids.words) + 1
        pairs, code = np.unique((spaces.code + 1) * width + ids.code + 1, return_inverse=True)
        names = tuple(_joined(spaces, pair // width - 1, ids, pair % width - 1) for pair in pairs.tolist())
        return Texts(np.where(ids.code < 0, -1, code), names)

    def _said(self, what: Literal["yaw", "velocity", "covariance"]) -> Bool:
        """(P,) which objects say this."""
        path = self._description.said.get(what)
        if path is None:
            return np.ones(self.rows(self._fields.objects), dtype=bool)
        said: Bool = self.number(path) != 0
        return said

    def _shaped(self, values: Float, meant: Bool) -> Bool:
        """Give all the boxes that their shapes say; (P,) which are meant all the same."""
        described, objects = self._description, self._fields.objects
        if described.footprint is not None:
            outlined(values, self._found, objects, self._wanted.path(described.footprint))
        if (solid := described.solid) is not None:
            rounded(values, *(self.number(p) for p in (solid.kind, *(f"{solid.dimensions}[{k}]" for k in range(2)))))
        if described.largest_of is None:
            return meant
        chosen = largest(values, meant, self._found, objects, described.largest_of)
        if beside := int((meant & ~chosen).sum()):
            self._notes["cube", "beside a larger one of the same entity: left out"] += beside
        return chosen

    def _velocity(self, yaw: Float) -> tuple[Float, Float]:
        """(P,) each along the axes of the list's frame, NaN: not said."""
        vx, vy = (self._amount(path, np.nan) for path in (self._fields.vx_mps, self._fields.vy_mps))
        if self._fields.velocity == "object":
            cos, sin = np.cos(yaw), np.sin(yaw)
            vx, vy = vx * cos - vy * sin, vx * sin + vy * cos
        said = self._said("velocity")
        return np.where(said, vx, np.nan), np.where(said, vy, np.nan)

    def _values(self) -> Float:
        """(P, V) values of the objects, in the order of VALUES."""
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

    def _kept(self, meant: Bool, ids: Texts | None) -> Int:
        """(K,) rows of the objects that are meant and have an id, if objects have ids; notes what of them is unsaid."""
        if ids is not None:
            nameless = (ids.code < 0) & meant
            meant = meant & ~nameless
            if nameless.any():
                self._notes["object state", "without an id: skipped"] += int(nameless.sum())
        keep = np.flatnonzero(meant)
        if unsaid := int((~self._said("yaw")[keep]).sum()):
            self._notes["object state", "that does not say its heading: as written"] += unsaid
        return keep

    def _covariance(self, keep: Int) -> Float:
        """(K, 3) xx, xy, yy of the positions, NaN: not said."""
        path = self._fields.covariance
        if path is None:
            return np.full((len(keep), 3), np.nan)
        covariance: Float = np.stack([self.number(f"{path}[{k}]")[keep] for k in (0, 1, 7)], axis=1)
        covariance[~self._said("covariance")[keep]] = np.nan
        return covariance

    def _unsaid(self) -> int:
        """How many messages between the first and the last with a thing that stays do not repeat it."""
        if (path := self._description.stays) is None:
            return 0
        level = level_of(path)
        code, message = self._found.levels[level].texts[path].code, rows_above(self._found, level, "")
        code, message = np.unique(np.stack([code, message])[:, code >= 0], axis=1)
        return int((np.diff(message) - 1)[np.diff(code) == 0].sum())

    def listed(self, log_time_ns: Int) -> DecodedLists:
        """All columns of the objects that are kept. Notes stand in the order in which things are found out."""
        found, meant = self._found, self._meant()
        if lost := int((~found.decoded).sum()):
            self._notes["message", "cannot be decoded: skipped"] += lost
        stamp_ns, stamped = self._stamps(log_time_ns)
        values = self._values()
        meant = self._shaped(values, meant)
        ids = self._ids()
        keep = self._kept(meant, ids)
        number = np.arange(len(keep)) if ids is None else ids.code[keep]
        names = tuple(str(k) for k in range(len(keep))) if ids is None else ids.words
        message = found.levels[""].parent[rows_above(found, self._fields.objects, "")]
        kept_message = np.flatnonzero(found.decoded)
        probability = self._classes()[keep]
        if unsaid := self._unsaid():
            self._notes[
                "state", "in between that no message repeats: not taken, a list holds what its message says"
            ] += unsaid
        columns = DecodedObjects(
            stamp_ns=stamp_ns[kept_message],
            stamped=stamped[kept_message],
            rows=np.bincount(message[keep], minlength=self._messages)[kept_message],
            object_ids=names,
            moving=np.ones(len(names), dtype=bool),
            object_ix=number.astype(np.int64),
            class_ix=probability.argmax(axis=1).astype(np.int8),
            values=values[keep],
            notes=tuple(f"{counted(n, noun)} {what}" for (noun, what), n in self._notes.items()),
        )
        frame, frames = self._frame_of()
        return DecodedLists(
            columns,
            frame[keep],
            frames,
            self._amount(self._fields.existence, np.nan)[keep],
            self._covariance(keep),
            probability,
            log_time_ns[kept_message],
            ids is not None,
        )


def _joined(spaces: Texts, space: int, ids: Texts, ident: int) -> str:
    named = spaces.words[space] if space >= 0 else ""
    return f"{named}/{ids.words[ident]}" if named and ident >= 0 else ids.words[ident] if ident >= 0 else ""


def _class_ix(word: str, known: Mapping[str, str]) -> int:
    name = known.get(word) or class_named(word)
    return CLASSES.index(name) if name is not None else CLASSES.index("other")
