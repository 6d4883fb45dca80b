"""`copem-replay convert FORMAT SOURCE --out FILE`: a command per format, because each has its own options."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from copem_replay.core.errors import InputError, escape_unprintable

app = typer.Typer(
    help="Convert a data set or a simulation to a recording.\n\nIt is an MCAP file with OSI ground truth.",
    rich_markup_mode=None,
)

Source = Annotated[Path, typer.Argument(metavar="SOURCE", help="File or folder of the format.")]
Out = Annotated[Path, typer.Option(metavar="FILE", help="Recording to write (.mcap).")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an existing recording.")]
OutFolder = Annotated[
    Path, typer.Option(metavar="DIR", help="Folder of the recordings; for a single one its file (.mcap).")
]
Only = Annotated[str | None, typer.Option(metavar="NAME", help="Only the recording of this name [all].")]
Classes = Annotated[
    list[str] | None,
    typer.Option("--class", metavar="NAME=CLASS", help="Class of a name; may be given several times."),
]
Metres = tuple[float, float, float]
_MOST_HZ = 1000.0


@app.callback(invoke_without_command=True)
def require_format(context: typer.Context) -> None:
    """Refuse a command without a format."""
    if context.invoked_subcommand is None:
        names = ", ".join(command.callback.__name__ for command in app.registered_commands if command.callback)
        raise InputError(f"copem-replay convert: expected a format, one of {names}; --help tells more")


@app.command()
def argoverse2(
    source: Source,
    out: Out,
    overwrite: Overwrite = False,
    classes: Classes = None,
    ego_size_m: Annotated[
        Metres | None, typer.Option(metavar="LENGTH WIDTH HEIGHT", help="Size of the ego vehicle [4.877 2 1.473].")
    ] = None,
    centre_from_rear_axle_m: Annotated[
        Metres | None,
        typer.Option(metavar="AHEAD LEFT UP", help="Centre of the ego's box from its rear axle [1.339 0 0.438]."),
    ] = None,
) -> int:
    """Argoverse 2: the folder of a sensor log."""
    options: dict[str, Any] = {}
    if ego_size_m is not None:
        options["ego_size_m"] = tuple(_check_positive(value, "--ego-size-m") for value in ego_size_m)
    if centre_from_rear_axle_m is not None:
        name = "--centre-from-rear-axle-m"
        options["centre_from_rear_axle_m"] = tuple(_check_finite(value, name) for value in centre_from_rear_axle_m)
    return _convert_sources("argoverse2", source, out, overwrite, classes=classes, **options)


@app.command()
def nuscenes(
    source: Source,
    out: OutFolder,
    overwrite: Overwrite = False,
    only: Only = None,
    classes: Classes = None,
    rate_hz: Annotated[
        float | None, typer.Option(metavar="HZ", help="Rate of the frames between key frames, interpolated [10].")
    ] = None,
    key_frames: Annotated[bool, typer.Option("--key-frames", help="Key frames alone, nothing interpolated.")] = False,
    ego_size_m: Annotated[
        Metres | None, typer.Option(metavar="LENGTH WIDTH HEIGHT", help="Size of the ego vehicle [4.084 1.73 1.562].")
    ] = None,
    ego_centre_m: Annotated[
        float | None, typer.Option(metavar="AHEAD", help="Centre of the ego's box ahead of its rear axle [1.385].")
    ] = None,
) -> int:
    """Tables of nuScenes or T4: a folder of scenes."""
    options: dict[str, Any] = {}
    if key_frames and rate_hz is not None:
        raise InputError("--rate-hz: expected without --key-frames, found both")
    if key_frames or rate_hz is not None:
        options["rate_hz"] = None if rate_hz is None else _check_rate(rate_hz)
    if ego_size_m is not None:
        options["ego_size_m"] = tuple(_check_positive(value, "--ego-size-m") for value in ego_size_m)
    if ego_centre_m is not None:
        options["ego_centre_m"] = _check_finite(ego_centre_m, "--ego-centre-m")
    return _convert_sources("nuscenes", source, out, overwrite, only, classes=classes, **options)


@app.command()
def opv2v(
    source: Source,
    out: OutFolder,
    overwrite: Overwrite = False,
    only: Only = None,
    classes: Classes = None,
    host: Annotated[
        str | None, typer.Option(metavar="AGENT", help="Agent that is the host [the first vehicle].")
    ] = None,
    infrastructure: Annotated[
        list[str] | None,
        typer.Option(metavar="AGENT", help="Agent that is no vehicle; may be given several times [those below 0]."),
    ] = None,
    rate_hz: Annotated[float | None, typer.Option(metavar="HZ", help="Rate of the frames [10].")] = None,
    axes: Annotated[
        str | None, typer.Option(metavar="left|right", help="Whether y is to the right, as in CARLA [by the files].")
    ] = None,
) -> int:
    """OPV2V, V2XSet, V2X-Real: a scenario, or several."""
    if axes not in (None, "left", "right"):
        raise InputError(f"--axes: expected left or right, found {axes!r}")
    rate_hz = None if rate_hz is None else _check_rate(rate_hz)
    options = {"host": host, "infrastructure": infrastructure or (), "rate_hz": rate_hz, "axes": axes}
    return _convert_sources("opv2v", source, out, overwrite, only, classes=classes, **options)


@app.command()
def v2xseq(
    source: Source,
    out: OutFolder,
    overwrite: Overwrite = False,
    only: Only = None,
    classes: Classes = None,
    ego_size_m: Annotated[
        Metres | None, typer.Option(metavar="LENGTH WIDTH HEIGHT", help="Size of the vehicle [4.9 1.9 1.5].")
    ] = None,
) -> int:
    """V2X-Seq (DAIR-V2X): a folder of sequences."""
    options: dict[str, Any] = {}
    if ego_size_m is not None:
        options["ego_size_m"] = tuple(_check_positive(value, "--ego-size-m") for value in ego_size_m)
    return _convert_sources("v2xseq", source, out, overwrite, only, classes=classes, **options)


@app.command()
def openlabel(
    source: Source,
    out: Out,
    overwrite: Overwrite = False,
    classes: Classes = None,
    rate_hz: Annotated[float | None, typer.Option(metavar="HZ", help="Rate of frames without time stamps.")] = None,
    from_system: Annotated[
        str | None, typer.Option("--from", metavar="SYSTEM", help="Coordinate system of cuboids that name none.")
    ] = None,
    to_system: Annotated[
        str | None, typer.Option("--to", metavar="SYSTEM", help="Coordinate system of the recording [the root].")
    ] = None,
) -> int:
    """OpenLABEL (KITTI, TUMTraf, …): a JSON file, or a folder."""
    rate_hz = None if rate_hz is None else _check_positive(rate_hz, "--rate-hz")
    options = {"rate_hz": rate_hz, "source": from_system, "target": to_system}
    return _convert_sources("openlabel", source, out, overwrite, classes=classes, **options)


@app.command()
def commonroad(source: Source, out: Out, overwrite: Overwrite = False, classes: Classes = None) -> int:
    """CommonRoad 2018b or 2020a: an XML file."""
    return _convert_sources("commonroad", source, out, overwrite, classes=classes)


@app.command()
def sumo(
    source: Source,
    out: Out,
    overwrite: Overwrite = False,
    types: Annotated[
        list[Path] | None, typer.Option(metavar="FILE", help="File with <vType>; may be given several times.")
    ] = None,
    host: Annotated[str | None, typer.Option(metavar="ID", help="Vehicle that is the host.")] = None,
) -> int:
    """SUMO: the XML file of --fcd-output, or packed as .xml.gz."""
    return _convert_sources("sumo", source, out, overwrite, type_files=types or (), host=host)


@app.command()
def csv(source: Source, out: Out, overwrite: Overwrite = False, classes: Classes = None) -> int:
    """CSV: a table with units in the names of its columns."""
    return _convert_sources("csv", source, out, overwrite, classes=classes)


def _check_positive(value: float, option: str) -> float:
    from copem_replay.extras.convert.conversion import parse_positive

    return parse_positive(value, option)


def _check_finite(value: float, option: str) -> float:
    from copem_replay.extras.convert.conversion import parse_number

    return parse_number(value, option)


def _check_rate(rate_hz: float) -> float:
    if _check_positive(rate_hz, "--rate-hz") > _MOST_HZ:
        raise InputError(f"--rate-hz: expected at most {_MOST_HZ:g}, found {rate_hz:g}")
    return rate_hz


def _read_classes(words: list[str]) -> dict[str, str]:
    """Kinds by name, of `NAME=CLASS`. Raises InputError."""
    from copem_replay.extras.convert.conversion import KINDS

    pairs = [(name, kind, word) for word in words for name, _, kind in [word.rpartition("=")]]
    for name, kind, word in pairs:
        if not name or kind not in KINDS:
            raise InputError(f"--class: expected NAME=CLASS with a class of {', '.join(KINDS)}, found {word!r}")
    return {name: kind for name, kind, _ in pairs}


def _convert_sources(
    format: str,
    source: Path,
    out: Path,
    overwrite: bool,
    only: str | None = None,
    /,
    *,
    classes: list[str] | None = None,
    **options: Any,
) -> int:
    """Convert, then print a line per recording and the notes. Raises InputError with all problems at once."""
    from copem_replay.extras.convert.conversion import Conversion, convert_all, plan_outputs

    conversion, meant = Conversion(), _read_classes(classes or [])
    outputs = plan_outputs(source, out, format=format, overwrite=overwrite, only=only)
    for line in convert_all(outputs, conversion, format=format, options=options, classes=meant):
        print(escape_unprintable(line))
    for note in conversion.note_lines():
        print(escape_unprintable(f"note: {note}"))
    if problems := conversion.problem_lines():
        raise InputError(problems)
    return 0
