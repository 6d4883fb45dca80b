"""What drawn arrivals cost: a minute of 20 objects, five units at 10 Hz, by a link that is sure and by one that is not.

Medians of nine runs of all, in turn, in seconds of the processor, of which the constant latency's are taken away.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

from benches import common
from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import Recording, read_log
from copem_replay.pipeline.prepare import Replay, prepare_log
from copem_replay.pipeline.run import run_experiment

RUNS = 20
LINKS: dict[str, dict[str, Any]] = {
    "constant": {"latency": 0.06},
    "drawn": {
        "latency": {"kind": "gamma", "min_s": 0.02, "mean_s": 0.06, "shape": 2},
        "reception": {"kind": "shadowing", "half_at_m": 150, "exponent": 2.27, "sigma_db": 3, "blocked_db": 9},
        "memory": {"reception": [{"share": 1.0, "correlation_s": 0.5}]},
        "order": "kept",
    },
}


KINDS = (("ideal", False), ("ideal", True), ("gnn", False), ("gnn", True), ("tracker", False), ("tracker", True))


def by_fusion(recording: Recording) -> Iterator[common.Line]:
    """A line for each fusion, with accuracy and without."""
    for fusion, accuracy in KINDS:
        plans = [plan(link, fusion, accuracy) for link in LINKS.values()]
        ready = [prepare_log(recording, one) for one in plans]

        def replayed(experiment: Experiment, replay: Replay) -> None:
            vars(replay).pop("kept_draws", None)  # what links drew is of the call before
            run_experiment(experiment, [recording], ready=[replay])

        constant_s, drawn_s = common.interleaved(
            [partial(replayed, one, its) for one, its in zip(plans, ready, strict=True)]
        )
        yield {
            "links": fusion + (" with accuracy" if accuracy else ""),
            "constant_ms_a_run": round(constant_s / RUNS * 1e3, 2),
            "drawn_ms_a_run": round(drawn_s / RUNS * 1e3, 2),
            "more_ms_a_run": round((drawn_s - constant_s) / RUNS * 1e3, 2),
        }


def plan(link: dict[str, Any], fusion: str, accuracy: bool) -> Experiment:
    """Five units carried by the first objects, all 20 objects seen all around."""
    return Experiment.model_validate({
        "version": 1, "logs": ["minute.mcap"], "ego": 0, "runs": RUNS, "seed": 1, "show": None,
        "pems": {"around": [{"detection": {"kind": "visible_share"},
                             "error": {"kind": "gaussian", "covariance_m2": [[0.25, 0.0], [0.0, 0.25]]}}]},
        "units": {f"u{k}": {"on": k, "height_m": 1.8, "pem": "around", "rate_hz": 10} for k in range(5)},
        "links": {"v2x": link},
        "configurations": {"coop": {"units": "all", "link": "v2x", "issue_hz": 10, "fusion": {"kind": fusion}}},
        "measure": {"accuracy": accuracy},
    })  # fmt: skip


def links() -> Iterator[common.Line]:
    """A minute of 20 objects, five of which send what they see by radio: what it costs that arrivals are drawn."""
    with common.scratch() as folder:
        common.write_truth(folder / "minute.mcap", common.boxes(600, 20))
        yield from by_fusion(read_log(folder / "minute.mcap", name="minute", ego="0"))
