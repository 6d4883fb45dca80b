"""The file: everything put together, complete under its name or not there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

import pandas as pd

from copem_replay.believe import by_truth
from copem_replay.colours import Rgb, configuration_colours
from copem_replay.experiment import Experiment
from copem_replay.fusion.belief import Belief
from copem_replay.replay import Replay
from copem_replay.show import knowledge, layout, marks, plots, units, words, world
from copem_replay.show.eye import eye_on, follow
from copem_replay.show.out import Out, digest, part_of
from copem_replay.show.sight import sight
from copem_replay.show.status import status_of
from copem_replay.show.stream import Live, file_stream
from copem_replay.tracks import TRUTH

SHOWN_OBJECTS = 6
"""Of how many measured objects words, lines, lanes and plots tell (chosen)."""
VIEWED = 6
"""How many configurations are shown: more views than this are too small to see anything (chosen)."""


def write_rrd(
    path: Path,
    replay: Replay,
    experiment: Experiment,
    beliefs: Mapping[str, Belief],
    table: pd.DataFrame,
    summary: pd.DataFrame,
    run: int,
    viewer: str | None = None,
) -> list[str]:
    """Write one run of one log, and send it to a viewer, too. Returns what has to be said. Raises OutputError.

    `beliefs`: per configuration what the receiver believes in this run, a frame per list it issued (one unit, values
    (1, P)). `table`: the rows of `detections.parquet` of this log and run. `summary`: of all logs and runs.
    """
    import rerun as rr

    chosen = viewed(experiment, list(beliefs))
    left_out = [name for name in beliefs if name not in chosen]
    of_chosen = table["configuration"].isin(chosen)
    truths = [name for name in chosen if experiment.configurations[name].units == TRUTH]
    shown = [replay.scene.object_number[name] for name in telling(table[of_chosen], truths, SHOWN_OBJECTS)]
    eye = eye_on(replay, experiment, table, layout.aspect(len(chosen)))
    blueprint, appearance = layout.blueprint(replay, experiment, table, chosen, shown, eye)
    ids = f"copem_replay:{appearance}", digest(experiment.model_dump_json(), replay.scene.log, str(run))
    strict = rr.strict_mode()
    rr.set_strict_mode(True)  # else a column that does not fit is left out with a warning
    every = configuration_colours(beliefs)  # as in the MCAP, which has all of them
    colours = {name: every[name] for name in chosen}
    live = None
    try:
        with file_stream(path, *ids) as rec:
            live = Live(viewer, *ids) if viewer is not None else None
            out = Out(rec, replay.scene.t0_ns, live)
            rec.send_blueprint(blueprint, make_active=False)  # whoever has changed the layout keeps it
            if live is not None:
                live.send(lambda rec: rec.send_blueprint(blueprint, make_active=True))  # else it makes up its own
            follow(out, replay, experiment, eye)
            _fill(
                out,
                replay,
                experiment,
                {name: beliefs[name] for name in chosen},
                table[of_chosen],
                summary,
                run,
                shown,
                left_out,
                colours,
            )
    finally:
        rr.set_strict_mode(strict)
        if live is not None:
            live.close()
    said = [f"{path.name}: without {', '.join(left_out)}; `show: {{configurations: […]}}` chooses up to {VIEWED}"]
    gone = [f"{path.name}: the viewer at {viewer} went before it had everything; the file is complete"]
    return (said if left_out else []) + (gone if live is not None and live.gone else [])


def viewed(experiment: Experiment, configurations: Sequence[str]) -> list[str]:
    """Which configurations are shown, in their order: all, or the baselines (the truth, ideal fusion) before others."""
    if len(configurations) <= VIEWED:
        return list(configurations)
    baselines = [name for name in configurations if by_truth(experiment.configurations[name])]
    # Half of the views at most, so that there is something to compare with them.
    others = [name for name in configurations if name not in baselines]
    first = [*baselines[: max(VIEWED // 2, VIEWED - len(others))], *others][:VIEWED]
    return [name for name in configurations if name in first]


def telling(table: pd.DataFrame, baselines: Sequence[str], most: int) -> list[str]:
    """Ids of the objects that tell configurations apart: in conflict with the ego, known at different times, late.

    In the table's order. Never known counts as known when the look ended; `baselines` don't count beside others.
    """
    others = table[~table["configuration"].isin(baselines)]
    looks = others if len(others) else table
    time_s = looks["time_to_detection_s"].fillna(looks["ended_s"] - looks["onset_s"])
    of_each = time_s.groupby(looks["object_id"], sort=False)
    conflict = looks["conflict"] if "conflict" in looks else pd.Series(False, index=looks.index)
    rank = pd.DataFrame(
        {
            "conflict": conflict.fillna(False).astype(bool).groupby(looks["object_id"], sort=False).any(),
            "apart": of_each.max() - of_each.min(),
            "late": of_each.max(),
        }
    )
    rank = rank.loc[list(dict.fromkeys(looks["object_id"]))]
    chosen = set(rank.sort_values(["conflict", "apart", "late"], ascending=False, kind="stable").index[:most])
    return [name for name in dict.fromkeys(table["object_id"]) if name in chosen]


def _fill(
    out: Out, replay: Replay, experiment: Experiment, beliefs: Mapping[str, Belief], table: pd.DataFrame,
    summary: pd.DataFrame, run: int, shown: Sequence[int], left_out: Sequence[str],
    colours: Mapping[str, Rgb],
) -> None:  # fmt: skip
    import rerun as rr

    scene = replay.scene
    _properties(out, replay, experiment, list(beliefs), run)
    out.static([], rr.ViewCoordinates.RIGHT_HAND_Z_UP, world.names_and_colours(scene))
    words.differences(out, replay, table, shown, left_out)
    words.summary(out, replay, experiment, summary, run, left_out)
    words.legend(out)
    words.onsets(out, scene, table)
    world.statics(out, replay.found.static)
    units.units(out, replay, experiment)
    marks.onsets(out, replay, experiment, table, shown)
    world.truth(out, scene, replay.truth, shown)
    seen = sight(replay, experiment, shown)
    made = {}
    for name, colour in colours.items():
        words.events(out, scene, name, table[table["configuration"] == name])
        marks.detections(out, replay, experiment, table, name, shown, colour)
        made[name] = status_of(replay, experiment, name, beliefs[name], seen)
        knowledge.words(out, name, replay, experiment, seen, made[name])
        knowledge.hiding(out, name, seen, made[name])
        asked = experiment.configurations[name]
        knowledge.listings(out, name, replay, experiment, asked, beliefs[name], seen, colour)
        world.believed(out, ["world", part_of(name)], scene, beliefs[name], colour)
        plots.position_errors(out, replay, experiment, name, beliefs[name].fused, shown, colour)
        if len(replay.looks.object_ix):
            plots.gospas(out, replay, experiment, name, beliefs[name], colour)
    knowledge.lanes(out, scene, seen, made, colours)
    for k in shown:
        curves = plots.share_curves(replay, experiment, k)
        plots.visible_share(out, scene.object_ids[k], curves)
        marks.on_curves(out, replay, experiment, table, scene.object_ids[k], curves, colours)
    if len(replay.looks.object_ix):
        plots.known(out, replay, {name: belief.fused for name, belief in beliefs.items()}, colours)


def _properties(out: Out, replay: Replay, experiment: Experiment, configurations: list[str], run: int) -> None:
    import rerun as rr

    out.send(lambda rec: rec.send_recording_name(f"{replay.scene.log}: run {run}"))
    out.send(lambda rec: rec.send_recording_start_time_nanos(replay.scene.t0_ns))
    values = rr.AnyValues(
        log=replay.scene.log,
        run=run,
        seed=experiment.seed,
        visibility=experiment.visibility,
        configurations=configurations,
        copem_replay=version("copem-replay"),
        rerun_sdk=version("rerun-sdk"),
    )
    out.send(lambda rec: rec.send_property("replay", values))
