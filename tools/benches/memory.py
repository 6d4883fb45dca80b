"""What memory costs: numbers that last against new ones, and the crossing with and without it.

Medians of nine calls each, in turn, in seconds of the processor: one thread works, and what else the machine does is
not counted.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from benches import common
from copem_replay.core.lasting import ListStamps, draw_correlated_normals, draw_held_uniforms
from copem_replay.core.random import CounterRng, RandomKey, object_words
from copem_replay.experiment.schema import Experiment
from copem_replay.pipeline.run import run_experiment

LISTS, OBJECTS, RUNS, STEP_NS = 600, 20, 50, 100_000_000
"""One unit at 10 Hz, a minute."""


def memory() -> Iterator[common.Line]:
    """Numbers that last, and the crossing with all memory on."""
    yield numbers()
    experiment, recordings = common.loaded("crossing")
    plain = experiment.model_copy(update={"runs": 2, "show": None})
    lasting = remembering(plain)
    took = common.interleaved([lambda: run_experiment(plain, recordings), lambda: run_experiment(lasting, recordings)])
    yield {"memory_crossing_ratio": round(took[1] / took[0], 3), "seconds": round(took[1], 3)}


def numbers() -> common.Line:
    stamps = 1_700_000_000_000_000_000 + np.arange(LISTS) * STEP_NS
    none = np.zeros(LISTS, dtype=np.int64)
    words = np.repeat(object_words([str(k) for k in range(OBJECTS)]), LISTS)
    random_key = RandomKey(("u",), np.tile(none, OBJECTS), words, np.tile(stamps, OBJECTS))
    lists = ListStamps(stamps, none, np.tile(np.arange(LISTS), OBJECTS))
    rng, runs = CounterRng(1, "bench"), np.arange(RUNS)
    uniform, slow, quick, normal, drifts = common.interleaved([
        lambda: rng.uniform("p", random_key, runs),
        lambda: draw_held_uniforms(rng, "p", random_key, runs, 1.0),
        lambda: draw_held_uniforms(rng, "p", random_key, runs, 0.5),
        lambda: rng.normal("p", random_key, runs),
        lambda: draw_correlated_normals(rng, "p", random_key, runs, 1.0, lists=lists),
    ])  # fmt: skip
    return {
        "memory_held_ratio_at_0.1": round(slow / uniform, 2),
        "memory_held_ratio_at_0.2": round(quick / uniform, 2),
        "memory_drifting_ratio": round(drifts / normal, 2),
        "uniform_ns": round(uniform / len(words) / RUNS * 1e9, 2),
        "normal_ns": round(normal / len(words) / RUNS * 1e9, 2),
    }


def remembering(experiment: Experiment) -> Experiment:
    """The same with all that its PEMs draw lasting: detection held, errors drifting with a bias."""
    data = experiment.as_written()
    errors = [{"share": 0.7, "correlation_s": 1.0}, {"share": 0.3, "correlation_s": "always"}]
    lasts = {"detection": [{"share": 0.6, "correlation_s": 0.8}], **dict.fromkeys(("position", "speed"), errors)}
    data["pems"] = {name: {"couples": couples, "memory": lasts} for name, couples in data["pems"].items()}
    return Experiment.model_validate(data)
