"""Whether a recording can be read: contrast, colours that stay apart, few labels; over all that is in the file.

On the demo, and on the city with 80 road users.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from itertools import combinations, pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from copem_replay.core.colours import TRUTH, configuration_colours
from copem_replay.experiment.schema import Experiment
from copem_replay.io.recording import read_log
from copem_replay.perception.sight import HIDDEN
from copem_replay.pipeline.expansion import resolve_for_run
from copem_replay.pipeline.one_run import tracks_of_run
from copem_replay.pipeline.prepare import prepare_log
from copem_replay.pipeline.replay import replay_block
from copem_replay.pipeline.sight import ABSENT, STEADY_S, smooth_status
from copem_replay.pipeline.status import EARLY, KNOWN, STATUSES
from copem_replay.results.shown_objects import axis_s, choose_shown_objects
from copem_replay.viewer import sink as palette
from copem_replay.viewer import write_rrd
from copem_replay.viewer.camera import camera_following, camera_on_ego
from copem_replay.viewer.curves import break_lines, running_median
from copem_replay.viewer.lanes import _shorten_words, lanes_axis_s
from copem_replay.viewer.sink import entity_names, show_seconds
from tests.helpers.report_pages import named
from tests.helpers.scenes import Thing, recording, standing
from tests.oracles.colour import apart_for_a_deuteranope, ciede2000, contrast, lab, linear
from tests.viewer.test_camera import corners, origins, picture
from tests.viewer.test_rrd import SUMMARY, Made, make, rows, static
from tests.viewer.test_status import lane

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tools"))

import city_traffic  # noqa: E402

MOST_LABELS = 6


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> Made:
    folder = tmp_path_factory.mktemp("city")
    asked = Experiment.model_validate(city_traffic.experiment(city_traffic.write(folder)))
    recording = read_log(folder / "city.mcap", name="city")
    given = resolve_for_run(asked, recording.scene, 1)
    replay = prepare_log(recording, given, onsets_of=asked)
    made = Made(
        folder / "replay.rrd",
        replay,
        given,
        tracks_of_run(replay, given, 1),
        replay_block(replay, given, np.array([1])),
    )

    write_rrd(made.path, replay, given, [made.run_tracks], made.table, SUMMARY, 1)
    return made


# ------------------------------------------------------------------------------- colours


def test_lines_stand_out_from_the_ground() -> None:
    assert max(contrast(half, palette.GROUND) for half in palette.ONSET) >= 3
    assert max(contrast(half, (255, 255, 255)) for half in palette.ONSET) >= 3, "lanes have the ground of the theme"
    lines = {
        "truth": TRUTH, "standing": palette.STANDING, "lane": palette.LANE, "field": palette.FIELD, "ego": palette.EGO,
        "onset": palette.ONSET[0], "difference": palette.DIFFERENCE,
        **configuration_colours(map(str, range(8)), ()),
    }  # fmt: skip
    assert [name for name, colour in lines.items() if contrast(colour, palette.GROUND) < 3] == []


def test_words_of_views_are_read_in_both_themes(city: Made) -> None:
    """On the ground, and on the plate that the viewer puts under words in its light theme, 0.436 of it white."""
    plate = tuple(round(255 * 0.436 + 0.564 * channel) for channel in palette.GROUND)
    found = set()
    for entity, batch in batches(city.path):
        shown = next((name for name in batch.schema.names if name.endswith(":show_labels")), None)
        colours = next((name for name in batch.schema.names if name.endswith(":colors")), None)
        if shown and colours and batch.column(shown).to_pylist()[0] == [True] and not entity.startswith("/legend"):
            found |= {(entity.rsplit("/", 1)[-1], *unpack(c)) for c in batch.column(colours).to_pylist()[0]}
    assert {"status", "status_near", "arrows"} <= {name for name, *_ in found}
    for name, *colour in found:
        assert contrast(colour, palette.GROUND) >= 4.5, name
        assert contrast(colour, plate) >= 4.5, name


def test_words_of_lanes_are_read_in_both_themes(city: Made) -> None:
    """White up to an intensity of 0.6, else black, on 200 of 255 of the colour, the rest ground, as the viewer does."""
    drawn = set()
    for entity, batch in batches(city.path):
        if entity.startswith("/lanes/") and "StateConfiguration:values" in batch.schema.names:
            labels, colours = (batch.column(f"StateConfiguration:{of}").to_pylist()[0] for of in ("labels", "colors"))
            drawn |= {unpack(colour) for label, colour in zip(labels, colours, strict=True) if label.strip()}
    every = {palette.status_colour(KNOWN, colour) for colour in configuration_colours(map(str, range(8)), ()).values()}
    assert len(drawn & every) > 3
    listed = {palette.status_colour(KNOWN - 1, c) for c in configuration_colours(map(str, range(8)), ()).values()}
    for colour in (*drawn, *every, *listed, *palette.STATUS.values()):
        red, green, blue = colour
        bright = 0.299 * red + 0.587 * green + 0.114 * blue > 0.6 * 255
        for ground in (0, 255):
            shown = tuple(round((200 * channel + 55 * ground) / 255) for channel in colour)
            assert contrast(shown, (0, 0, 0) if bright else (255, 255, 255)) >= 4.5, (colour, ground)


def unpack(rgba: int) -> tuple[int, int, int]:
    return rgba >> 24, rgba >> 16 & 255, rgba >> 8 & 255


def test_statuses_stay_apart_for_deuteranopes() -> None:
    neutral = {STATUSES[k]: colour for k, colour in palette.STATUS.items()}
    all_of_them = neutral | {"onset": palette.ONSET[0], "truth": TRUTH, "ground": palette.GROUND}
    near = [
        (a, b) for a, b in combinations(all_of_them, 2) if apart_for_a_deuteranope(all_of_them[a], all_of_them[b]) < 15
    ]
    assert near == []
    for colour in configuration_colours(map(str, range(8)), ()).values():
        listed, known = (palette.status_colour(status, colour) for status in (KNOWN - 1, KNOWN))
        assert apart_for_a_deuteranope(listed, known) >= 15
    # The oracle: black and white are 100 apart, a colour 0 from itself; red and green of one luminance hardly.
    assert apart_for_a_deuteranope((0, 0, 0), (255, 255, 255)) == pytest.approx(100, abs=0.1)
    assert contrast((0, 0, 0), (255, 255, 255)) == pytest.approx(21)
    assert apart_for_a_deuteranope((170, 80, 0), (110, 110, 0)) < 15


def test_what_is_listed_looks_like_no_other_status() -> None:
    """In lanes of both themes, where 200 of 255 of a colour lie on black or white: ΔE2000 of 10 and more."""
    listed = [palette.status_colour(EARLY, c) for c in configuration_colours(map(str, range(8)), ()).values()]
    for ground in (0, 255):
        lanes = {
            colour: lab(linear(tuple(round((200 * channel + 55 * ground) / 255) for channel in colour)))
            for colour in (*listed, *palette.STATUS.values())
        }
        for one, other in product(listed, palette.STATUS.values()):
            assert ciede2000(lanes[one], lanes[other]) >= 10, (one, other, ground)


def test_marks_of_differences_use_no_colour_of_a_configuration() -> None:
    assert palette.DIFFERENCE not in configuration_colours(map(str, range(8)), ()).values()


def test_a_configuration_has_one_colour_everywhere(city: Made) -> None:
    """In boxes, lines, curves, the legend and the figures of the report; in lanes as bright as words ask."""
    from copem_replay.report.figures.style import choose_appearances

    truths = [name for name, asked in city.given.configurations.items() if asked.units == "truth"]
    every = configuration_colours(city.given.configurations, truths)
    beside = [name for name in every if name not in truths]
    looks = choose_appearances(named(list(every), truths))
    figures = {name: tuple(round(255 * c) for c in one.dark) for name, one in looks.items()}
    assert figures == every
    number = {name: r << 16 | g << 8 | b for name, (r, g, b) in every.items()}
    found = defaultdict(set)
    for entity, batch in batches(city.path):
        name = next((name for name in every if f"/world/{name}/boxes" == entity.replace("\\", "")), None)
        if name and "Boxes3D:colors" in batch.schema.names:
            for row in batch.column("Boxes3D:colors").to_pylist():
                found[name] |= {colour >> 8 for colour in row or ()}
        for kind in ("gospa", "known"):
            name = next((name for name in every if f"/plots/{kind}/{name}" == entity.replace("\\", "")), None)
            if name and "SeriesLines:colors" in batch.schema.names:
                found[name] |= {colour >> 8 for colour in batch.column("SeriesLines:colors").to_pylist()[0]}
        if entity == "/legend/bars":
            bars = [colour >> 8 for colour in batch.column("LineStrips2D:colors").to_pylist()[0]]
            assert bars[: len(beside)] == [number[name] for name in beside]
        if entity.startswith("/lanes/") and batch.schema.names and "StateConfiguration:values" in batch.schema.names:
            of = dict(zip(batch.column("StateConfiguration:values").to_pylist()[0],
                          batch.column("StateConfiguration:colors").to_pylist()[0], strict=True))  # fmt: skip
            place = int(entity.rsplit("/", 1)[-1].split("_")[0]) - 1
            known = {colour >> 8 for text, colour in of.items() if "known" in text}
            red, green, blue = palette.status_colour(KNOWN, every[beside[place]])
            assert known <= {red << 16 | green << 8 | blue}
    assert found == {name: {number[name]} for name in beside}


def test_every_ground_is_dark(city: Made) -> None:
    """Of 3-D views and plots, so that a viewer in its light theme does not hide what is bright."""
    from rerun.chunk import RrdReader

    reader = RrdReader(city.path)
    [blueprint] = reader.blueprints()
    kinds: dict[str, str] = {}
    grounds = {}
    for chunk in reader.stream(store=blueprint):
        batch, path = chunk.to_record_batch(), chunk.entity_path
        view = "/".join(path.split("/")[:3])
        if "ViewBlueprint:class_identifier" in batch.schema.names:
            kinds[view] = batch.column("ViewBlueprint:class_identifier")[0].as_py()[0]
        for column in ("Background:color", "PlotBackground:color"):
            if column in batch.schema.names:
                grounds[view] = batch.column(column)[0].as_py()[0] >> 8
    drawn = [view for view, kind in kinds.items() if kind in ("3D", "2D", "TimeSeries")]
    red, green, blue = palette.GROUND
    assert len(drawn) > 20
    assert {grounds.get(view) for view in drawn} == {red << 16 | green << 8 | blue}


# ------------------------------------------------------------------------------- labels


def batches(path: Path) -> list[tuple[str, Any]]:
    from rerun.chunk import RrdReader

    return [(chunk.entity_path, chunk.to_record_batch()) for chunk in RrdReader(path).stream()]


def test_at_most_six_labels_a_view(city: Made) -> None:
    """At every instant, all entities of a view taken together that show labels; whatever the eye looks at."""
    per_frame = np.bincount(city.replay.truth.frame_ix)
    assert per_frame.min() >= 60, "a crowd"
    silent, labelled = set(), defaultdict(list)
    for entity, batch in batches(city.path):
        names = batch.schema.names
        shown = next((n for n in names if n.endswith(":show_labels")), None)
        if shown is not None and batch.column(shown).to_pylist()[0] == [False]:
            silent.add(entity)
        column = next((n for n in names if n.endswith(":labels") and not n.startswith("StateConf")), None)
        if entity.startswith("/world/") and column is not None and "elapsed" in names:
            times = batch.column("elapsed").cast("int64").to_pylist()
            labelled[entity] += list(zip(times, batch.column(column).to_pylist(), strict=True))
        elif entity.startswith("/world/") and column is not None:
            labelled[entity] += [(0, batch.column(column).to_pylist()[0])]
    loud = set(labelled) - silent
    assert {entity.rsplit("/", 1)[-1] for entity in loud} == {"status", "status_near", "arrows"}, "of interest"
    wanted = {city.replay.scene.object_ids[k] for k in range(len(city.replay.scene.object_ids))}
    for entity in loud:
        assert max(len(told or ()) for _, told in labelled[entity]) <= MOST_LABELS
        who = {label.split(" ")[0] for _, told in labelled[entity] for label in told or ()}
        assert who <= wanted
        assert len(who) <= MOST_LABELS
        assert max(len(label) for _, told in labelled[entity] for label in told or ()) <= 30, "short"


def test_words_of_status_are_below_the_boxes_they_name(city: Made) -> None:
    """By projection, around the ego and from near by: below all corners of the box, and not far from it."""
    numbers, truth = city.replay.scene.object_number, city.replay.truth
    shown = choose_shown_objects(city.replay.scene, city.replay.truth, city.given, city.table).object_ix
    episodes = {k: city.table[city.table["object_id"] == city.replay.scene.object_ids[k]] for k in shown}
    stories = {k: axis_s(of, city.replay.scene.end_s) for k, of in episodes.items()}
    around = camera_on_ego(city.replay, city.given, stories, aspect=1.5)
    moving = {round(origin[0], 3): origin for origin in origins(city.path, around)}
    near = {k: camera_following(city.replay, city.given, city.table, k, 1.7) for k in shown}
    beside = {k: origins(city.path, eye, entity_names(city.replay.scene)[k]) for k, eye in near.items()}
    times_s = [round(captured_s, 3) for captured_s in truth.row_captured_s.tolist()]
    row_of = dict(zip(zip(times_s, truth.row_object_ix.tolist(), strict=True), range(len(times_s)), strict=True))
    held = {"status": 0, "status_near": 0}
    for entity in held:
        for told in rows(city.path, f"/world/masts/{entity}"):
            at_s = round(told["elapsed"] / 1e9, 3)
            for place, label in zip(
                told.get("Points3D:positions") or (), told.get("Points3D:labels") or (), strict=True
            ):
                k = numbers[label.split(" ")[0]]
                if (row := row_of.get((at_s, k))) is None:  # between frames of the truth
                    continue
                eye, origin = (around, moving[at_s]) if entity == "status" else (
                    near[k], [origin for origin in beside[k] if origin[0] < at_s + 1e-3][-1]
                )  # fmt: skip
                box, [word] = (picture(eye, origin, at_m) for at_m in (corners(city.replay, row), np.array([place])))
                if np.abs(box).max() > 1:
                    continue
                low, high = box.min(axis=0), box.max(axis=0)
                assert low[1] - 0.1 < word[1] < low[1] + 1e-6, (entity, at_s, label)
                assert low[0] < word[0] < high[0]
                held[entity] += 1
    assert min(held.values()) > 100


def test_paths_of_lanes_and_plots_need_no_escapes(city: Made) -> None:
    paths = {entity for entity, _ in batches(city.path) if entity.startswith("/lanes/")}
    assert len(paths) == 6 * 4
    assert not any("\\" in path or "[" in path for path in paths)
    assert {path.split("/")[2].split("_")[1] for path in paths} <= {"car", "pedestrian"}


def test_words_of_lanes_fit_into_their_spans(city: Made) -> None:
    """In lanes 380 points wide, letters of 7 points and 10 points beside them; the configuration is named first."""
    names = [name for name, asked in city.given.configurations.items() if asked.units != "truth"]
    lanes = defaultdict(list)
    label_of = {}
    for entity, batch in batches(city.path):
        if entity.startswith("/lanes/") and "StateConfiguration:values" in batch.schema.names:
            said = (batch.column(f"StateConfiguration:{kind}").to_pylist()[0] for kind in ("values", "labels"))
            label_of[entity] = dict(zip(*said, strict=True))
        elif entity.startswith("/lanes/"):
            times_s = [time / 1e9 for time in batch.column("elapsed").cast("int64").to_pylist()]
            lanes[entity] += list(zip(times_s, batch.column("StateChange:state").to_pylist(), strict=True))
    assert len(lanes) == 24
    told = 0
    for entity, changes in lanes.items():
        rows = city.table[city.table["object_id"] == entity.split("/")[2].split("_")[0]]
        axis = lanes_axis_s(axis_s(rows, city.replay.scene.end_s), float(rows["onset_s"].iloc[0]), names)
        spans = [
            (max(begin, axis[0]), min(end, axis[1]), state)
            for (begin, state), (end, _) in pairwise([*changes, (axis[1], None)])
            if begin < axis[1] and end > axis[0]
        ]
        shown = [(end - begin, label_of[entity][state[0]].strip()) for begin, end, state in spans if state]
        assert shown[0][1] == names[int(entity.split("/")[3].split("_")[0]) - 1]
        for lasts_s, label in shown:
            assert not label or 7 * len(label) + 10 <= 380 * lasts_s / (axis[1] - axis[0]) + 1e-3, label
        told += len([label for _, label in shown if label])
    assert told > 48, "names, and when each is known"


def test_a_long_name_is_cut_and_not_left_out(tmp_path: Path) -> None:
    """The pedestrian is there from 2 s on: nothing is before the log's start, so there is no room for all letters."""
    names = ["the_first_results:a_configuration_of_the_ego_alone", "the_newer_results:a_configuration_of_the_ego_late"]
    scene = recording(
        [Thing("ego", "car", standing(0, 0)), Thing("2", "pedestrian", standing(20, 0), there=lambda t: t > 1.95)],
        until_s=6.0,
    )
    asked = {name: {"units": ["ego"], "latency_s": late_s} for name, late_s in zip(names, (0.0, 0.5), strict=True)}
    made = make(tmp_path / "x.rrd", scene, measure={"onset": {"kind": "appears"}}, configurations=asked)
    labels = [
        batch.column("StateConfiguration:labels").to_pylist()[0]
        for entity, batch in batches(made.path)
        if entity.startswith("/lanes/2_") and "StateConfiguration:labels" in batch.schema.names
    ]
    assert len(labels) == 2
    for name, of_lane in zip(names, labels, strict=True):
        [cut] = [label for label in of_lane if "…" in label]
        begin, end = cut.split("…")
        assert name.startswith(begin)
        assert name.endswith(end)
        assert min(len(begin), len(end)) >= 3


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("seen by roadside, not listed", ["not listed", "seen"]), ("out of range or view", ["out of view", "out"]),
        ("on its way from ego", ["on its way", "on way"]), ("listed, not confirmed", ["not confirmed", "listed"]),
        ("behind car 3 (from ego)", ["behind car 3", "behind 3", "behind"]), ("list lost", ["lost"]),
        ("not listed", []), ("7 lost", []), ("0.50 s known", ["0.50 s"]), ("PEM: seen by ego, not listed", ["PEM"]),
    ],
)  # fmt: skip
def test_words_are_shortened_to_what_is_still_true(text: str, words: list[str]) -> None:
    assert list(dict.fromkeys(_shorten_words(text))) == [text, *words]


def test_the_overview_has_the_table_that_fits(city: Made) -> None:
    """Of all objects, and what would help with the first one; the other page has a table of each, too."""
    short, whole = (static(city.path, path)["TextDocument:text"][0] for path in ("/difference_short", "/difference"))
    assert [line.count("|") for line in short.split("\n\n")[0].splitlines()] == [8] * 6, "six objects"
    assert short.count("| --- |") == 1
    assert "What would help ego: the lists of mast1, mast2 as well" in short
    assert whole.count("| --- |") == 7
    assert whole.count("What would help") == 6


def test_the_legend_names_statuses_and_what_is_common(city: Made) -> None:
    [names] = [batch for entity, batch in batches(city.path) if entity == "/legend/names"]
    said = set(names.column("Points2D:labels").to_pylist()[0])
    assert {"truth", "ego", "hides it", "field of view", "false, dashed"} <= said
    assert {"disc: place ± 2σ", "listed, not known"} <= said, "what else is in pictures and lanes"
    assert {"hidden", "out of range or view", "list lost", "on its way", "unmatched", "not listed"} <= said
    assert set(city.given.configurations) - {"GT"} <= said | {"truth"}
    # A word hangs below its point: on a bar from above its middle, below a line that would strike it through.
    labels, places = (names.column(f"Points2D:{what}").to_pylist()[0] for what in ("labels", "positions"))
    above = {word: round(y) - y for word, (_, y) in zip(labels, places, strict=True)}
    on_bars = {"ego", "hidden", "unmatched"}
    assert all((above[word] > 0.3) == (word in on_bars) for word in (*on_bars, "truth", "hides it", "false, dashed"))


# ------------------------------------------------------------------------------- who knew when


def test_no_lane_of_the_city_says_known_before_the_table(city: Made) -> None:
    """For every object that is shown and every configuration."""
    table = city.table.set_index(["configuration", "object_id"])
    shown = {entity.split("/")[2].split("_")[0] for entity, _ in batches(city.path) if entity.startswith("/lanes/")}
    assert len(shown) == 6
    held = 0
    beside = [name for name, asked in city.given.configurations.items() if asked.units != "truth"]
    for c, name in enumerate(beside):
        for who in shown:
            kind = table.loc[(name, who), "object_class"]
            known = [time_s for time_s, said in lane(city.path, f"{who} {kind}", c) if said == "known"]
            episode = table.loc[(name, who)]
            assert known[:1] == ([pytest.approx(episode["detection_s"], abs=1e-9)] if episode["detected"] else [])
            held += bool(known)
    assert held > 15


@given(st.lists(st.tuples(st.integers(1, 12), st.integers(1, len(STATUSES) - 1)), min_size=1, max_size=30))
def test_steady_lanes_begin_known_where_it_begins(runs: list[tuple[int, int]]) -> None:
    """Tenths of a second each status lasts: spans are long, or the first of all, or the first known."""
    lasts, what = np.array([r for r, _ in runs]), np.array([s for _, s in runs])
    elapsed = np.append(0, np.cumsum(lasts)[:-1]) * 100_000_000
    spans = smooth_status(elapsed, what, keep=KNOWN)
    assert spans[0].first == 0
    assert spans[-1].end == len(what)
    assert all(a.end == b.first and a.status != b.status for a, b in pairwise(spans))
    known = np.flatnonzero(what == KNOWN)
    begun = [span.first for span in spans if span.status == KNOWN]
    assert begun[:1] == known[:1].tolist()
    # Every status that lasts is told from where it begins.
    merged = np.append(True, what[1:] != what[:-1])
    for first in np.flatnonzero(merged):
        end = next((k for k in range(first + 1, len(what)) if merged[k]), len(what))
        if lasts[first:end].sum() / 10 >= STEADY_S:
            assert any(span.first <= first < span.end and span.status == what[first] for span in spans)


def test_what_is_short_after_an_absence_is_no_absence() -> None:
    """Absent for 1 s, hidden for 0.3 s, known from then on."""
    spans = smooth_status(np.array([0, 10, 13]) * 100_000_000, np.array([ABSENT, HIDDEN, KNOWN]), keep=KNOWN)
    assert [(span.first, span.status) for span in spans] == [(0, ABSENT), (1, HIDDEN), (2, KNOWN)]


# ------------------------------------------------------------------------------- errors


def test_running_quartiles_against_plain_ones() -> None:
    chance = np.random.default_rng(3)
    elapsed = np.sort(chance.choice(100, 60, replace=False)) * 50_000_000
    values = chance.normal(size=60)
    of = running_median(elapsed, values)
    assert len(of.elapsed_ns)
    for now, quartiles in zip(of.elapsed_ns.tolist(), of.quartiles, strict=True):
        assert now % 250_000_000 == 0
        near = [v for t, v in zip(elapsed.tolist(), values, strict=True) if abs(t - now) <= 500_000_000]
        assert quartiles == pytest.approx(np.quantile(near, [0.25, 0.5, 0.75]))


@given(st.lists(st.integers(1, 1_500_000_000), max_size=20), st.booleans())
def test_lines_break_exactly_where_rows_are_far_apart(steps_ns: list[int], steps: bool) -> None:
    elapsed = np.cumsum([0, *steps_ns])
    values = np.arange(2.0 * len(elapsed)).reshape(-1, 2)
    lines = break_lines(elapsed, values, steps=steps)
    said, found = iter(lines.values), []
    for now, count in zip(lines.elapsed_ns.tolist(), lines.counts.tolist(), strict=True):
        found.append((now, [next(said) for _ in range(count)]))
    expected = []
    for k, (now, row) in enumerate(zip(elapsed.tolist(), values.tolist(), strict=True)):
        expected.append((now, row))
        if k + 1 < len(elapsed) and elapsed[k + 1] - now > 500_000_000:
            expected += [(now + 499_999_999, row)] if steps else []
            expected.append((now + 500_000_000, []))
    assert found == expected
    assert next(said, None) is None


# ------------------------------------------------------------------------------- numbers


def test_no_time_is_minus_nothing() -> None:
    """Times on a grid of ticks are differences of floats, such as −4e-16."""
    assert [show_seconds(value) for value in (-4e-16, -0.004, 0.004, 0.2, -0.5)] == [
        "0.00", "0.00", "0.00", "0.20", "-0.50",
    ]  # fmt: skip
