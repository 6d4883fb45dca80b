"""Kill commands at many moments, as `kill -9` does, and look at what is left: `python tools/kill_runs.py --kills 300`.

    python tools/kill_runs.py fit --kills 50     # one of: run (default), cluster, fit, convert, plot, report

Half of the moments are numbered steps (a file opened, a folder made, a name given or taken where the results go: what
Python tells its audit hooks of), half random times. After each kill, the results folder is either what it was or what
it was going to be, and a file of the user's is in it; a page that was made of the old results is there with them and
gone with them. A run after that gives the same bytes as ever, and leaves nothing beside the folder. The .rrd, whose
bytes differ from run to run, has to be there. For an instant, between two renames, nothing has the folder's name, and
the next run puts it back. A fit is such a folder. Of `convert`, `plot` and `report` the recording, the folder of
figures and the page are what they were or what they were going to be. Of `cluster` (`run --cluster local:2`) no process
stays longer than a minute.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).parents[1]
_STEPS = {"open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link", "os.truncate", "os.scandir"}
_NOTE, _PAGE = "notes.txt", "page.html"
COMMANDS = ("run", "cluster", "fit", "convert", "plot", "report")
Files = dict[str, bytes]


@dataclass
class Found:
    """What was looked at, and what was wrong."""

    kills: int = 0
    unscathed: int = 0  # the run had ended before it was to be killed
    nothing: int = 0  # of those killed: no folder, as before
    old: int = 0
    new: int = 0
    gaps: int = 0  # neither, between two steps
    leftovers: int = 0  # kills after which something stood beside the folder
    wrong: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        told = f"{self.kills} kills, {self.unscathed} after the run had ended: no folder as before {self.nothing}, "
        told += f"old {self.old}, new {self.new}, between two steps {self.gaps}"
        return f"{told}; something beside it {self.leftovers}; wrong: {len(self.wrong)}"


_GONE_S = 60.0
"""Within this time all processes that a killed command started have ended."""


@dataclass
class Command:
    """What is killed: its arguments, by 1 and 2 for two outputs that differ, and the file or folder that it writes.

    `keeps`: whether that is a folder of results, in which the user's files stay. `load`: imports and loads what it
    needs, so that forks need not.
    """

    arguments: dict[int, list[str]]
    out: Path
    keeps: bool
    load: Callable[[], object]
    processes: bool = False


class Trial:
    """A command in a folder of its own, called by forks of this process, which has loaded what they need."""

    def __init__(self, here: Path, command: Command) -> None:
        self.here, self.command, self.out = here, command, command.out
        self.expected: dict[int, Files] = {}
        self.beside: list[str] = []
        self.last = 0  # the last process, and the number of its group

    def forked(self, seed: int, before: Callable[[], None] = lambda: None) -> int:
        """Begin a run; the process that does it."""
        with warnings.catch_warnings():  # from Python 3.12 on: threads that idle in pools hold no lock
            warnings.filterwarnings("ignore", "This process .* is multi-threaded", DeprecationWarning)
            child = os.fork()
        if child:
            self.last = child
            return child
        try:
            from copem_replay.cli import main as cli

            nothing = os.open(os.devnull, os.O_RDWR)
            for fd in (1, 2):
                os.dup2(nothing, fd)
            os.chdir(self.here)
            sys.argv = ["copem-replay", *self.command.arguments[seed]]
            os.setpgid(0, 0)
            before()
            os._exit(cli._run_to_exit_code())
        except BaseException:
            os._exit(99)

    def run(self, seed: int) -> None:
        """A run from beginning to end."""
        code = ended(self.forked(seed))
        if code not in (0, 1):
            raise SystemExit(f"a run that was not killed ended with {code}")

    def steps(self, seed: int) -> int:
        """How many steps a run has."""
        counter = self.here / "steps"
        child = self.forked(seed, lambda: self.kill_at(None, counter))
        if ended(child) not in (0, 1):
            raise SystemExit("the run whose steps were counted failed")
        return len(counter.read_bytes())

    def kill_at(self, last: int | None, counter: Path) -> None:
        """Kill this process before its step `last`; None: count its steps into a file."""
        out = os.open(counter, os.O_WRONLY | os.O_CREAT | os.O_TRUNC) if last is None else -1
        count, where = 0, str(self.out.parent)

        def hook(event: str, arguments: tuple[object, ...]) -> None:
            nonlocal count
            if event not in _STEPS or not any(str(each).startswith(where) for each in arguments[:2]):
                return
            if last is None:
                os.write(out, b".")
            elif count == last:
                os.kill(os.getpid(), signal.SIGKILL)
            count += 1

        sys.addaudithook(hook)

    def files(self) -> Files:
        """What is in the results folder, or the file that is written; of an .rrd that it is there, without its seal."""
        from copem_replay.results.folder import MADE

        if self.out.is_file():
            return {self.out.name: self.out.read_bytes()}
        paths = [path for path in sorted(self.out.rglob("*")) if path.is_file()]
        files = {str(p.relative_to(self.out)): b"" if p.suffix == ".rrd" else p.read_bytes() for p in paths}
        made = [line for line in files.pop(MADE, b"").splitlines(keepends=True) if b'.rrd"' not in line]
        return files | ({MADE: b"".join(made)} if made else {})

    def add_files(self) -> None:
        """A file of the user's, and one that was made of the results, as `report` makes it."""
        from copem_replay.results.folder import add_to_made_list

        if not self.command.keeps:
            return
        (self.out / _NOTE).write_text("mine\n")
        add_to_made_list(self.out, [self.out / _PAGE])
        (self.out / _PAGE).write_text("of the old results\n")

    def check(self, seeds: tuple[int | None, int], found: Found, what: str) -> None:
        """What a killed run left: it is that of one of two seeds (None: there was nothing)."""
        from copem_replay.results.folder import MADE

        self.check_processes(found, what)
        names = os.listdir(self.out.parent) if self.out.parent.exists() else []
        found.leftovers += bool(set(names) - {*self.beside, self.out.name})
        before, seed = seeds
        files = self.files()
        if not files:
            found.nothing += before is None
            found.gaps += before is not None
            return
        if self.command.keeps:
            mine = files.pop(_NOTE, None)
            if before is not None and mine != b"mine\n":
                found.wrong.append(f"{what}: {_NOTE} is gone")
            made = [files.pop(name) for name in (_PAGE, MADE) if name in files]
            if len(made) != (2 if before is not None and files == self.expected[before] else 0):
                found.wrong.append(f"{what}: {_PAGE} is beside other results than its own, or gone without them")
        if files == self.expected[seed]:
            found.new += 1
        elif before is not None and files == self.expected[before]:
            found.old += 1
        else:
            found.wrong.append(f"{what}: half-written: {sorted(files)}")

    def look_again(self, seeds: tuple[int | None, int], found: Found, what: str) -> None:
        """After a run from beginning to end: the same bytes, and nothing beside the folder."""
        before, seed = seeds
        self.run(seed)
        files = self.files()
        if files.pop(_NOTE, None) != (None if before is None or not self.command.keeps else b"mine\n"):
            found.wrong.append(f"{what}: {_NOTE} is gone after the next run")
        if files != self.expected[seed]:
            found.wrong.append(f"{what}: the run after it gave other results")
        if left := sorted(set(os.listdir(self.out.parent)) - {*self.beside, self.out.name}):
            found.wrong.append(f"{what}: left for good: {left}")

    def check_processes(self, found: Found, what: str) -> None:
        """Whether all processes of the last command end; those that stay are ended here."""
        until = time.monotonic() + _GONE_S
        while left := processes_of(self.last):
            if time.monotonic() > until:
                found.wrong.append(f"{what}: {len(left)} processes are left")
                for number in left:
                    os.kill(number, signal.SIGKILL)
                return
            time.sleep(0.1)


def ended(child: int) -> int | None:
    """How a child ended; None: it was killed."""
    _, status = os.waitpid(child, 0)
    return None if os.WIFSIGNALED(status) else os.WEXITSTATUS(status)


def processes_of(group: int) -> list[int]:
    """Processes of a group that have not ended."""
    numbers = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            state, _, of = path.read_text().rpartition(")")[2].split()[:3]
            if int(of) == group and state != "Z":
                numbers.append(int(path.parent.name))
    return numbers


def load_run(path: Path) -> None:
    """Import and load what a run needs: all but Rerun's threads, which no fork would have."""
    import copem_replay.io.write.mcap  # noqa: F401
    from copem_replay.experiment.file import log_paths, read_experiment_file
    from copem_replay.experiment.validate import find_problems, read_logs
    from copem_replay.pipeline.run import run_experiment

    source = read_experiment_file(path)
    experiment, _ = find_problems(source)
    assert experiment is not None
    recordings, _ = read_logs(experiment, log_paths(source)[0], source)
    run_experiment(experiment, recordings)


def run_command(here: Path, experiment: Path, *more: str) -> Command:
    """`run` of an experiment with two seeds."""
    both = {}
    for seed in (1, 2):
        both[seed] = ["run", str(experiment), "--overwrite", "--seed", str(seed), "--out", str(here / "out/e")]
        both[seed] += more or ("--jobs", "1")
    return Command(both, here / "out/e", True, lambda: load_run(experiment), bool(more))


def commands_of(here: Path, experiment: Path) -> dict[str, Callable[[], Command]]:
    """The commands, each of which makes what it works on when it is asked for."""
    results = here / "results"

    def make_results() -> None:
        from copem_replay.api.run import run

        run(experiment, jobs=1).save(results)

    def fit() -> Command:
        make_results()
        unit = "{on: ego, height_m: 1.8, recorded: {topic: copem/PEM/objects}}"
        text = f"version: 1\nlogs: [results/replay.mcap]\nunits: {{ego: {unit}}}\n"
        text += "configurations: {a: {units: [ego]}}\n"
        (here / "fit.yaml").write_text(text)
        words = [
            "fit",
            str(here / "fit.yaml"),
            "--unit",
            "ego",
            "--folds",
            "2",
            "--out",
            str(here / "out/f"),
            "--overwrite",
        ]

        def load() -> None:
            from copem_replay.extras.fitting.api import fit
            from copem_replay.extras.fitting.page import fit_page

            fit_page(fit(here / "fit.yaml", "ego", folds=2).found)

        return Command({1: words, 2: [*words, "--by", "range"]}, here / "out/f", True, load)

    def convert() -> Command:
        table = "time_s,id,class,x_m,y_m,yaw_deg,length_m,width_m\n"
        both = {}
        for k in (1, 2):
            rows = "".join(f"{t / 10},{i},car,{t * k},{i},0,4,2\n" for t in range(200) for i in range(5))
            (here / f"{k}.csv").write_text(table + rows)
            both[k] = ["convert", "csv", str(here / f"{k}.csv"), "--out", str(here / "out/c.mcap"), "--overwrite"]

        def load() -> None:
            from copem_replay.extras.convert.conversion import convert_source

            convert_source(here / "1.csv", here / "warm.mcap", format="csv")

        return Command(both, here / "out/c.mcap", False, load)

    def plot() -> Command:
        make_results()
        words = ["plot", str(results), "--out", str(here / "out/figures"), "--configurations"]

        def load() -> None:
            from copem_replay.api.plot import write_figures

            write_figures(results, here / "warm")

        return Command({1: [*words, "PEM"], 2: [*words, "PEM,coPEM"]}, here / "out/figures", False, load)

    def report() -> Command:
        make_results()
        words = ["report", str(results), "--out", str(here / "out/page.html"), "--baseline"]

        def load() -> None:
            from copem_replay.api.results import write_report

            write_report(results, here / "warm.html")

        return Command({1: [*words, "PEM"], 2: [*words, "coPEM"]}, here / "out/page.html", False, load)

    return {
        "run": lambda: run_command(here, experiment),
        "cluster": lambda: run_command(here, experiment, "--cluster", "local:2"),
        "fit": fit, "convert": convert, "plot": plot, "report": report,
    }  # fmt: skip


def kill(here: Path, command: Command, kills: int, seed: int = 1, *, progress: bool = False) -> Found:
    """Kill a command so many times: half at steps spread over all there are, half after random times.

    Every tenth time there is no output yet.
    """
    command.load()
    command.out.parent.mkdir(exist_ok=True)
    rng = random.Random(seed)
    trial, found = Trial(here, command), Found()
    for number in (1, 2):
        trial.run(number)
        trial.expected[number] = trial.files()
    begin = time.perf_counter()
    trial.run(2)
    takes_s = time.perf_counter() - begin
    steps = trial.steps(2)
    trial.add_files()
    trial.beside = os.listdir(trial.out.parent)
    ends = [k * steps // (kills // 2) for k in range(kills // 2 + 1)]
    counted = [rng.randrange(low, max(high, low + 1)) for low, high in pairwise(ends)]
    moments: list[int | float] = [*counted, *(rng.uniform(0, takes_s) for _ in range(kills - len(counted)))]
    rng.shuffle(moments)
    there: int | None = 2
    for k, moment in enumerate(moments):
        if k % 10 == 9:
            for path in [*sorted(trial.out.rglob("*"), reverse=True), trial.out]:
                path.rmdir() if path.is_dir() else path.unlink()
            there = None
        new = 1 if there == 2 else 2
        what = f"kill {k} {'before step' if isinstance(moment, int) else 'after s'} {moment:.6g}"
        if isinstance(moment, int):
            child = trial.forked(new, lambda last=moment: trial.kill_at(last, here / "steps"))
        else:
            child = trial.forked(new)
            time.sleep(moment)
            os.kill(child, signal.SIGKILL)
        found.kills += 1
        found.unscathed += ended(child) is not None
        trial.check((there, new), found, what)
        trial.look_again((there, new), found, what)
        trial.add_files()
        there = new
        if progress:
            print(f"{what}: {found}", flush=True)
    return found


def main() -> None:
    sys.path.insert(0, str(ROOT))
    from tests.helpers.experiments import changed, drive

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", nargs="?", default="run", choices=COMMANDS)
    parser.add_argument("--kills", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--verbose", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        here = Path(folder)
        drive(here / "drive.mcap")
        (here / "e.yaml").write_text(changed("show: {run: 0}"))
        begin = time.perf_counter()
        command = commands_of(here, here / "e.yaml")[arguments.command]()
        found = kill(here, command, arguments.kills, arguments.seed, progress=arguments.verbose)
        print(f"{found}; {time.perf_counter() - begin:.0f} s")
        print("\n".join(found.wrong), end="")
        sys.exit(bool(found.wrong))


if __name__ == "__main__":
    main()
