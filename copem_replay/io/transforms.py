"""Frames of reference: where the frame of a list lay in the world at an instant.

From the transforms and the odometry in a recording. Between two samples positions are interpolated linearly and
rotations the short way round; over a longer gap than `MAX_GAP_S`, and before the first and after the last one, nothing
is known. A transform that is said once, or on a topic of static ones, holds for ever.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.core.rotation import back, combined, turned
from copem_replay.core.tracks import Bool, Float, Int
from copem_replay.io.plausibility import MAX_GAP_S

if TYPE_CHECKING:
    from copem_replay.io.schemas.poses import Poses


@dataclass(frozen=True)
class PosesAt:
    """Where something was at K instants: `there (K,)`, `position_m (K, 3)`, `rotation (K, 4)` as x, y, z, w."""

    there: Bool
    position_m: Float
    rotation: Float


@dataclass(frozen=True)
class PoseTrack:
    """Samples of one pose over time, in order of time, each instant once."""

    parent: str
    stamp_ns: Int
    position_m: Float
    rotation: Float
    velocity_mps: Float

    def at(self, stamp_ns: Int, *, forever: bool = False) -> PosesAt:
        """The pose at instants (K,); `forever`: the last sample holds whenever."""
        if forever or len(self.stamp_ns) == 1:
            last = np.full(len(stamp_ns), len(self.stamp_ns) - 1)
            return PosesAt(np.ones(len(stamp_ns), dtype=bool), self.position_m[last], self.rotation[last])
        after = np.searchsorted(self.stamp_ns, stamp_ns, side="left").clip(1, len(self.stamp_ns) - 1)
        before = after - 1
        apart = self.stamp_ns[after] - self.stamp_ns[before]
        share = ((stamp_ns - self.stamp_ns[before]) / apart)[:, None]
        exact = (stamp_ns == self.stamp_ns[before]) | (stamp_ns == self.stamp_ns[after])
        there = (share[:, 0] >= 0) & (share[:, 0] <= 1) & ((apart <= MAX_GAP_S * 1e9) | exact)
        a, b = self.rotation[before], self.rotation[after]
        b = np.where((a * b).sum(axis=1, keepdims=True) < 0, -b, b)
        mixed = (1 - share) * a + share * b  # samples are near each other: on the short arc this is the rotation
        return PosesAt(
            there,
            (1 - share) * self.position_m[before] + share * self.position_m[after],
            mixed / np.maximum(np.linalg.norm(mixed, axis=1, keepdims=True), 1e-12),
        )


def pose_track_of(poses: Poses, chosen: Bool | None = None) -> PoseTrack | None:
    """The samples of one pose in order; of several at one instant the first. None: there is none."""
    rows = np.arange(len(poses.stamp_ns)) if chosen is None else np.flatnonzero(chosen)
    if not len(rows):
        return None
    stamps, first = np.unique(poses.stamp_ns[rows], return_index=True)
    rows = rows[first]
    return PoseTrack(
        poses.frame[rows[0]], stamps, poses.position_m[rows], poses.rotation[rows], poses.velocity_mps[rows]
    )


@dataclass
class Frames:
    """The tree of frames: of each child its course in its parent."""

    pose_tracks: dict[str, PoseTrack] = field(default_factory=dict)
    static: set[str] = field(default_factory=set)

    def add(self, poses: Poses, *, static: bool = False) -> None:
        """Take in transforms; a frame that has a parent already keeps it."""
        children = np.array(poses.child, dtype=object)
        for child in dict.fromkeys(poses.child):
            if not child or child in self.pose_tracks:
                continue
            course = pose_track_of(poses, np.asarray(children == child))
            if course is not None and course.parent != child:
                self.pose_tracks[child] = course
                if static:
                    self.static.add(child)

    def chain(self, frame: str) -> list[str]:
        """From a frame up to its root, both included; a circle ends where it began."""
        found = [frame]
        while found[-1] in self.pose_tracks and self.pose_tracks[found[-1]].parent not in found:
            found.append(self.pose_tracks[found[-1]].parent)
        return found

    def world_of(self, frame: str) -> str:
        """The frame that stands still: the outermost one that `frame` moves in, else `frame` itself."""
        chain = self.chain(frame)
        moving = [k for k, name in enumerate(chain[:-1]) if not self._stands(name)]
        return chain[moving[-1] + 1] if moving else frame

    def place(self, frame: str, world: str, stamp_ns: Int) -> PosesAt | None:
        """Where `frame` lies in `world` at instants (K,); None: the recording does not say."""
        up, down = self.chain(frame), self.chain(world)
        common = next((name for name in up if name in down), None)
        if common is None:
            return None
        here, there = (self._climb(chain[: chain.index(common)], stamp_ns) for chain in (up, down))
        turn = back(there.rotation)
        return PosesAt(
            here.there & there.there,
            turned(turn, here.position_m - there.position_m),
            combined(turn, here.rotation),
        )

    def _climb(self, steps: Iterable[str], stamp_ns: Int) -> PosesAt:
        """The pose of the first of `steps` in the parent of the last."""
        known = np.ones(len(stamp_ns), dtype=bool)
        position, rotation = np.zeros((len(stamp_ns), 3)), np.tile([0.0, 0.0, 0.0, 1.0], (len(stamp_ns), 1))
        for name in steps:
            step = self.pose_tracks[name].at(stamp_ns, forever=self._stands(name))
            position = turned(step.rotation, position) + step.position_m
            rotation = combined(step.rotation, rotation)
            known &= step.there
        return PosesAt(known, position, rotation)

    def _stands(self, child: str) -> bool:
        return child in self.static or len(self.pose_tracks[child].stamp_ns) == 1
