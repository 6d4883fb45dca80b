"""Output to the terminal: answers on stdout, notes, problems and progress on stderr; and options shared by commands.

Lines fit the terminal's width, and control characters in names are escaped.
"""

from __future__ import annotations

import shutil
import sys
import time
import unicodedata
from collections.abc import Callable, Collection, Iterable, Sequence
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TextIO, TypeAlias, TypeVar

import typer

from copem_replay.core.compiled import compiling
from copem_replay.core.errors import InputError, count_noun, is_url, local_path, strip_credentials, wrap_line

if TYPE_CHECKING:
    from copem_replay.results.verdicts import Judgement


# Arguments and options of several commands.

ExperimentFile: TypeAlias = Annotated[Path, typer.Argument(metavar="EXPERIMENT", help="Experiment file (YAML).")]
ResultsFolder: TypeAlias = Annotated[Path, typer.Argument(metavar="FOLDER", help="Results folder.")]


def take_local_paths(paths: list[Path]) -> list[Path]:
    """The paths, those of `file://` URLs without it. Raises InputError for any other URL."""
    return [_take_local_path(path) for path in paths]


def _take_local_path(path: Path) -> Path:
    scheme, colon, rest = str(path).partition(":/")  # two slashes are one in a path
    if not colon or not is_url(url := f"{scheme}://{rest}") or path.exists():
        return path
    if scheme.lower() == "file":
        return Path(local_path(f"file:///{rest.lstrip('/')}"))
    raise InputError(
        f"{strip_credentials(url)}: expected a recording on this machine, found a URL; fetch it first "
        "(`run`, `check` and `--log` take URLs)"
    )


LogFiles: TypeAlias = Annotated[
    list[Path],
    typer.Argument(
        metavar="LOG", help="Recordings: MCAP files, rosbag2 folders, .osi files.", callback=take_local_paths
    ),
]
Logs: TypeAlias = Annotated[
    list[str] | None,
    typer.Option("--log", metavar="FILE", help="Use this recording instead of those in the experiment."),
]
Ego: TypeAlias = Annotated[str | None, typer.Option("--ego", metavar="ID", help="Id of the ego vehicle.")]
FromS: TypeAlias = Annotated[
    float | None,
    typer.Option("--from", metavar="SECONDS", help="Start of the window to read, since the log's start [0]."),
]
ToS: TypeAlias = Annotated[
    float | None,
    typer.Option("--to", metavar="SECONDS", help="End of the window to read, since the log's start [its end]."),
]
OneDrive: TypeAlias = Annotated[
    bool, typer.Option("--together", help="The recordings are of one drive: estimate their clock offsets.")
]
Baseline: TypeAlias = Annotated[
    str | None, typer.Option("--baseline", metavar="NAME", help="Configuration to compare with [the ideal].")
]


By: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        "--by",
        metavar="ENTRY",
        help="Also by groups: log, class, began, range_at_onset, area, tags.NAME; a cross: log*class [as in results].",
    ),
]


def split_entries(entries: list[str] | None) -> list[str] | None:
    """The entries of every `--by`, between the commas; None without any."""
    return None if entries is None else [name for entry in entries for name in split_names(entry) or ()]


def split_names(names: str | None) -> list[str] | None:
    """The names between the commas, without spaces around them; None gives None."""
    return None if names is None else [name.strip() for name in names.split(",")]


def escape_controls(text: str) -> str:
    """One line: control characters and line breaks of file names and keys become escapes."""
    harmful = {c for c in text if unicodedata.category(c)[0] == "C" or c in "\u2028\u2029"}
    return "".join(c.encode("unicode_escape").decode() if c in harmful else c for c in text)


def width_of(stream: TextIO | None) -> int | None:
    """Characters per line; None for files and pipes, which get every line unbroken."""
    return shutil.get_terminal_size().columns if stream is not None and stream.isatty() else None


def print_line(line: str) -> None:
    """Print a line on stdout."""
    print_blocks([[line]])


def print_blocks(blocks: Iterable[Sequence[str]]) -> None:
    """Print blocks of lines on stdout, with an empty line between blocks."""
    width = width_of(sys.stdout)
    print("\n\n".join("\n".join(_fit_line(line, width) for line in block) for block in blocks))


def print_table(text: str, bold: Collection[str] = ()) -> None:
    """Print the text of tables on stdout; in a terminal, rows of the configurations in `bold` are bold."""
    width = width_of(sys.stdout)
    for line in text.split("\n"):
        fitted = _fit_line(line, width)
        print(f"\x1b[1m{fitted}\x1b[0m" if width is not None and line.split("  ")[0] in bold else fitted)


_PIPED = 120
"""Characters per line of a screen in files and pipes."""


def print_rows(lines: Iterable[str], bold: Collection[str] = ()) -> None:
    """Print lines of a screen on stdout; in a terminal, those in `bold` are bold."""
    width = width_of(sys.stdout)
    for line in lines:
        fitted = _fit_line(line, width or _PIPED)
        print(f"\x1b[1m{fitted}\x1b[0m" if width is not None and line in bold else fitted)


def print_answer(sentences: Sequence[str]) -> None:
    """Print the answer, the last paragraph of a command, each sentence on lines of its own."""
    print_rows(["", *sentences])


def print_problems(lines: Iterable[str]) -> None:
    """Print problems on stderr."""
    width = width_of(sys.stderr)
    for line in lines:
        print(_fit_line(line, width), file=sys.stderr)


def _fit_line(line: str, width: int | None) -> str:
    return "\n".join(wrap_line(escape_controls(line), width))


def print_notes(lines: Iterable[str]) -> None:
    """Print notes on stderr."""
    print_problems(f"note: {line}" for line in lines)


MOST_NOTES = 4
"""Lines of notes: more are not read."""


def print_first_notes(lines: Sequence[str], *, explain: bool) -> None:
    """Print the first notes on stderr, one at least, and how many others there are; all of them with `explain`."""
    ends = accumulate(len(wrap_line(f"note: {line}", width_of(sys.stderr))) for line in lines)
    shown = len(lines) if explain else max(1, sum(end <= MOST_NOTES for end in ends))
    print_notes(lines[:shown])
    if (more := len(lines) - shown) > 0:
        print_problems([f"and {count_noun(more, 'more note')}: --explain"])


def print_verdicts(verdicts: Judgement) -> None:
    """Print verdicts on stdout: the table, what is undecided and why, and how many pass."""
    from copem_replay.results.verdicts import verdicts_text

    print_blocks([verdicts_text(verdicts, width_of(sys.stdout)).splitlines()])


# Progress on stderr: a bar in a terminal; elsewhere a line a minute, from the first minute on.

T = TypeVar("T")
Progress = Callable[[int, int], None]
EVERY_S = 60.0
"""Interval of progress lines without a terminal: an hour of work is about a page of log."""
_MINUTE_S, _HOUR_S = 60.0, 3600.0


def show_progress(label: str, work: Callable[[Progress], T]) -> T:
    """The result of `work`, which reports its progress: shown as what is done, per cent and time left."""
    if sys.stderr is None or not sys.stderr.isatty():
        return work(ProgressLines(label))
    from rich.console import Console
    from rich.progress import BarColumn, Task, TextColumn
    from rich.progress import Progress as Bar
    from rich.text import Text

    class Words(TextColumn):
        """The words of the last report, or that something is compiled now."""

        def render(self, task: Task) -> Text:
            return Text(f"{label}: {COMPILING}") if compiling.running else super().render(task)

    lines, console = ProgressLines(label), Console(stderr=True)
    with Bar(BarColumn(), Words("{task.description}"), console=console, transient=True) as bar:
        task = bar.add_task(label, total=None)

        def show(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total, description=lines.words(done, total))

        return work(show)


COMPILING = "compiling (once)"
"""Stands in place of the time left while code is compiled, which is then in the cache."""


class TimeLeft:
    """How long the rest takes, by how long what was done since the first report took.

    What comes before the first report is no measure of the rest: logs are read in it. Nor is what comes before the last
    kernel was compiled.
    """

    def __init__(self) -> None:
        self._first: tuple[float, int] | None = None
        self._begun = compiling.begun

    def words(self, now_s: float, done: int, total: int) -> list[str]:
        """`4 minutes left`, as a list; empty where nothing is known of it, or nothing is left."""
        if compiling.begun != self._begun:
            self._begun, self._first = compiling.begun, None
        if compiling.running and done < total:
            return [COMPILING]
        if done and self._first is None:
            self._first = now_s, done
        if self._first is None or not self._first[1] < done < total:
            return []
        first_s, first = self._first
        return [f"{format_duration((now_s - first_s) * (total - done) / (done - first))} left"]


class ProgressLines:
    """Progress for logs and pipes: `replaying: 37 %, 4 minutes left`. `clock`: monotonic seconds."""

    def __init__(self, what: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._what, self._clock, self._left = what, clock, TimeLeft()
        self._printed_s = clock()

    def __call__(self, done: int, total: int) -> None:
        """Print a line if the last one is at least `EVERY_S` old."""
        words = self.words(done, total)
        if self._clock() - self._printed_s >= EVERY_S and 0 < done < total:
            self._printed_s = self._clock()
            print_problems([words])

    def words(self, done: int, total: int) -> str:
        """The progress in one line."""
        return ", ".join([f"{self._what}: {100 * done // total} %", *self._left.words(self._clock(), done, total)])


def format_duration(time_s: float) -> str:
    """A rounded time in words: `40 seconds`, `3 minutes`, `2 h 10 min`."""
    if time_s < _MINUTE_S:
        return count_noun(max(1, round(time_s)), "second")
    minutes = round(time_s / _MINUTE_S)
    if time_s < _HOUR_S:
        return count_noun(minutes, "minute")
    return f"{minutes // 60} h {minutes % 60} min"
