"""What tells whether two recordings are of the same drive: their truth, whatever else is in them, and in which file."""

from __future__ import annotations

import hashlib
import json

import numpy as np

from copem_replay.core.tracks import VALUES, Scene, Tracks


def truth_digest(scene: Scene, truth: Tracks) -> str:
    """SHA-256 of the truth: objects by id, their classes and states to the last bit, the ego, the span of time, solids.

    Nothing of it depends on the file, the topic, or the order in which the recording has its objects.
    """
    digest = hashlib.sha256()
    ego = scene.object_ids[scene.ego_ix] if scene.ego_ix >= 0 else None
    digest.update(json.dumps([scene.t0_ns, scene.end_ns, ego]).encode())
    track_of = {int(object_ix): track for track, object_ix in enumerate(truth.object_ix)}
    for object_ix in sorted(track_of, key=lambda k: scene.object_ids[k]):
        track = track_of[object_ix]
        rows = slice(int(truth.start[track]), int(truth.start[track + 1]))
        said = [scene.object_ids[object_ix], int(scene.object_class[object_ix]), bool(scene.moving[object_ix])]
        digest.update(json.dumps([*said, rows.stop - rows.start]).encode())
        digest.update(truth.stamp_ns[truth.frame_ix[rows]].astype("<i8").tobytes())
        for name in VALUES:
            digest.update((np.asarray(getattr(truth, name)[0, rows], dtype="<f8") + 0.0).tobytes())  # no −0
    if scene.solids:
        digest.update(json.dumps(sorted(scene.solids)).encode())
    return digest.hexdigest()
