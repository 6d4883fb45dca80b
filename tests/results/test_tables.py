"""Which configurations are meant, and what a comparison looks like."""

from __future__ import annotations

import csv
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from markdown_it import MarkdownIt

from copem_replay.core.errors import InputError, OutputError
from copem_replay.results.compare import (
    Comparison,
    check_out,
    compare_folders,
    comparison_markdown,
    comparison_text,
    write_comparison,
)
from copem_replay.results.compare.tables import escape_markdown
from tests.helpers.compare_folders import Row, row, write_folder


def rows(*names: str) -> list[Row]:
    return [row(name, 1.0, 30.0) for name in names]


def study(tmp_path: Path, name: str, *configurations: str, **given: Any) -> Path:
    return write_folder(tmp_path / name, rows(*configurations), **given)


def problem(*folders: Path, **options: Any) -> str:
    with pytest.raises(InputError) as caught:
        compare_folders(folders, **options)
    (found,) = caught.value.problems
    return found


# ----------------------------------------------------------------------------------------------------- names


def test_all_configurations_are_compared_with_the_ideal(tmp_path):
    comparison = compare_folders([study(tmp_path, "a", "GT", "ideal", "PEM")])
    assert comparison.baseline == "ideal"
    assert comparison.configurations == ("GT", "PEM")


def test_names_that_several_folders_have_get_the_folders(tmp_path):
    folders = [study(tmp_path, "old", "ideal", "GT", "nms"), study(tmp_path, "new", "GT", "gnn")]
    comparison = compare_folders(folders, baseline="ideal")
    assert comparison.baseline == "ideal"
    assert comparison.configurations == ("old:GT", "nms", "new:GT", "gnn")


def test_folders_of_one_name_are_told_apart_by_their_paths(tmp_path):
    folders = [study(tmp_path, "a/out", "ideal", "GT"), study(tmp_path, "b/out", "GT")]
    assert compare_folders(folders, baseline="ideal").configurations == (f"{folders[0]}:GT", f"{folders[1]}:GT")
    itself = compare_folders(folders)
    assert (itself.baseline, itself.newer, itself.configurations) == (str(folders[0]), (str(folders[1]),), ("GT",))


def test_a_name_that_looks_like_a_folders_is_no_other_ones(tmp_path):
    folders = [study(tmp_path, "a", "ideal", "x", "b:x"), study(tmp_path, "b", "x")]
    comparison = compare_folders(folders, baseline="ideal")
    assert len(set(comparison.configurations)) == 3
    assert set(comparison.table["configuration"]) == set(comparison.configurations)


def test_a_name_stands_for_all_that_bear_it(tmp_path):
    folders = [study(tmp_path, "a", "ideal", "GT", "nms"), study(tmp_path, "b", "GT", "gnn")]
    ideal = {"baseline": "ideal"}
    assert compare_folders(folders, configurations=["GT"], **ideal).configurations == ("a:GT", "b:GT")
    assert compare_folders(folders, configurations=["b:GT", "a:nms", "nms"], **ideal).configurations == ("b:GT", "nms")
    assert compare_folders(folders, configurations=["nms", "gnn"], baseline="b:GT").baseline == "b:GT"


def test_a_configurations_own_name_goes_before_that_with_a_folders(tmp_path):
    folders = [study(tmp_path, "a", "ideal", "b:x"), study(tmp_path, "b", "x")]
    assert compare_folders(folders, configurations=["b:x"], baseline="ideal").configurations == ("b:x",)


def test_a_baseline_is_one_configuration(tmp_path):
    folders = [study(tmp_path, "a", "ideal", "GT"), study(tmp_path, "b", "ideal", "GT")]
    assert problem(*folders, baseline="ideal") == (
        "--baseline: expected one of a:ideal, b:ideal, found ideal, which may be any"
    )
    assert problem(*folders, baseline="GT") == "--baseline: expected one of a:GT, b:GT, found GT, which may be any"
    assert compare_folders(folders, baseline="b:ideal").configurations == ("a:ideal", "a:GT", "b:GT")


def test_a_baseline_that_nobody_is(tmp_path):
    folder = study(tmp_path, "a", "GT", "PEM")
    assert problem(folder, baseline="PEN") == "--baseline: no configuration is named 'PEN'; did you mean PEM?"
    assert problem(folder, baseline="zzz") == "--baseline: no configuration is named 'zzz'; there are GT, PEM"


UNITS = {"ego": {"on": "ego", "pem": "p"}, "rsu": {"on": "7", "pem": "p"}, "box": {"recorded": {"topic": "box"}}}
GT, EGO, BOTH, GNN = {"units": "truth"}, {"units": ["ego"]}, {"units": "all"}, {"fusion": {"kind": "gnn"}}


def chosen(tmp_path: Path, **configurations: dict[str, Any]) -> tuple[str, str | None]:
    """Baseline and reason where none is asked for."""
    experiment = {"units": UNITS, "configurations": configurations}
    found = compare_folders([study(tmp_path, "a", *configurations, experiment=experiment)])
    return found.baseline, found.baseline_why


FIRST = "the first that is not the truth"


@pytest.mark.parametrize(
    ("configurations", "expected"),
    [
        ({"GT": GT, "PEM": EGO, "ideal": BOTH}, ("ideal", "by its name")),
        ({"GT": GT, "PEM": EGO, "coPEM": BOTH}, ("PEM", FIRST)),  # each is its own ideal
        ({"GT": GT, "car": EGO | GNN, "x": BOTH | GNN}, ("car", FIRST)),  # neither has one
        ({"GT": GT, "also": GT}, ("GT", "the first")),
        ({"GT": GT, "PEM": EGO, "co": BOTH, "x": BOTH | GNN}, ("co", "ideal fusion of the inputs of x")),
        # The order of the units does not matter, and `all` are the modelled ones.
        ({"PEM": EGO, "co": {"units": ["rsu", "ego"]}, "x": BOTH | GNN}, ("co", "ideal fusion of the inputs of x")),
        ({"PEM": EGO, "co": {"units": ["rsu", "ego", "box"]}, "x": BOTH | GNN}, ("PEM", FIRST)),
        # `car` has no ideal, the next one has.
        ({"car": EGO | GNN, "co": BOTH, "x": BOTH | GNN}, ("co", "ideal fusion of the inputs of x")),
        # Posterior is another fusion, no baseline of itself.
        ({"co": BOTH | {"fusion": {"kind": "ideal", "combine": "posterior"}}, "x": BOTH | GNN}, ("co", FIRST)),
    ],
)  # fmt: skip
def test_the_baseline_is_the_ideal_of_the_same_inputs_else_the_first(tmp_path, configurations, expected):
    assert chosen(tmp_path, **configurations) == expected


LATE, LINK = {"latency_s": 0.5}, {"link": "radio"}


@pytest.mark.parametrize(
    ("own", "expected"),
    [
        (LATE, "late"),
        ({"latency_s": {"default": 0.5}}, "late"),
        ({"latency_s": {"ego": 0.0}}, "co"),
        (LINK, "linked"),
        ({"link": {"ego": "none", "default": "radio"}}, "wired ego"),
        ({"issue_hz": 10.0}, "ticks"),
    ],
)
def test_the_ideal_has_the_lists_as_they_come(tmp_path, own, expected):
    ideals = {
        "co": {}, "late": LATE, "linked": LINK, "wired ego": {"link": {"rsu": "radio"}}, "ticks": {"issue_hz": 10.0},
    }  # fmt: skip
    known = {name: BOTH | more for name, more in ideals.items()}
    assert chosen(tmp_path, **known, x=BOTH | GNN | own) == (expected, "ideal fusion of the inputs of x")


def test_without_that_the_ideal_of_the_same_units(tmp_path):
    found = chosen(tmp_path, PEM=EGO, co=BOTH, x=BOTH | GNN | LATE)
    assert found == ("co", "ideal fusion of the units of x")


def test_a_recorded_output_has_the_ideal_of_its_inputs_as_they_arrived(tmp_path):
    stack = {"recorded": {"topic": "out"}, "inputs": ["box"]}
    late, ideal = {"units": ["box"], "latency_s": 0.1}, {"units": ["box"]}
    found = chosen(tmp_path, GT=GT, late=late, stack=stack, **{"stack:ideal": ideal})
    assert found == ("stack:ideal", "ideal fusion of the inputs of stack")


def test_the_baseline_is_said_in_a_line_unless_it_was_asked_for(tmp_path):
    folder = study(tmp_path, "a", "PEM", "coPEM")
    said = "baseline PEM: the first that is not the truth; --baseline names another"
    assert said in comparison_text(compare_folders([folder])).splitlines()
    asked = compare_folders([folder], baseline="PEM")
    assert asked.baseline_why is None
    assert "--baseline" not in comparison_text(asked)


def test_every_unknown_configuration_is_said(tmp_path):
    with pytest.raises(InputError) as caught:
        compare_folders([study(tmp_path, "a", "ideal", "track", "nms")], configurations=["trakc", "nms", "nsm"])
    assert caught.value.problems == (
        "--configurations: no configuration is named 'trakc'; did you mean track?",
        "--configurations: no configuration is named 'nsm'; did you mean nms?",
    )


def test_a_baseline_alone_is_nothing_to_compare(tmp_path):
    folder = study(tmp_path, "a", "ideal", "GT")
    expected = "compare: expected a configuration beside the baseline ideal, found none"
    assert problem(folder, configurations=["ideal"]) == expected
    assert problem(study(tmp_path, "b", "ideal")) == expected


# ---------------------------------------------------------------------------------------------------- tables


def six_objects(tmp_path: Path) -> Comparison:
    """`fast` is 0.25 s earlier than the baseline at each of six, `worse` loses half of them, `same` is the same."""
    found = []
    for k in range(6):
        found += [row("ideal", 1.0, 30.0, object_id=str(k)), row("same", 1.0, 30.0, object_id=str(k))]
        found += [row("fast", 0.75, 32.5, object_id=str(k))]
        found += [row("a|worse", 1.0 if k % 2 else None, 30.0 if k % 2 else None, object_id=str(k))]
    return compare_folders([write_folder(tmp_path / "study", found)])


def test_the_table_has_signs_and_intervals(tmp_path):
    lines = comparison_text(six_objects(tmp_path)).splitlines()
    assert lines[0].split() == [
        "configuration",
        "detected_share",
        "ttd_rmst_s",
        "ttd_both_s",
        "unknown_to_horizon_s",
        "dad_median_m",
    ]
    by_name = {line.split()[0]: line for line in lines[1:4]}
    # Of six: 1 − 0.025^(1/6).
    assert by_name["same"].split(maxsplit=1)[1].split("  ")[0] == "±0 [-0.459, 0.459]"
    assert by_name["same"].count("±0 (all alike)") == 4
    assert "-0.25 (all alike)" in by_name["fast"]
    assert "+2.5 (all alike)" in by_name["fast"]
    # Of six objects half: ± t of 5 degrees · √(.3/6) = ± .5748, and no less than −1.
    assert "-0.5 [-1, 0.0748]" in by_name["a|worse"]
    assert "±0 (all alike) (only it 0 %, only the baseline 50 %)" in by_name["a|worse"]
    assert "+4.5 [" in by_name["a|worse"]
    assert by_name["a|worse"].endswith("–")  # half of them never: no median
    assert all("…" not in line and "..." not in line for line in lines)


def test_what_the_table_shows_is_said_below(tmp_path):
    lines = comparison_text(six_objects(tmp_path)).splitlines()[4:]
    assert lines == [
        "differences to ideal, paired by log, object and run; accuracy of the newest list at each frame",
        "baseline ideal: by its name; --baseline names another",
        "[95 %]: over 6 objects of this drive: how far other objects of this drive may differ; nothing about other "
        "drives",
        "detected_share: exact binomial limits where the difference is the same in every cluster",
        "(all alike): no interval, the difference is the same in every cluster (of a median in nearly all)",
        "ttd_rmst_s: mean of min(time until known, 10 s), never known counting as 10 s; an object still unknown "
        "when the log or the ego ends counts as those that are followed longer",
    ]


def test_who_is_better_beyond_the_interval_is_said(tmp_path):
    rows = [row("ideal", 1.0, 30.0, object_id=str(k)) for k in range(6)]
    rows += [row("fast", 0.75 - k / 100, 32.5 + k, object_id=str(k)) for k in range(6)]
    lines = comparison_text(compare_folders([write_folder(tmp_path / "study", rows)])).splitlines()
    assert lines[-1] == "better than ideal in ttd_rmst_s, ttd_both_s, unknown_to_horizon_s (*): fast"
    assert "*: the interval excludes 0, the 5 differences of this table together at 95 %" in lines
    # At 1 − .05/5 six objects have no limit of a median.
    assert "°: its own interval alone excludes 0; of 5 such 1 in 20 does by chance" in lines


def four_logs(tmp_path, gains_s):
    """Of four logs one object each; `fast` knows it so much sooner."""
    rows = [row("ideal", 5.0, 30.0, log=f"log {k}") for k in range(4)]
    rows += [row("fast", 5.0 - gain_s, 30.0, log=f"log {k}") for k, gain_s in enumerate(gains_s)]
    return compare_folders([write_folder(tmp_path / "study", rows)], metrics=("ttd_rmst_s",))


def test_over_logs_it_is_said_in_how_many_a_configuration_gains(tmp_path):
    comparison = four_logs(tmp_path, [1.0, 1.5, 2.0, 1.5])
    lines = comparison_text(comparison).splitlines()
    # 1.5 ± 3.182446 · √(.166667/4).
    assert lines[1].split(maxsplit=1)[1] == "-1.5 [-2.15, -0.85] *"
    assert lines[4:7] == [
        "[95 %]: over 4 logs: how far other drives of this kind may differ",
        "logs that gain: ttd_rmst_s fast 4 of 4",
        "whatever the interval, a kind of drive that makes up to 53 % of such traffic can be absent",  # 1 − .05^(1/4)
    ]
    assert lines[-1] == "better than ideal in ttd_rmst_s (*): fast (4 of 4 logs gain)"
    assert not any("hangs on" in note for note in comparison.notes)


def three_logs(tmp_path: Path, **asked: Any) -> Comparison:
    """`fast` is sooner by 1, 1.25 and 1.5 s, and so is `also`: 1.25 ± 4.302653 · .25/√3, [.629, 1.871]."""
    rows = [row("ideal", 5.0, 30.0, log=f"log {k}") for k in range(3)]
    rows += [row(name, 4.0 - k / 4, 30.0, log=f"log {k}") for k in range(3) for name in ("fast", "also")]
    return compare_folders([write_folder(tmp_path / "study", rows)], **asked)


def test_stars_are_held_over_the_table_or_over_the_metric_that_was_named(tmp_path: Path) -> None:
    # Of three logs t = 1.25/(.25/√3) = 8.66, two-sided p = .01307: above .05/10 of a table, below .05/2 of a metric.
    whole = three_logs(tmp_path).overall
    times = whole[whole["metric"].isin(["ttd_rmst_s", "ttd_both_s", "unknown_to_horizon_s"])]
    assert whole["difference"].notna().sum() == 10
    assert times["star"].tolist() == ["°"] * 6
    lines = comparison_text(three_logs(tmp_path / "a")).splitlines()
    assert any(line.startswith("three drives cannot star a table; name one figure (--decide METRIC)") for line in lines)
    decided = three_logs(tmp_path / "b", decide="ttd_rmst_s").overall
    assert set(decided.loc[decided["metric"] == "ttd_rmst_s", "star"]) == {"*"}
    assert "*" not in set(decided.loc[decided["metric"] != "ttd_rmst_s", "star"])
    said = comparison_text(three_logs(tmp_path / "c", decide="ttd_rmst_s"))
    assert "decided by ttd_rmst_s, named beforehand: no other column has a *" in said
    assert problem(tmp_path / "c" / "study", decide="ttd_rmst") == (
        "--decide: no metric is named 'ttd_rmst'; did you mean ttd_rmst_s?"
    )


def test_words_by_the_least_difference_that_matters(tmp_path: Path) -> None:
    for k, (least, decide, word) in enumerate(
        ((1.9, None, "alike"), (0.5, None, "open"), (0.5, "ttd_rmst_s", "better"))
    ):
        found = three_logs(tmp_path / str(k), decide=decide, matters={"ttd_rmst_s": least}).overall
        assert set(found.loc[found["metric"] == "ttd_rmst_s", "word"]) == {word}
        assert found.loc[found["metric"] != "ttd_rmst_s", "word"].isna().all()


def test_a_difference_that_hangs_on_one_log_names_it(tmp_path):
    comparison = four_logs(tmp_path, [0.25, 4.0, -0.25, 0.0])
    (found,) = comparison.overall.to_dict("records")
    assert (found["difference"], found["clusters"], found["logs_better"]) == (-1.0, 4, 2)
    assert (found["hangs_on"], found["difference_without_it"]) == ("log 1", 0.0)
    assert "hangs on log log 1; without it: ttd_rmst_s of fast +0" in comparison.notes
    # Without it half is left: 1 of 2 s. Of the others none takes as much.
    (half,) = four_logs(tmp_path / "half", [1.0, 5.0, 1.0, 1.0]).overall.to_dict("records")
    assert (half["difference"], half["hangs_on"], half["difference_without_it"]) == (-2.0, "log 1", -1.0)


def test_without_an_interval_nothing_is_claimed(tmp_path):
    text = comparison_text(
        compare_folders([write_folder(tmp_path / "a", [row("ideal", 1.0, 30.0), row("fast", 0.5, 35.0)])])
    )
    assert "-0.5" in text
    assert "[" not in text
    assert "better" not in text


def test_markdown_has_the_same_content(tmp_path):
    comparison = six_objects(tmp_path)
    text, markdown = comparison_text(comparison).splitlines(), comparison_markdown(comparison).splitlines()
    assert markdown[0] == (
        "| configuration | detected | known after (mean) | known after where both detect | "
        "unknown up to the horizon (mean) | at distance (median) |"
    )
    assert markdown[1] == "| --- | --- | --- | --- | --- | --- |"
    cells = [line.replace("\\|", "\0").strip("| ").split(" | ") for line in markdown[2:5]]
    assert [c[0] for c in cells] == ["same", "fast", "a\0worse"]
    for line, of_row in zip(text[1:4], cells, strict=True):
        assert line.split() == " ".join(of_row).replace("\0", "|").split()
    notes = [f"note: {note}" for note in comparison.notes]
    assert len(notes) == 1
    said = "\n".join([*text[4:], *notes])
    for name, header in {
        "detected_share": "detected", "ttd_rmst_s_equal_ghosts": "known after at equal false positives",
        "ttd_rmst_s": "known after (mean)", "position_rmse_held_m": "position error of the newest list (RMSE)",
        "gospa_held_m": "GOSPA of the newest list", "false_positives_per_min": "false positives per minute",
    }.items():  # fmt: skip
        said = said.replace(name, header)
    assert [line.removeprefix("- ") for line in markdown[6:]] == said.splitlines()


class Cells(HTMLParser):
    """The text of table cells and list items."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        assert tag in ("table", "thead", "tbody", "tr", "th", "td", "ul", "li"), f"<{tag}> was made of text"
        if tag in ("th", "td", "li"):
            self.found.append("")

    def handle_data(self, data: str) -> None:
        if self.found:
            self.found[-1] += data


def read_markdown(text: str) -> list[str]:
    cells = Cells()
    cells.feed(MarkdownIt("commonmark").enable(["table", "strikethrough"]).render(text))
    return [cell.strip() for cell in cells.found]


PIECES = st.sampled_from(
    ["*", "_", "`", "~~", "[", "](", "x](y)", "![", "<b>", "&lt;", "|", "\\", "a", "b_c", " ", "$", "#"]
)


@given(st.lists(PIECES, min_size=1).map("".join) | st.text(st.characters(categories=["L", "P", "S", "Zs"]), min_size=1))
@example("<script>alert(1)</script>")
@example("[click](javascript:alert(1))")
@example("&copy; __a__ *b* `c` ~~d~~ http://e.f \\| g")
def test_whatever_a_name_is_markdown_shows_it(name):
    shown = " ".join(name.split())
    cell = escape_markdown(shown)
    table = f"| {cell} | b |\n| --- | --- |\n| {cell} | d |\n\n- name: {cell}\n"
    heading, _, cell, _, item = read_markdown(table)
    assert (heading, cell, item) == (shown, shown, f"name: {shown}".strip())


def test_csv_has_a_row_for_each_log_configuration_and_metric(tmp_path):
    out = tmp_path / "new" / "regret.csv"
    write_comparison(six_objects(tmp_path), out)
    with out.open(newline="", encoding="utf-8") as file:
        read = list(csv.DictReader(file))
    assert list(read[0]) == [
        "log", "configuration", "baseline", "metric", "value", "baseline_value", "difference", "low", "high",
        "interval", "interval_over", "n", "p_value", "only_configuration", "only_baseline", "existence",
        "baseline_existence",
        "ghosts_kept_per_min", "baseline_ghosts_kept_per_min", "clusters", "logs_better", "hangs_on",
        "difference_without_it", "frames", "age_s", "baseline_age_s", "no_list_share", "baseline_no_list_share",
        "without_truth", "baseline_without_truth", "low_bounded", "high_bounded", "star", "word",
    ]  # fmt: skip
    metrics = ["detected_share", "ttd_rmst_s", "ttd_both_s", "unknown_to_horizon_s", "dad_median_m"]
    assert [(r["log"], r["configuration"], r["metric"]) for r in read[5:10]] == [("all", "fast", m) for m in metrics]
    fast, share = read[6], read[10]
    assert (fast["value"], fast["baseline_value"], fast["difference"], fast["n"]) == ("0.75", "1", "-0.25", "6")
    assert (fast["p_value"], fast["only_baseline"], fast["existence"]) == ("", "", "")
    assert (share["only_configuration"], share["only_baseline"], share["p_value"]) == ("0", "3", "0.25")
    assert (read[14]["difference"], read[14]["low"], read[14]["interval_over"]) == ("", "", "")
    assert (fast["low"], fast["interval"], share["interval"]) == ("", "all clusters alike", "jackknife")


def test_the_files_name_says_what_is_written(tmp_path):
    comparison = six_objects(tmp_path)
    write_comparison(comparison, tmp_path / "regret.MD")
    assert (tmp_path / "regret.MD").read_text(encoding="utf-8") == comparison_markdown(comparison)
    with pytest.raises(OutputError, match=r"expected a name that ends with \.csv or \.md, found regret\.txt"):
        check_out(tmp_path / "regret.txt")
    with pytest.raises(OutputError):
        write_comparison(comparison, tmp_path / "regret")
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        write_comparison(comparison, tmp_path / "file" / "regret.csv")


def test_results_are_not_overwritten_with_their_comparison(tmp_path):
    folder = study(tmp_path, "a", "ideal", "GT")
    with pytest.raises(OutputError, match=r"summary\.csv: expected another name, found that of a file of the results"):
        check_out(folder / "summary.csv")
    check_out(folder / "regret.csv")
    check_out(tmp_path / "summary.csv")


def test_rows_of_single_logs_are_in_the_csv_only(tmp_path):
    found = [row(name, 1.0, 30.0, log=log) for name in ("ideal", "late") for log in ("all", "b")]
    comparison = compare_folders([write_folder(tmp_path / "study", found)])
    assert comparison.table["log"].tolist() == ["all"] * 10 + ["b"] * 5  # a log may have that name, too
    assert comparison.overall["n"].tolist() == [2] * 5
    assert len([line for line in comparison_text(comparison).splitlines() if line.startswith("late")]) == 1
