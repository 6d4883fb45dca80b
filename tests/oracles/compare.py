"""Figures of `compare` straight from pairs of rows, one by one: nothing is counted together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

Row = dict[str, Any]
Pair = tuple[Row, Row]
HORIZON_S = 10.0


def pairs(rows: Sequence[Row], first: str, second: str) -> list[Pair]:
    """Rows of the same log, object and run."""

    def of(configuration: str) -> dict[tuple[object, ...], Row]:
        mine = (row for row in rows if row["configuration"] == configuration)
        return {(row["log"], row["object_id"], row["run"]): row for row in mine}

    one, other = of(first), of(second)
    return [(one[key], other[key]) for key in one if key in other]


def share(found: Sequence[Pair], succeeded: str) -> tuple[float, float, float]:
    values = [sum(bool(pair[side][succeeded]) for pair in found) / len(found) for side in (0, 1)]
    return values[0], values[1], values[0] - values[1]


def restricted_means(found: Sequence[Pair]) -> tuple[float, float, float]:
    values = [_restricted_mean([pair[side] for pair in found]) for side in (0, 1)]
    return values[0], values[1], values[0] - values[1]


def _restricted_mean(rows: Sequence[Row]) -> float:
    """The horizon less the area under the incidence: at each time survival times the share that is detected."""
    ends = []
    for row in rows:
        end_s = row["detection_s"] if row["detected"] else row["ended_s"]
        ends.append((end_s - row["onset_s"], "seen" if row["detected"] else row["ended_by"]))
    survival, area = 1.0, 0.0
    for time_s in sorted({time_s for time_s, _ in ends}):
        at_risk = sum(end_s >= time_s for end_s, _ in ends)
        seen, left = (ends.count((time_s, why)) for why in ("seen", "object_left"))
        area += survival * seen / at_risk * max(HORIZON_S - time_s, 0.0)
        survival *= 1 - (seen + left) / at_risk
    return HORIZON_S - area


def medians(found: Sequence[Pair]) -> tuple[float, float, float] | None:
    """Of both sides, and of their differences; None: no pair has both."""
    away = [(*both, 0.0 if both[0] == both[1] else both[0] - both[1]) for both in distances(found)]
    if not away:
        return None
    first, second, difference = (sorted(of)[(len(of) - 1) // 2] for of in zip(*away, strict=True))
    return first, second, difference


def distances(found: Sequence[Pair]) -> list[tuple[float, float]]:
    """Of both sides, where they are known; never detected is below every distance."""
    both = (
        tuple(row["distance_at_detection_m"] if row["detected"] else float("-inf") for row in pair) for pair in found
    )
    return [(one, other) for one, other in both if one is not None and other is not None]


FRAMES_S = (0.0, 1.0, 2.0, 3.0)
MAX_AGE_S = 1.0


def shared_frames(pair: Pair, instants: dict[str, Sequence[float]]) -> Iterator[tuple[float, int]]:
    """Frames of the object of a pair from which on both sides have issued a list, and their places in its columns."""
    begins_s = max(min(instants[row["configuration"]]) for row in pair)
    for k in range(len(pair[0]["error_held_m"])):
        frame_s = FRAMES_S[pair[0]["first_frame"] + k]
        if frame_s >= begins_s:
            yield frame_s, k


def position_rmse(found: Sequence[Pair], instants: dict[str, Sequence[float]]) -> tuple[list[float] | None, int]:
    """Of both sides, and over how many pairs of object and frame."""
    both = [tuple(row["error_held_m"][k] for row in pair) for pair in found for _, k in shared_frames(pair, instants)]
    errors = [one for one in both if None not in one]
    if not errors:
        return None, 0
    return [(sum(one[side] ** 2 for one in errors) / len(errors)) ** 0.5 for side in (0, 1)], len(errors)


def gospa(found: Sequence[Pair], instants: dict[str, Sequence[float]]) -> tuple[list[float] | None, int]:
    sums, frames = [0.0, 0.0], set()
    for pair in found:
        for frame_s, k in shared_frames(pair, instants):
            parts = [row["gospa_held_m2"][k] for row in pair]
            if None not in parts:
                sums = [so_far + part for so_far, part in zip(sums, parts, strict=True)]
                frames.add((pair[0]["log"], pair[0]["run"], frame_s))
    return ([(of / len(frames)) ** 0.5 for of in sums], len(frames)) if frames else (None, 0)


def beside_held(found: Sequence[Pair], instants: dict[str, Sequence[float]]) -> dict[str, float]:
    """What a comparison says beside the errors of what is held."""
    frames, only, ages = set(), [0, 0], []
    for pair in found:
        for frame_s, k in shared_frames(pair, instants):
            listed = [row["error_held_m"][k] is not None for row in pair]
            only = [
                count + (listed == alone) for count, alone in zip(only, ([True, False], [False, True]), strict=True)
            ]
            if all(listed):
                ages.append([row["age_held_s"][k] for row in pair])
            if pair[0]["gospa_held_m2"][k] is not None:
                frames.add((pair[0]["log"], pair[0]["run"], frame_s))
    said: dict[str, float] = {"frames": len(frames), "only_configuration": only[0], "only_baseline": only[1]}
    for side, (prefix, name) in enumerate((("", "late"), ("baseline_", "ideal"))):
        said[f"{prefix}age_s"] = sum(age[side] for age in ages) / len(ages) if ages else float("nan")
        newest_s = {t: max(since_s for since_s in instants[name] if since_s <= t) for _, _, t in frames}
        without = [t for _, _, t in frames if t - newest_s[t] > MAX_AGE_S]
        said[f"{prefix}no_list_share"] = len(without) / len(frames) if frames else float("nan")
    return said


def ghosts_per_min(lists: Sequence[Row], first: str, second: str) -> list[float]:
    both = [[row for row in lists if row["configuration"] == name] for name in (first, second)]
    return [sum(row["ghosts"] for row in of) / sum(row["minutes"] for row in of) for of in both]
