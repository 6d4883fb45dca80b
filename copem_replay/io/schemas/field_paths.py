"""Which columns a description needs of messages, and what is said of a path that they do not have."""

from __future__ import annotations

import difflib
from collections.abc import Collection

from copem_replay.io.encodings.columns import any_item, level_of, levels_to
from copem_replay.io.schemas.description import Class, Description, Stamp, Yaw
from copem_replay.io.schemas.timestamps import stamps_in

_COMPARED = 2000  # fields that are compared with one that is not there (chosen)
_SHOWN = 12  # fields named in an error (chosen)


class FieldsError(ValueError):
    """A path that messages do not have: which key named it, and what there is instead."""


class Wanted:
    """The paths a description means, from the message down. Raises FieldsError where messages do not offer them."""

    def __init__(self, description: Description, offers: Collection[str]) -> None:
        self._fields, self._described, self._offers = description.fields, description, offers
        objects = any_item(self._fields.objects)
        lists = {level for path in offers for level in levels_to([path]) if level}
        if objects not in lists or not self._fields.objects.endswith("[]"):
            raise self._lacks("objects", self._fields.objects, "list", sorted(lists))
        said = self._fields.class_
        self.class_ = Class(path=said) if isinstance(said, str) else said
        self.stamp = self._stamp_paths()
        """Of the time stamp: of one value, or of seconds and nanoseconds."""
        self.numbers, self.texts = self._columns()

    def path(self, path: str) -> str:
        """A path as it is from the message down."""
        return path[1:] if path.startswith("/") else f"{self._fields.objects}.{path}"

    def _lacks(self, key: str, path: str, what: str = "", there: Collection[str] = ()) -> FieldsError:
        offered = list(there or self._offers)
        near = difflib.get_close_matches(path, offered[:_COMPARED], n=3, cutoff=0.5)
        near += [p for p in offered if p.rpartition(".")[2] == path.rpartition(".")[2] and p not in near][:3]
        shown = near or offered[:_SHOWN]
        more = f", … ({len(offered)} in all)" if len(offered) > len(shown) else ""
        what = f"{what} " if what else ""
        return FieldsError(
            f"read.{key}: the messages have no {what}{path!r}; they have {', '.join(shown) or 'nothing'}{more}"
        )

    def _need(self, key: str, path: str, within: str | None = None) -> str:
        """The path. Raises FieldsError where messages do not have it, or several of it `within` one of a list."""
        if any_item(path) not in self._offers:
            raise self._lacks(key, path)
        if within is not None and level_of(path) not in levels_to([within]):
            level = level_of(path)
            raise FieldsError(
                f"read.{key}: {path!r} is several values for each of {level_of(within) or 'the message'}: "
                f"choose one, {level.removesuffix('[]') + '[0]' + path[len(level) :]!r} say"
            )
        return path

    def _of_object(self, key: str, path: str) -> str:
        """The whole path, of which an object has one value. Raises FieldsError."""
        return self._need(key, self.path(path), f"{self._fields.objects}.")

    def _columns(self) -> tuple[list[str], list[str]]:
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
                whole = fields.yaw_rad.quaternion
                numbers += [self._of_object("yaw_rad.quaternion", f"{whole}.{axis}") for axis in "xyzw"]
        if fields.covariance is not None:
            numbers += [self._of_object("covariance", f"{fields.covariance}[{k}]") for k in (0, 1, 7)]
        if fields.id is not None:
            texts.append(self._of_object("id", fields.id))
        if (said := self.class_) is not None:
            whole = self._need("class", self.path(said.path))
            texts.append(whole)
            if said.probability is not None:
                numbers.append(self._need("class.probability", self.path(said.probability), whole))
            if said.key is not None:
                texts.append(self._need("class.key", self.path(said.key), whole))
        if fields.frame is not None:
            texts.append(self._of_object("frame", f"/{fields.frame}"))
        texts += [self._of_object("only", path) for path in described.only]
        if described.within is not None:
            texts.append(self._of_object("id", described.within))
        if described.solid is not None:
            numbers += [self._of_object("length_m", described.solid.kind)]
            numbers += [self._of_object("length_m", f"{described.solid.dimensions}[{k}]") for k in range(2)]
        if described.stays is not None:
            texts.append(described.stays)
        texts += self.stamp
        return numbers, texts

    def _stamp_paths(self) -> list[str]:
        stamp = self._fields.stamp
        if stamp is None:
            return []
        path = stamp.path if isinstance(stamp, Stamp) else stamp
        found = stamps_in(self._offers, path)
        if not found:
            raise self._lacks("stamp", path)
        return found
