"""The figures that answer first, read back from their artists: dots, intervals, differences, false positives.

The scene of `tests/helpers/report_pages.py`: known after l seconds, the ego stops 14.5 − 10 l metres before him.
"""

from __future__ import annotations

import math
import re
import shutil
from importlib.resources import files
from io import BytesIO
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes

from copem_replay.core.colours import configuration_colours
from copem_replay.core.errors import InputError
from copem_replay.metrics.detections_table import first_episodes
from copem_replay.report.figures import FIGURES, Selection
from copem_replay.report.figures.answer import answer_figure
from copem_replay.report.figures.detection_curves import curves_figure
from copem_replay.report.figures.differences import differences_figure
from copem_replay.report.figures.false_positives import false_positives_figure
from copem_replay.report.figures.selection import choose_object_and_run, find_differing
from copem_replay.report.figures.style import (
    DARK,
    WHITE,
    choose_appearances,
    contrast_ratio,
    figure_style,
    format_per_cent,
    format_three_digits,
    lay_out,
    render_figure,
)
from copem_replay.report.figures.sweeps import sweeps_figure
from copem_replay.report.html.markup import INK, PAPER, line_swatch, page_colours, replace_colours, replace_greys
from copem_replay.report.html.page import build_page as report_page
from copem_replay.report.html.study import load_study
from copem_replay.report.html.tables import (
    column_header,
    difference_column_header,
    format_signed_difference,
    format_value,
    sort_columns,
    strip_unit,
)
from copem_replay.results.compare import compare_folders
from copem_replay.results.read import Results, read_results
from copem_replay.results.shown_objects import choose_shown_objects, measure_apart
from tests.helpers.compare_folders import unseal
from tests.helpers.report_pages import ALONE, ONE, changed, eighteen, named, replayed, with_rows


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    """One pedestrian, six runs."""
    return read_results(replayed(tmp_path_factory.mktemp("one"), changed(ONE)))


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Results:
    """Two pedestrians: nothing is resampled."""
    return read_results(replayed(tmp_path_factory.mktemp("two"), changed()))


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory) -> Results:
    return read_results(replayed(tmp_path_factory.mktemp("many"), eighteen()))


def dots(axes: Axes) -> dict[str, tuple[float, bool]]:
    """Where the dot of each configuration is, and whether it is filled."""
    return {
        str(c.get_label()): (float(c.get_offsets()[0][0]), tuple(c.get_facecolor()[0][:3]) != (1.0, 1.0, 1.0))
        for c in axes.collections
    }


def intervals(axes: Axes) -> dict[str, tuple[float, float]]:
    lines = [line for line in axes.get_lines() if str(line.get_label()).startswith("of ")]
    return {str(line.get_label())[3:]: tuple(np.asarray(line.get_xdata(), dtype=float)) for line in lines}  # type: ignore[misc]


def rows(axes: Axes) -> list[str]:
    return [tick.get_text() for tick in axes.get_yticklabels()]


def note(figure: object) -> str:
    return " ".join(figure.texts[-1].get_text().split()).replace("\u00a0", " ")  # type: ignore[attr-defined]


class TestAnswer:
    def test_the_soonest_first_and_the_truth_is_a_line(self, results: Results) -> None:
        times, shares = answer_figure(results).axes
        assert rows(times) == ["half", "late", "hit", "never"]
        summary = results.summary.set_index("configuration")
        found = dots(times)
        assert set(found) == {"half", "late", "hit"}, "what never detects has no dot among times"
        for name, (value, _) in found.items():
            assert value == pytest.approx(summary.loc[name, "ttd_rmst_s"])
        assert "never (counts as 4.5 s)" in [text.get_text() for text in times.texts]
        (truth,) = [line for line in times.get_lines() if line.get_label() == "GT"]
        assert list(truth.get_xdata()) == [0, 0]
        assert {name: value for name, (value, _) in dots(shares).items()} == {
            "half": 100.0, "late": 100.0, "hit": 0.0, "never": 0.0,
        }  # fmt: skip
        for name, (low, high) in intervals(shares).items():
            limits = [100 * summary.loc[name, f"pass_share_{end}"] for end in ("low", "high")]
            assert [low, high] == pytest.approx(limits)

    def test_what_is_the_same_in_every_run_has_the_limits_of_as_many_runs(self, results: Results) -> None:
        """Of S runs none is another: 1 − .025^(1/S) of all may be, as far off as never; but none below the latency."""
        (times, _) = answer_figure(results).axes
        assert {name: filled for name, (_, filled) in dots(times).items()} == dict.fromkeys(
            ("half", "late", "hit"), True
        )
        value, other = dots(times)["late"][0], 1 - 0.025 ** (1 / results.experiment.runs)
        assert intervals(times)["late"] == pytest.approx((value, value + other * (4.5 - value)))

    def test_two_objects_have_no_interval_at_all(self, two: Results) -> None:
        figure = answer_figure(two)
        assert intervals(figure.axes[0]) == {}
        assert note(figure).startswith("No interval of the mean time")
        assert ": 2 objects of one drive, fewer than 5" in note(figure)
        assert "95 % intervals" not in note(figure)

    def test_only_some(self, results: Results) -> None:
        figure = answer_figure(results, configurations=["hit", "late"])
        assert rows(figure.axes[0]) == ["late", "hit"]
        assert not [line for line in figure.axes[0].get_lines() if line.get_label() == "GT"]


class TestDifferences:
    def test_they_are_those_of_compare(self, results: Results) -> None:
        figure = differences_figure(results)
        table = compare_folders([results.folder], baseline="late").overall.set_index(["configuration", "metric"])
        assert rows(figure.axes[0]) == ["half", "hit", "never"], "the truth is no row"
        for axes, metric, times in zip(figure.axes, ("ttd_rmst_s", "pass_share"), (1, 100), strict=True):
            assert dots(axes), metric
            for name, (value, filled) in dots(axes).items():
                row = table.loc[(name, metric)]
                assert value == pytest.approx(times * row["difference"], abs=1e-9)
                assert filled == (name in intervals(axes)) == (not pd.isna(row["low"]))
                if filled:
                    assert intervals(axes)[name] == pytest.approx((times * row["low"], times * row["high"]), abs=1e-9)
            bold = [text.get_text() for text in axes.texts if text.get_fontweight() == "bold"]
            sure = [
                name for name in dots(axes) if table.loc[(name, metric), "low"] * table.loc[(name, metric), "high"] > 0
            ]
            assert len(bold) == len(sure)
        assert "The ground truth, an upper bound, is not drawn: GT −0.50 (all alike) s" in note(figure)

    def test_a_report_has_its_own_baseline(self, results: Results) -> None:
        found = compare_folders([results], baseline="hit")
        figure = FIGURES["differences"].draw(results, Selection(differences=found))
        assert rows(figure.axes[0]) == ["half", "late", "never"]

    def test_with_nothing_to_compare_there_is_none(self, tmp_path: Path) -> None:
        alone = read_results(replayed(tmp_path, changed(ONE, *ALONE)))
        assert FIGURES["differences"].missing(alone, Selection()) == ""
        with pytest.raises(InputError, match="there is nothing to compare with"):
            differences_figure(alone)

    def test_a_missing_interval_is_said_first(self, two: Results) -> None:
        assert note(differences_figure(two)).startswith("No intervals: 2 objects of one drive, fewer than 5")


class TestFalsePositives:
    def test_a_mark_and_a_name_each(self, many: Results) -> None:
        figure = false_positives_figure(many)
        (axes,), (legend,) = figure.axes, figure.legends
        summary = many.summary.set_index("configuration")
        marks = {str(c.get_label()): tuple(c.get_offsets()[0]) for c in axes.collections}
        known = summary[["position_rmse_m", "false_positives_per_min"]].dropna().drop(index="GT")
        assert set(marks) == set(known.index)
        for name, place in marks.items():
            assert place == pytest.approx(tuple(known.loc[name]))
        numbered = [f"{k} {name}" for k, name in enumerate(known.index, start=1)]
        assert [text.get_text() for text in legend.get_texts()] == numbered
        beside = [number for text in axes.texts for number in text.get_text().split(", ")]
        assert sorted(beside, key=int) == [str(k + 1) for k in range(len(known))], "each beside a mark"

    def test_of_ideal_fusion_alone_there_is_none(self, results: Results, many: Results) -> None:
        assert FIGURES["false_positives"].missing(results, Selection()) == ""
        assert FIGURES["false_positives"].missing(many, Selection()) is None


class TestEighteen:
    def test_never_more_than_twelve_lines_and_those_left_out_are_named(self, many: Results) -> None:
        every = tuple(many.experiment.configurations)
        assert len(every) == 19
        figure = curves_figure(many)
        titles = [axes.get_title(loc="left") for axes in figure.axes]
        shown = [name for name in every if name == "c00" or name in titles]
        assert len(shown) == 12
        for axes, name in zip(figure.axes, titles[:11], strict=False):
            assert {"c00", name} <= {line.get_label() for line in axes.get_lines()}, "the baseline in each panel"
        assert [text.get_text() for text in figure.legends[0].get_texts()] == ["c00, in each panel"]
        left = [name for name in every if name not in shown]
        assert (
            f"{len(shown)} of 19 configurations, from the soonest to the latest; not drawn: {', '.join(left)}."
            in note(figure)
        )

    def test_in_a_sweep_each_has_panels_of_its_own(self, many: Results, tmp_path: Path) -> None:
        every = list(many.experiment.configurations)
        rows = [("latency_s", at_s, name, at_s / 4, k + at_s, 10.0) for k, name in enumerate(every) for at_s in (0, 1)]
        columns = ["sweep", "value", "configuration", "detected_share", "ttd_rmst_s", "list_rate_hz"]
        assert many.folder is not None
        place = unseal(Path(shutil.copytree(many.folder, tmp_path / "results")))
        pd.DataFrame(rows, columns=columns).to_csv(place / "sweep.csv", index=False)
        figure = sweeps_figure(read_results(place))
        panels = np.array(figure.axes).reshape(11, 2)
        quantities = ["Share detected", "Time to detection (s)\nmean, 5 % to 95 %"]
        assert [axes.get_title(loc="left") for axes in panels[0]] == quantities
        for axes, axes_s in panels:
            name = axes.get_ylabel()
            drawn = {str(line.get_label()): list(line.get_ydata()) for line in axes_s.get_lines()}
            assert drawn == {one: [every.index(one), every.index(one) + 1] for one in ("c00", name)}
            assert {line.get_label() for line in axes.get_lines()} == {"c00", name}
        assert [text.get_text() for text in figure.legends[0].get_texts()] == ["c00 (latency swept)"]
        assert "12 of 19 configurations, from the soonest to the latest; not drawn: " in note(figure)

    def test_each_has_a_row(self, many: Results) -> None:
        every = set(many.experiment.configurations)
        assert set(rows(answer_figure(many).axes[0])) == every - {"GT"}
        assert set(rows(differences_figure(many).axes[0])) == every - {"GT", "c00"}

    def test_those_that_detect_alike_count_once(self, many: Results, tmp_path: Path) -> None:
        table = many.detections.copy()
        keys = ["log", "object_id", "run"]
        first = table[table["configuration"] == "c00"].set_index(keys)["time_to_detection_s"]
        alike = table["configuration"].isin([f"c{k:02}" for k in range(10)])
        table.loc[alike, "time_to_detection_s"] = first.reindex(
            pd.MultiIndex.from_frame(table.loc[alike, keys])
        ).to_numpy()
        changed_one = with_rows(many, table, tmp_path / "alike")
        names = tuple(many.experiment.configurations)
        found = find_differing(changed_one, names)
        assert set(found) & {f"c{k:02}" for k in range(10)} == {"c00"}
        assert find_differing(many, names[:12]) == names[:12]

    def test_the_page_is_small(self, many: Results) -> None:
        assert len(report_page(load_study(many.folder)).encode()) < 1_500_000


class TestWhichObject:
    def test_by_default_the_one_that_the_viewer_shows_first(self, two: Results) -> None:
        """Of the run that is drawn; with others asked for, too."""
        for selection in (Selection(), Selection(run=2), Selection(("half", "late"))):
            choice = choose_object_and_run(two, selection)
            (table,) = two.each(log=choice.log, every=True)
            recording = two.recording(choice.log, two.experiment)
            of_run = first_episodes(table[table["run"] == choice.run])
            shown = choose_shown_objects(recording.scene, recording.truth, two.experiment, of_run).object_ix
            assert choice.object_id == recording.scene.object_ids[shown[0]]

    def test_without_the_recording_by_the_table_alone(self, two: Results, tmp_path: Path) -> None:
        """The object that `half` knows later than the others by more than it usually does."""
        table = two.detections
        run = int(table.loc[table["configuration"] == "half"].sort_values("time_to_detection_s")["run"].iloc[-1])
        moved = with_rows(two, table, tmp_path / "without")
        apart = measure_apart(two.experiment, first_episodes(table[table["run"] == run]))
        chosen = choose_object_and_run(moved, Selection(run=run))
        observed = apart[apart["observed"]] if apart["observed"].any() else apart
        assert apart["apart_s"][chosen.object_id] == observed["apart_s"].max()
        assert len(chosen.configurations) == 4
        assert (chosen.configurations[0], chosen.configurations[-1]) == ("GT", "never")


class TestLooks:
    def test_colours_are_those_of_the_recording(self) -> None:
        """On a dark page; paper has its own, by the same names."""
        names = ["GT", "PEM", *(f"coPEM:{k}s" for k in range(19))]
        on = {theme: configuration_colours(names, ["GT"], theme) for theme in ("light", "dark")}
        for name, look in choose_appearances(named(names, truths=["GT"])).items():
            assert tuple(round(255 * channel) for channel in look.colour) == on["light"][name]
            assert tuple(round(255 * channel) for channel in look.dark) == on["dark"][name]

    def test_the_truth_is_a_grey_line_of_a_pixel(self) -> None:
        look = choose_appearances(named(["PEM", "GT"], truths=["GT"]))["GT"]
        assert look.colour == look.dark == (145 / 255,) * 3
        assert look.line()["linewidth"] == 0.75
        assert look.line()["linestyle"] == "-"

    def test_up_to_seven_have_markers_of_their_own(self) -> None:
        looks = choose_appearances(named(["GT", *(f"c{k}" for k in range(8))], truths=["GT"]))
        assert "".join(look.marker for look in list(looks.values())[1:]) == "os^DvPXs"

    def test_no_two_of_forty_three_look_alike(self) -> None:
        looks = choose_appearances(named([f"c{k}" for k in range(43)])).values()
        for of in (lambda look: (look.colour, look.marker), lambda look: (look.dark, look.dashes)):
            assert len(set(map(of, looks))) == 43

    def test_lines_are_seen_on_white_and_on_a_dark_page(self) -> None:
        """WCAG 2.1, 1.4.11: 3 to 1."""
        for look in choose_appearances(named([f"c{k}" for k in range(21)])).values():
            assert contrast_ratio(look.colour, WHITE) >= 3, look
            assert contrast_ratio(look.dark, DARK) >= 3, look

    def test_contrast(self) -> None:
        assert contrast_ratio((0.0, 0.0, 0.0), WHITE) == pytest.approx(21)
        assert contrast_ratio(WHITE, WHITE) == pytest.approx(1)
        grey = 0x76 / 255  # the greys around it are known to end at 4.5
        assert contrast_ratio((grey,) * 3, WHITE) == pytest.approx(4.54, abs=0.01)


def test_numbers_have_three_digits() -> None:
    shown = {
        0: "0",
        1e-12: "0",
        0.012345: "0.0123",
        0.99963: "1",
        12.345: "12.3",
        999.4: "999",
        15371.2: "15371",
        -0.5: "−0.5",
    }
    assert {value: format_three_digits(value) for value in shown} == shown
    shares = {0.0: "0", 1.0: "100", 0.844: "84.4", 0.99963: "> 99.9", 0.0001: "< 0.1", 0.9924: "99.2"}
    assert {value: format_per_cent(value) for value in shares} == shares
    assert format_per_cent(math.nan) == "–"


def test_headers_have_units_also_of_own_metrics() -> None:
    own = {
        "speed_rmse_mps": "speed rmse, m/s",
        "late_share": "late, %",
        "calls_per_min": "calls per minute",
        "cost": "cost",
    }
    assert {name: column_header(name) for name in own} == own
    assert strip_unit("ttd_rmst_s") == "known after (mean)"
    assert difference_column_header("pass_share") == "passes, percentage points"
    assert (format_value("late_share", 0.5), format_value("cost", math.nan)) == ("50.0", "–")
    assert [format_value("cost", value) for value in (0.2, -0.0, 4.87e-5, -4.87e-5, 12.345, 4321.5)] == [
        "0.20", "0.00", "< 0.01", "> −0.01", "12.35", "4322",
    ]  # fmt: skip
    assert [format_signed_difference("late_share", value) for value in (0.125, -0.5, 1e-12)] == [
        "+12.50", "−50.00", "±0",
    ]  # fmt: skip
    assert [format_signed_difference("cost", value) for value in (4e-3, -4e-3, 5.1e-3)] == [
        "< 0.01",
        "> −0.01",
        "+0.01",
    ]
    assert sort_columns(["n", "detected_share", "ttd_rmst_s"]) == ["ttd_rmst_s", "detected_share", "n"]


def test_a_configuration_has_its_other_colour_on_a_dark_page() -> None:
    """In figures and swatches, by the same variable; other colours and texts stay."""
    looks = choose_appearances(named(["PEM"]))
    [(light, dark)] = [
        [bytes(round(255 * c) for c in one).hex() for one in (look.colour, look.dark)] for look in looks.values()
    ]
    page = replace_colours(f'<path style="fill: #{light}; stroke: #123456"/>#{light}', looks.values())
    assert page == f'<path style="fill: var(--c-{light}-{dark}); stroke: #123456"/>#{light}'
    assert f"var(--c-{light}-{dark})" in line_swatch(looks["PEM"])
    on_paper, on_dark = page_colours(page).splitlines()
    assert on_paper == f":root{{--c-{light}-{dark}:#{light};}}"
    assert f":root{{--c-{light}-{dark}:#{dark};}}" in on_dark


def test_greys_turn_over_and_colours_stay() -> None:
    """Black becomes the ink of the dark page, white its paper, a grey lies as far between them."""
    page = replace_greys('<path style="fill: #ffffff; stroke: #000000"/><path style="fill: #808080; stroke: #0072b2"/>')
    assert "#0072b2" in page
    assert re.findall(r"#[0-9a-f]{6}", page) == ["#0072b2"]
    light, dark = page_colours(page).splitlines()
    assert light == ":root{--g-00:#000000;--g-80:#808080;--g-ff:#ffffff;}"
    expected = ":root{--g-00:#e8e8e8;--g-80:#818181;--g-ff:#1b1b1b;}"
    assert dark == f"@media screen and (prefers-color-scheme: dark){{{expected}}}"
    assert page_colours("<p>no figure</p>") == ""


def test_the_page_has_the_dark_paper_that_greys_go_by() -> None:
    css = (files("copem_replay.report.html") / "page.css").read_text(encoding="utf-8")
    dark = css[css.index("prefers-color-scheme: dark") :]
    for name, colour in (("ink", INK), ("paper", PAPER)):
        found = re.search(rf"--{name}: #([0-9a-f]{{6}})", dark)
        assert found is not None
        assert bytes.fromhex(found[1]) == bytes(colour)
    assert tuple(round(255 * channel) for channel in DARK) == PAPER


def test_coordinates_are_rounded_to_a_hundredth_of_a_point(results: Results) -> None:
    """As matplotlib writes them, but for what nobody sees."""
    with figure_style():
        figure = answer_figure(results)
        lay_out(figure)
        file = BytesIO()
        figure.savefig(file, format="svg")
    ours = render_figure(answer_figure(results), (".svg",))[".svg"].decode()
    paths = [re.findall(r' d="([^"]*)"', svg) for svg in (file.getvalue().decode(), ours)]
    assert len(paths[0]) == len(paths[1]) > 20
    for exact, rounded in zip(*paths, strict=True):
        numbers = [[float(n) for n in re.findall(r"-?[\d.]+", path)] for path in (exact, rounded)]
        assert numbers[1] == pytest.approx(numbers[0], abs=0.0051)
    assert len(ours) < len(file.getvalue())
