"""What a receiver holds, and the truth, as input of other tools: TrackEval (MOTChallenge), nuScenes tracking results.

Of one run. *Instants* are the frames of the truth, thinned to ten a second. At each, a configuration holds the newest
list that is available by then. *Truth* are the measured objects from the onset to the end of their episodes, which is
what all metrics are of; entries about other objects, or about these at other times, are left out, ghosts are not.
Identities are those of the fusion; fusions by truth id have the object's, entries without any are new each time.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

import numpy as np
import pandas as pd

from copem_replay.core.errors import InputError, count_noun
from copem_replay.core.files import avoid_device_name
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import CLASSES, SAME_INSTANT_S, Float, Int, Scene, Tracks
from copem_replay.metrics.accuracy.held import find_newest_lists, thin_frames
from copem_replay.results.again import replay_again
from copem_replay.results.outputs import made_files
from copem_replay.results.read import Results, open_results

BENCHMARK: Final = "copem"
"""TrackEval looks for `gt/copem-all` and `trackers/copem-all`."""
TRUTH_FILE: Final = "truth.json"
TRACKING_NAMES: Final = {
    "bicycle": "bicycle",
    "bus": "bus",
    "car": "car",
    "motorcycle": "motorcycle",
    "pedestrian": "pedestrian",
    "trailer": "trailer",
    "truck": "truck",
    "van": "car",
    "vehicle": "car",
}
"""nuScenes' names of classes in tracking, by class; it has none for others, and its cars include vans."""
_SET: Final = f"{BENCHMARK}-all"
_VALUES: Final = ("x_m", "y_m", "z_m", "yaw_rad", "vx_mps", "vy_mps", "length_m", "width_m", "height_m")


@dataclass(frozen=True)
class TrackedRun:
    """A run of a log at its instants (G,): tables of states, with `frame` (from 0), `identity`, class and state."""

    log: str
    stamps_ns: Int  # (G,)
    truth: pd.DataFrame
    held: dict[str, pd.DataFrame]  # by configuration


def write_trackeval(
    results: Results | Path, out: Path | None = None, *, run: int | None = None
) -> tuple[list[Path], list[str]]:
    """Write one run of every log as input of TrackEval: paths of the files, and notes.

    Boxes are the smallest upright rectangles around footprints, in metres: left and top are the least x and y. All
    have class 1, pedestrian to TrackEval, which scores no other. `out`: None: `trackeval` in the results folder.
    `run`: None: the one shown. Raises InputError, OutputError.
    """
    results = results if isinstance(results, Results) else open_results(results)
    folder, texts = out or results.place / "trackeval", dict[str, str]()
    logs = list[str]()
    for tracked in _track_logs(results, run):
        log = _name_file(tracked.log)
        logs.append(log)
        texts[f"gt/{_SET}/{log}/gt/gt.txt"] = _write_mot(tracked.truth, truth=True)
        texts[f"gt/{_SET}/{log}/seqinfo.ini"] = f"[Sequence]\nname={log}\nseqLength={len(tracked.stamps_ns)}\n"
        for name, held in tracked.held.items():
            texts[f"trackers/{_SET}/{_name_file(name)}/data/{log}.txt"] = _write_mot(held, truth=False)
    texts[f"gt/seqmaps/{_SET}.txt"] = "".join(f"{line}\n" for line in ("name", *logs))
    return _write_texts(results, folder, texts), []


def write_nuscenes(
    results: Results | Path, out: Path | None = None, *, run: int | None = None
) -> tuple[list[Path], list[str]]:
    """Write one run of all logs as nuScenes tracking results: `truth.json`, and a file per configuration; notes.

    Samples are `<log>:<nanoseconds>`. `out`: None: `nuscenes` in the results folder. `run`: None: the one shown. Raises
    InputError, OutputError.
    """
    results = results if isinstance(results, Results) else open_results(results)
    folder, of_file, unnamed = out or results.place / "nuscenes", dict[str, dict[str, list[Any]]](), Counter[str]()
    for tracked in _track_logs(results, run):
        samples = [f"{tracked.log}:{stamp_ns}" for stamp_ns in tracked.stamps_ns.tolist()]
        for name, table in {TRUTH_FILE: tracked.truth, **tracked.held}.items():
            file = name if name == TRUTH_FILE else f"{_name_file(name)}.json"
            if file == TRUTH_FILE and name != TRUTH_FILE:
                raise InputError(f"configuration {name}: expected another name, found that of the file of the truth")
            boxes = of_file.setdefault(file, {})
            boxes |= {sample: [] for sample in samples}
            for row in table.to_dict("records"):
                if row["object_class"] not in TRACKING_NAMES:
                    unnamed[row["object_class"]] += 1
                    continue
                sample = samples[row["frame"]]
                boxes[sample].append(_describe_box(row, sample))
    meta = {f"use_{name}": False for name in ("camera", "lidar", "radar", "map")} | {"use_external": True}
    texts = {file: json.dumps({"meta": meta, "results": boxes}) + "\n" for file, boxes in of_file.items()}
    notes = [
        f"{count_noun(n, 'box', 'boxes')} of class {name} left out: nuScenes tracks none" for name, n in unnamed.items()
    ]
    return _write_texts(results, folder, texts), notes


def _write_texts(results: Results, folder: Path, texts: dict[str, str]) -> list[Path]:
    """Write texts by their paths in a folder; the files of one folder change in one step."""
    files = [folder / name for name in texts]
    for place in dict.fromkeys(file.parent for file in files):
        here = {file.name: text for file, text in zip(files, texts.values(), strict=True) if file.parent == place}
        with made_files(place, list(here), results.place) as scratch:
            for name, text in here.items():
                (scratch / name).write_text(text, encoding="utf-8")
    return files


def _name_file(name: str) -> str:
    """A name as that of a file or folder; TrackEval reads no commas in those of logs."""
    return avoid_device_name(quote(name, safe=" +="))


def _write_mot(table: pd.DataFrame, *, truth: bool) -> str:
    """Lines `frame,id,left,top,width,height,confidence,…` of MOTChallenge; frames and ids count from 1."""
    lines, numbers = [], dict[str, int]()
    for row in table.to_dict("records"):
        cos, sin = abs(math.cos(row["yaw_rad"])), abs(math.sin(row["yaw_rad"]))
        width = cos * row["length_m"] + sin * row["width_m"]
        height = sin * row["length_m"] + cos * row["width_m"]
        number = numbers.setdefault(row["identity"], len(numbers) + 1)
        box = ",".join(f"{v:.6f}" for v in (row["x_m"] - width / 2, row["y_m"] - height / 2, width, height))
        last = "1,1,1" if truth else f"{row['score']:.6f},-1,-1,-1"
        lines.append(f"{row['frame'] + 1},{number},{box},{last}\n")
    return "".join(lines)


def _describe_box(row: dict[str, Any], sample: str) -> dict[str, Any]:
    """One box as nuScenes has it in tracking results; `sample`: the token of its frame."""
    half = row["yaw_rad"] / 2
    return {
        "sample_token": sample,
        "translation": [row["x_m"], row["y_m"], row["z_m"]],
        "size": [row["width_m"], row["length_m"], row["height_m"]],
        "rotation": [math.cos(half), 0.0, 0.0, math.sin(half)],
        "velocity": [row["vx_mps"], row["vy_mps"]],
        "tracking_id": str(row["identity"]),
        "tracking_name": TRACKING_NAMES[row["object_class"]],
        "tracking_score": row["score"],
    }


# What is held at each instant.


def _track_logs(results: Results, run: int | None) -> Iterator[TrackedRun]:
    """One run of every log. Raises InputError for a run that there is not."""
    if run is not None and not 0 <= run < results.experiment.runs:
        raise InputError(f"--run: expected 0 to {results.experiment.runs - 1}, found {run}")
    for log in results.provenance.logs:
        number = run if run is not None else results.provenance.run_shown.get(log.name, 0)
        yield collect_held(results, log.name, number)


def collect_held(results: Results, log: str, run: int) -> TrackedRun:
    """What every configuration holds in one run of a log, and the truth. Raises InputError."""
    replayed, rows = replay_again(results, log, run, tuple(results.experiment.configurations))
    scene, truth = replayed.replay.scene, replayed.replay.truth
    frame_s = thin_frames(truth.captured_s)
    frame_ix = np.searchsorted(truth.captured_s, frame_s)
    episodes = rows[["object_id", "onset_s", "ended_s"]].drop_duplicates()
    spans = [
        (scene.object_number[str(name)], onset_s, ended_s)
        for name, onset_s, ended_s in episodes.itertuples(index=False)
    ]
    configurations = replayed.experiment.configurations
    held = {
        name: _take_held(fused, scene, frame_s, spans, configurations[name].max_age_s)
        for name, fused in replayed.run_tracks.whole().items()
    }
    return TrackedRun(log, truth.stamp_ns[frame_ix], _take_truth(truth, scene, frame_s, frame_ix, spans), held)


def _take_truth(
    truth: Tracks, scene: Scene, frame_s: Float, frame_ix: Int, spans: Sequence[tuple[int, float, float]]
) -> pd.DataFrame:
    """A table of the measured objects' states at the frames `frame_ix (G,)`, within their `spans` (s)."""
    order, bounds = truth.by_frame
    rows = [order[bounds[frame] : bounds[frame + 1]] for frame in frame_ix.tolist()]
    frames = np.repeat(np.arange(len(frame_ix)), [len(of) for of in rows])
    truth_rows = np.concatenate([np.zeros(0, dtype=np.int64), *rows])
    is_counted = truth.valid[0, truth_rows] & _is_measured(truth.row_object_ix[truth_rows], frame_s[frames], spans)
    truth_rows, frames = truth_rows[is_counted], frames[is_counted]
    objects = truth.row_object_ix[truth_rows]
    identity = [scene.object_ids[k] for k in objects.tolist()]
    return _make_table(truth, truth_rows, frames, identity, scene.object_class[objects], np.ones(len(truth_rows)))


def _take_held(
    fused: FusedTracks, scene: Scene, frame_s: Float, spans: Sequence[tuple[int, float, float]], oldest_s: float
) -> pd.DataFrame:
    """A table of the list held at each instant (up to `oldest_s` old): entries about a measured object or none."""
    tracks, (rows, bounds) = fused.fused, fused.listed_rows
    issue_s = tracks.common_arrives_s
    order = np.argsort(issue_s, kind="stable")
    newest, is_fresh = find_newest_lists(issue_s[order], frame_s, oldest_s)
    lists = np.where((newest >= 0) & is_fresh, order[newest] if len(order) else -1, -1)
    rows_by_frame = [rows[bounds[k] : bounds[k + 1]] if k >= 0 else rows[:0] for k in lists.tolist()]
    frames = np.repeat(np.arange(len(frame_s)), [len(of) for of in rows_by_frame])
    flat = np.concatenate([np.zeros(0, dtype=np.int64), *rows_by_frame])
    about = tracks.row_object_ix[flat]
    is_counted = (about < 0) | _is_measured(about, frame_s[frames], spans)
    flat, frames = flat[is_counted], frames[is_counted]
    claims = fused.said
    score = np.ones(len(flat)) if claims is None else np.nan_to_num(claims["existence"][flat], nan=1.0)
    return _make_table(tracks, flat, frames, _name_entries(fused, flat, scene), fused.class_of(scene)[flat], score)


def _name_entries(fused: FusedTracks, flat: Int, scene: Scene) -> list[str]:
    """Identities as the receiver has them; an entry without one is new at each instant."""
    if fused.said is None:
        objects = fused.fused.row_object_ix[flat].tolist()
        return [
            scene.object_ids[k] if k >= 0 else f"ghost:{row}" for k, row in zip(objects, flat.tolist(), strict=True)
        ]
    tracks = np.asarray(fused.said["track_id"])[flat].tolist()
    return [f"track:{track}" if track >= 0 else f"entry:{place}" for place, track in enumerate(tracks)]


def _is_measured(objects: Int, time_s: Float, spans: Sequence[tuple[int, float, float]]) -> Any:
    """Which states are of an object within an episode."""
    counts = np.zeros(len(objects), dtype=bool)
    for number, onset_s, ended_s in spans:
        counts |= (objects == number) & (time_s >= onset_s - SAME_INSTANT_S) & (time_s <= ended_s + SAME_INSTANT_S)
    return counts


def _make_table(
    tracks: Tracks, flat: Int, frames: Int, identity: list[str], classes: Any, score: Float
) -> pd.DataFrame:
    states = {name: getattr(tracks, name)[0, flat] for name in _VALUES}
    names = np.array(CLASSES, dtype=object)[np.asarray(classes, dtype=np.int64)]
    return pd.DataFrame({"frame": frames, "identity": identity, "object_class": names, "score": score, **states})
