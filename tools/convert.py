"""Convert a data set or a simulation to OSI truth that copem-replay reads.

    python tools/convert.py FORMAT INPUT OUTPUT.mcap [options]
    python tools/convert.py scenarionet FOLDER FOLDER [options]

Formats: argoverse2, scenarionet, openlabel, commonroad, sumo, csv (docs/converters.md). Prints what was converted,
skipped and assumed. Ends 0, or 2 with one line on what is wrong with the input; the output is there in full or not at
all, and the same input gives the same bytes. What is there already is replaced with `--overwrite` only.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

from converters import argoverse2, commonroad, csv_rows, openlabel, scenarionet, sumo
from converters.parse import number, positive
from converters.scenario_folder import scenarios
from converters.trace import RECORD, Frame, Report, write
from copem_replay.core.errors import InputError
from copem_replay.core.text import counted

_MOST_LINES = 10
"""Of one kind that are printed (chosen): a data set has thousands of scenarios."""


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}; --help tells more\n")


def _positive(text: str) -> float:
    try:
        return positive(text, "option")
    except InputError:
        raise argparse.ArgumentTypeError(f"expected a number above 0, found {text!r}") from None


def _finite(text: str) -> float:
    try:
        return number(text, "option")
    except InputError:
        raise argparse.ArgumentTypeError(f"expected a number, found {text!r}") from None


def parser() -> argparse.ArgumentParser:
    top = _Parser(prog="convert.py", description="Convert a data set or a simulation to OSI truth (MCAP).")
    formats = top.add_subparsers(dest="format", metavar="FORMAT", required=True)

    def add(name: str, what: str, given: str, written: str | None = None) -> argparse.ArgumentParser:
        one = formats.add_parser(name, help=what, description=what)
        one.add_argument("input", type=Path, metavar="INPUT", help=given)
        one.add_argument("output", type=Path, metavar="OUTPUT.mcap", help=written)
        one.add_argument("--overwrite", action="store_true", help="replace a recording that is there already")
        return one

    av2 = add("argoverse2", "Argoverse 2 sensor log.", "folder of a log, with annotations.feather")
    av2.add_argument(
        "--ego-size-m",
        type=_positive,
        nargs=3,
        metavar=("LENGTH", "WIDTH", "HEIGHT"),
        default=argoverse2.EGO_SIZE_M,
        help="of the ego vehicle (default: %(default)s)",
    )
    av2.add_argument(
        "--centre-from-rear-axle-m",
        type=_finite,
        nargs=3,
        metavar=("AHEAD", "LEFT", "UP"),
        default=argoverse2.CENTRE_FROM_REAR_AXLE_M,
        help="centre of the ego's box from its rear axle (default: %(default)s)",
    )
    net = add(
        "scenarionet",
        "ScenarioNet descriptions of nuScenes, Waymo and others.",
        "pickle, or a folder of them: of a data set",
        "of a folder: another folder",
    )
    net.add_argument(
        "--ego-centre-m",
        type=_finite,
        metavar="AHEAD",
        help=f"of the position given for the ego vehicle (default: {scenarionet.EGO_CENTRE_M} for nuScenes, else 0)",
    )
    label = add("openlabel", "OpenLABEL, as of KITTI or TUMTraf.", "JSON file, or a folder of them")
    label.add_argument("--rate-hz", type=_positive, metavar="HZ", help="of frames without time stamps")
    label.add_argument("--from", dest="source", metavar="SYSTEM", help="coordinate system of cuboids that name none")
    label.add_argument(
        "--to", dest="target", metavar="SYSTEM", help="coordinate system to give them in (default: root)"
    )
    add("commonroad", "CommonRoad scenario, 2018b or 2020a.", "XML file")
    fcd = add("sumo", "SUMO floating car data.", "XML file of --fcd-output")
    fcd.add_argument("--types", type=Path, nargs="+", action="extend", default=[], metavar="FILE", help="with <vType>")
    fcd.add_argument("--host", metavar="ID", help="vehicle that is the host")
    add("csv", "Table with units in the names of its columns.", "CSV file")
    return top


def frames(given: argparse.Namespace, source: Path, report: Report) -> Iterator[Frame]:
    """Frames of the input, by the format."""
    match given.format:
        case "argoverse2":
            return argoverse2.frames(
                source,
                report,
                ego_size_m=tuple(given.ego_size_m),
                centre_from_rear_axle_m=tuple(given.centre_from_rear_axle_m),
            )
        case "scenarionet":
            return scenarionet.frames(source, report, ego_centre_m=given.ego_centre_m)
        case "openlabel":
            return openlabel.frames(source, report, rate_hz=given.rate_hz, source=given.source, target=given.target)
        case "commonroad":
            return commonroad.frames(source, report)
        case "sumo":
            return sumo.frames(source, report, type_files=given.types, host=given.host)
        case _:
            return csv_rows.frames(source, report)


def convert(given: argparse.Namespace, source: Path, output: Path) -> Report:
    """Convert one recording and return what there is to say. Raises InputError, or OSError of the output."""
    report = Report()
    write(output, frames(given, source, report), report, source=source, format_name=given.format)
    return report


def recordings(given: argparse.Namespace) -> dict[Path, Path]:
    """The input of each output. Raises InputError: there is no input, or an output is there already."""
    if not given.input.exists():
        raise InputError(f"{given.input}: no such file or folder")
    if given.format == "scenarionet" and given.input.is_dir():
        if given.output.suffix == ".mcap" or given.output.is_file():
            raise InputError(f"{given.output}: expected a folder for the recordings of one, found a file's name")
        wanted = {given.output / f"{name}.mcap": path for name, path in scenarios(given.input).items()}
    else:
        if given.output.suffix != ".mcap":
            raise InputError(f"{given.output}: expected an output that ends in .mcap, found {given.output.name!r}")
        wanted = {given.output: given.input}
    there = [output for output in wanted if output.is_file()]
    if there and not given.overwrite:
        more = f", and {counted(len(there) - 1, 'other')}" if len(there) > 1 else ""
        raise InputError(f"{there[0]}: is there already{more}; give another name, or --overwrite")
    return wanted


def main(words: list[str] | None = None) -> int:
    given = parser().parse_args(words)
    wrong: list[str] = []
    notes: Counter[tuple[str, str]] = Counter()
    assumed: Counter[str] = Counter()
    numbered, done, wanted = False, 0, dict[Path, Path]()
    try:
        wanted = recordings(given)
    except InputError as error:
        wrong += error.problems
    for output, source in wanted.items():
        try:
            report = convert(given, source, output)
        except InputError as error:
            wrong += error.problems
            continue
        except OSError as error:
            wrong.append(f"{output}: cannot be written: {error.strerror or error}")
            break
        done += 1
        objects = ", ".join(f"{many} {name}" for name, many in sorted(report.objects.items()))
        print(f"{output}: {counted(report.frames, 'frame')}, {objects}")
        notes += report.counts
        assumed.update(list(report.assumed))
        numbered |= any(name != str(ident) for ident, name in report.names.items())
    _tell(assumed, notes, numbered, len(wanted))
    _complain(wrong, len(wanted) - done, len(wanted))
    return 2 if wrong else 0


def _tell(assumed: Counter[str], notes: Counter[tuple[str, str]], numbered: bool, recordings: int) -> None:
    """Print what was skipped, assumed or put right, of all recordings together."""
    lines = [line if recordings == 1 else f"{line} ({counted(many, 'recording')})" for line, many in assumed.items()]
    if len(lines) > _MOST_LINES:
        lines[_MOST_LINES:] = [f"… and {len(lines) - _MOST_LINES} more; the metadata record {RECORD} of each has all"]
    for line in [*lines, *(f"{counted(many, noun)} {what}" for (noun, what), many in notes.items())]:
        print(f"note: {line}")
    if numbered:
        print(f"note: objects are numbered; the file's metadata record {RECORD} has their names")


def _complain(wrong: list[str], left: int, recordings: int) -> None:
    """Print what is wrong, a line each, and of many recordings how many there are not."""
    print("\n".join(wrong[:_MOST_LINES]), end="\n" if wrong else "", file=sys.stderr)
    if len(wrong) > _MOST_LINES:
        print(f"… and {len(wrong) - _MOST_LINES} more", file=sys.stderr)
    if wrong and recordings > 1:
        print(f"{left} of {counted(recordings, 'scenario')} not converted", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
