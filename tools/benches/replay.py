"""Visible shares, and the replay of the sample scenario."""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import partial

import numpy as np

from benches import common
from copem_replay.perception.visibility import NO_STATICS, Flat, Observers, Surface, make_statics, visible_shares
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.replay import replay_block
from copem_replay.pipeline.run import run_experiment


def visibility() -> Iterator[common.Line]:
    """Views per processor second from 21 units: 60, 250 and 1,000 boxes in a disc of 60 m, and as dense as 60 in it.

    Exponents: of the time of a list, over the number of boxes.
    """
    rng, units, counts = np.random.default_rng(1), 21, (60, 250, 1000)
    place_m = np.column_stack([rng.uniform(-60, 60, (units, 2)), rng.choice([1.8, 5.0], units)])
    for model in (Flat(), Surface()):
        for scene, boxes in (("in_60_m", common.boxes), ("as_dense", common.spread_boxes)):
            rates = []
            for count in counts:
                frames = 12_000 // count
                wider = np.array([np.sqrt(count / 60)] * 2 + [1]) if boxes is common.spread_boxes else 1.0
                places = np.repeat((place_m * wider)[:, None], frames, axis=1)
                observers = Observers(places, np.ones((units, frames), dtype=bool), np.full(units, -1))
                call = partial(visible_shares, boxes(frames, count), NO_STATICS, observers, model)
                [seconds] = common.interleaved([call], 3)
                rates.append(units * frames * count / seconds)
            line = {f"views_per_cpu_s_{count}": round(rate) for count, rate in zip(counts, rates, strict=True)}
            steeper = np.log(rates[0] / rates[-1]) / np.log(counts[-1] / counts[0])
            yield {"visibility": model.kind, "boxes": scene} | line | {"exponent": round(1 + steeper, 2)}


def solids() -> Iterator[common.Line]:
    """Views per processor second from 6 units with 3,600 houses (14,400 edges) around 60 boxes, and with none.

    Units that stand see static bodies as in the list before; those that move look at each again.
    """
    frames, units = 200, 6
    east, north = np.meshgrid(np.arange(60) * 20.0 - 590, np.arange(60) * 20.0 - 590)
    corners = np.stack([east.ravel(), north.ravel()], axis=1)[:, None] + [(0, 0), (8, 0), (8, 8), (0, 8)]
    houses = make_statics(list(corners), np.zeros(len(corners)), np.full(len(corners), 9.0))
    rng = np.random.default_rng(1)
    stands = np.repeat(
        np.column_stack([rng.uniform(-60, 60, (units, 2)), np.full(units, 5.0)])[:, None], frames, axis=1
    )
    moves = stands + np.linspace(0, 1, frames)[None, :, None] * [1, 0, 0]
    for around, static in (("none", NO_STATICS), ("houses", houses)):
        line: common.Line = {"solids": around, "edges": len(static.xy_m)}
        for name, place_m in (("stands", stands), ("moves", moves)):
            observers = Observers(place_m, np.ones((units, frames), dtype=bool), np.full(units, -1))
            call = partial(visible_shares, common.boxes(frames, 60), static, observers, Surface())
            [seconds] = common.interleaved([call], 3)
            line |= {f"views_per_cpu_s_{name}": round(units * frames * 60 / seconds)}
        yield line


def site() -> Iterator[common.Line]:
    """Processor seconds of a run of 20 s of the crossing from 5 units, without a map and with one of 3,000 edges.

    Houses of 8 × 8 m stand in its four quarters, no farther than 200 m from any object, as `within_m` has it.
    """
    experiment = common.cr.load_experiment(common.ROOT / "logs/crossing_units.yaml")
    at_m = [(x, y) for x in range(18, 250, 12) for y in range(18, 250, 12)]
    at_m = [(sx * x, sy * y) for x, y in sorted(at_m, key=lambda at: at[0] ** 2 + at[1] ** 2) for sx, sy in _QUARTERS]
    objects = "".join(
        f'<object id="{k}" type="building" s="{x + 300}" t="{y}" hdg="0" length="8" width="8" height="9"/>'
        for k, (x, y) in enumerate(at_m[:750])
    )
    plan = '<planView><geometry s="0" x="-300" y="0" hdg="0" length="600"><line/></geometry></planView>'
    units = list(experiment.units)[:5]
    only: dict[str, object] = {"configurations": {"all": {"units": units}}, "obstacles": [], "show": None}
    only |= {"window_s": [0.0, 20.0], "units": {name: experiment.as_written()["units"][name] for name in units}}
    with common.scratch() as folder:
        town = folder / "town.xodr"
        town.write_text(f'<OpenDRIVE><road id="1" length="600">{plan}<objects>{objects}</objects></road></OpenDRIVE>')
        for runs in (1, 20):
            calls = []
            for maps in ([], [{"file": str(town), "frame": "same"}]):
                asked = experiment.as_written() | only | {"maps": maps, "runs": runs}
                asked["logs"] = [str(common.ROOT / "logs/crossing.mcap")]
                calls.append(partial(common.cr.run, common.cr.load_experiment(asked), jobs=1))
            without, houses = common.interleaved(calls, 3)
            line = {"cpu_s_without": round(without, 2), "cpu_s_with": round(houses, 2)}
            yield {"site_ratio": round(houses / without, 2), "runs": runs, "units": len(units), "edges": 3000} | line


_QUARTERS = ((1, 1), (-1, 1), (-1, -1), (1, -1))


def paper() -> Iterator[common.Line]:
    """The six configurations × 500 runs of the sample scenario.

    Detections alone, against NumPy drawing as many uniforms × 3; and with measures, verdicts and summary, against the
    time that goes by in the scenario (after reading and compilation, workers as many as cores); most of the work is
    accuracy (RMSE, GOSPA, …).
    """
    experiment, recordings = common.loaded("tc016d")
    listed = experiment.model_copy(update={"braking": None})
    ready, runs = prepare_log(recordings[0], listed), np.arange(experiment.runs)
    rng = np.random.default_rng(1)
    cells = len(ready.measured.tracks.frame_ix) * experiment.runs
    ours = common.best(lambda: replay_block(ready, listed, runs))
    theirs = common.best(lambda: rng.random(3 * cells))
    count = experiment.runs * len(experiment.configurations)
    yield {"paper_draw_ratio": round(ours / theirs, 2), "seconds": round(ours, 4), "runs_per_s": round(count / ours)}
    variants = {
        "": {"exact": False},
        "_with_exact": {"exact": True},
        "_without_accuracy": {"exact": False, "accuracy": False},
    }
    took_s: dict[str, float] = {}
    for name, keys in variants.items():
        whole = experiment.model_copy(update={"measure": experiment.measure.model_copy(update=keys)})
        seconds = common.best(lambda whole=whole: run_experiment(whole, recordings, jobs=os.cpu_count() or 1))
        took_s[name] = seconds
        factor = round(count * recordings[0].scene.end_s / seconds)
        yield {f"paper{name}_realtime_factor": factor, "seconds": round(seconds, 3)}
    yield {"paper_accuracy_cost": round(took_s[""] / took_s["_without_accuracy"], 1)}
