"""Convert a data set or a simulation to OSI truth that copem-replay reads.

    python tools/convert.py FORMAT INPUT OUTPUT.mcap [options]

Formats: argoverse2, scenarionet, openlabel, commonroad, sumo, csv (docs/converters.md). Prints what was converted,
skipped and assumed. Ends 0, or 2 with one line on what is wrong with the input; the output is there in full or not at
all, and the same input gives the same bytes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

from converters import argoverse2, commonroad, csv_rows, openlabel, scenarionet, sumo
from converters.parse import number, positive
from converters.trace import RECORD, Frame, Report, write
from copem_replay.errors import InputError
from copem_replay.wording import counted


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

    def add(name: str, what: str, given: str) -> argparse.ArgumentParser:
        one = formats.add_parser(name, help=what, description=what)
        one.add_argument("input", type=Path, metavar="INPUT", help=given)
        one.add_argument("output", type=Path, metavar="OUTPUT.mcap")
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
    net = add("scenarionet", "ScenarioNet description of nuScenes and others.", "pickle")
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


def frames(given: argparse.Namespace, report: Report) -> Iterator[Frame]:
    """Frames of the input, by the format."""
    match given.format:
        case "argoverse2":
            return argoverse2.frames(
                given.input,
                report,
                ego_size_m=tuple(given.ego_size_m),
                centre_from_rear_axle_m=tuple(given.centre_from_rear_axle_m),
            )
        case "scenarionet":
            return scenarionet.frames(given.input, report, ego_centre_m=given.ego_centre_m)
        case "openlabel":
            return openlabel.frames(
                given.input, report, rate_hz=given.rate_hz, source=given.source, target=given.target
            )
        case "commonroad":
            return commonroad.frames(given.input, report)
        case "sumo":
            return sumo.frames(given.input, report, type_files=given.types, host=given.host)
        case _:
            return csv_rows.frames(given.input, report)


def convert(given: argparse.Namespace) -> Report:
    """Convert and return what there is to say. Raises InputError, or OSError of the output."""
    if given.output.suffix != ".mcap":
        raise InputError(f"{given.output}: expected an output that ends in .mcap, found {given.output.name!r}")
    if not given.input.exists():
        raise InputError(f"{given.input}: no such file or folder")
    report = Report()
    write(given.output, frames(given, report), report, source=given.input, format_name=given.format)
    return report


def main(words: list[str] | None = None) -> int:
    given = parser().parse_args(words)
    try:
        report = convert(given)
    except InputError as error:
        print("\n".join(error.problems), file=sys.stderr)
        return 2
    except OSError as error:
        print(f"{given.output}: cannot be written: {error.strerror or error}", file=sys.stderr)
        return 2
    objects = ", ".join(f"{many} {name}" for name, many in sorted(report.objects.items()))
    print(f"{given.output}: {counted(report.frames, 'frame')}, {objects}")
    for line in report.lines():
        print(f"note: {line}")
    if any(name != str(ident) for ident, name in report.names.items()):
        print(f"note: objects are numbered; the file's metadata record {RECORD} has their names")
    return 0


if __name__ == "__main__":
    sys.exit(main())
