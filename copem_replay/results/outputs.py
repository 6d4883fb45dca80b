"""The gate of every output: whether a command may write a path, and how it writes what it makes of results.

No recording, experiment or map, no file of a results folder and no input of the command is ever replaced, by whatever
name it is given. See docs/develop/decisions/results.md.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from copem_replay.core.errors import OutputError
from copem_replay.core.extras import has_extra, load_extra
from copem_replay.core.files import atomic_file, atomic_files, check_parent, remove_leftovers
from copem_replay.results.folder import MADE, MARK, add_to_made_list, list_belongings
from copem_replay.results.seals import digest_file

IsOwn = Callable[[Path], bool]
"""Whether an existing recording or map is an earlier output of the same command, which it may replace."""
_LOOKED_AT: Final = 1 << 20
"""Bytes of a file by which an experiment is told."""
_VERSION: Final = re.compile(rb"""^[\s{"']*version["']?\s*:""", re.MULTILINE)
_PARTS: Final = re.compile(rb"""(^|[{,])\s*["']?(configurations|units|logs|pems)["']?\s*:""", re.MULTILINE)


def check_outputs(outputs: Mapping[str, Path | None], inputs: Iterable[Path] = ()) -> None:
    """Raise OutputError for outputs of a command, by their options, that are among its inputs, or twice the same."""
    given = [(option, path) for option, path in outputs.items() if path is not None]
    inputs = [path for path in inputs if path.is_file()]
    for number, (option, path) in enumerate(given):
        for other, earlier in given[:number]:
            if _is_same(path, earlier):
                raise OutputError(f"{option}: expected another name than that of {other}, found {path}")
        if any(_is_same(path, each) for each in inputs):
            raise OutputError(f"{option}: expected another name, found that of an input of this command: {path}")


def _is_same(first: Path, second: Path) -> bool:
    if first.exists() and second.exists():
        return os.path.samefile(first, second)
    return os.path.realpath(first) == os.path.realpath(second)


def check_output(path: Path, is_own: IsOwn = lambda path: False) -> None:
    """Raise OutputError where a file may not be written."""
    check_parent(path)
    if path.is_dir():
        raise OutputError(f"{path}: expected a name for a file, found a folder")
    if (what := _find_result(path)) is None and path.exists() and not is_own(path):
        what = _describe_content(path)
    if what is not None:
        raise OutputError(f"{path}: expected another name, found {what}")


CONVERSION: Final = "copem_replay.conversion"
"""The metadata record of a recording that `convert` wrote: format, the source's ids by OSI id, and the notes."""


def is_converted(path: Path) -> bool:
    """Whether a file is a recording that `convert` wrote, and may replace."""
    from copem_replay.io.containers.mcap_records import DAMAGE, MAGIC, read_summary

    with suppress(OSError, *DAMAGE), path.open("rb") as file:
        summary = read_summary(file) if file.read(len(MAGIC)) == MAGIC else None
        return summary is not None and any(index.name == CONVERSION for index in summary.metadata_indexes)
    return False


def check_output_folder(folder: Path) -> None:
    """Raise OutputError where files may not be written into a folder."""
    check_parent(folder)
    if (what := _find_result(folder)) is not None:
        raise OutputError(f"{folder}: expected another name, found {what}")
    if (folder / "metadata.yaml").is_file():
        raise OutputError(f"{folder}: expected another folder, found a recording (rosbag2)")
    if folder.is_file():
        raise OutputError(f"{folder}: cannot be written: expected a folder, found a file; choose another with --out")


def _find_result(path: Path) -> str | None:
    """What a path is to a results folder that it is in, if it is a file of the results or has the name of one."""
    place = Path(os.path.realpath(path.parent)) / path.name
    for folder in place.parents:
        if (belongings := list_belongings(folder)) is not None:
            name = place.relative_to(folder).as_posix()
            if _is_replay(name):
                return f"that of a recording of the results in {folder.name}"
            if name in (MARK, MADE, *(belongings.results or ())) or _is_table(name):
                return f"that of a file of the results in {folder.name}"
    return None


def _is_replay(name: str) -> bool:
    """Whether the recording of a run that is shown may have this name."""
    if not name.endswith((".rrd", ".mcap")):
        return False
    from copem_replay.pipeline.one_run import STEM

    return name.startswith((f"{STEM}.", f"{STEM}_", f"{STEM}/"))


def _is_table(name: str) -> bool:
    """Whether a table of results has this name."""
    if not name.endswith((".csv", ".parquet")):
        return False
    from copem_replay.metrics.columns import TABLES

    return name in TABLES


def _describe_content(path: Path) -> str | None:
    """What an existing file is that no output may replace, such as `a recording`; None: it may. Raises OutputError."""
    from copem_replay.io.containers.mcap_records import MAGIC
    from copem_replay.io.log import ROS1, SQLITE

    if not path.is_file():
        return "a device or a pipe"
    try:
        with path.open("rb") as file:
            start = file.read(_LOOKED_AT)
    except OSError as error:
        raise OutputError(f"{path}: cannot be replaced: {error.strerror}") from None
    if start.startswith((MAGIC, SQLITE, ROS1)) or (start and path.suffix.lower() == ".osi"):
        return "a recording"
    if path.suffix.lower() in (".yaml", ".yml"):
        return "a file of YAML, such as an experiment"
    if not start.lstrip().startswith(b"<") and _VERSION.search(start) and _PARTS.search(start):
        return "an experiment"
    if has_extra("reader", "map format") and (name := load_extra("reader", "map format")(path)) is not None:
        return f"a map ({name})"
    return None


# What commands make of results: it is listed in their folder, and goes with them.


@contextmanager
def made_file(path: Path, *folders: Path, is_own: IsOwn = lambda path: False) -> Iterator[Path]:
    """The path to write a file at that is made of results in `folders`: complete or not at all. Raises OutputError.

    What killed processes left of it goes.
    """
    check_output(path, is_own)
    with atomic_file(path) as scratch:
        yield scratch
        for folder in folders:
            add_to_made_list(folder, [path])
    remove_leftovers(path)


@contextmanager
def made_files(
    folder: Path, names: Sequence[str], results: Path, *, is_own: IsOwn = lambda path: False, way_out: str = "",
    sealed: bool = False,
) -> Iterator[Path]:  # fmt: skip
    """A folder to write files in that are made of results: they replace those in `folder` together, as `atomic_files`
    does. `sealed`: other commands read them. Raises OutputError.
    """
    check_output_folder(folder)
    for name in names:
        check_output(folder / name, is_own)
    with atomic_files(folder, names, way_out=way_out) as scratch:
        yield scratch
        made = [name for name in names if (scratch / name).exists()]
        seals = {folder / name: digest_file(scratch / name) for name in made if sealed}
        add_to_made_list(results, [folder / name for name in made], seals)
