"""Outputs of commands, by their options: the gate is asked about them before a command does anything."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, get_args, get_type_hints

from typer.models import ArgumentInfo, OptionInfo

from copem_replay.core.errors import OutputError

INPUTS: Final = ("log", "maps", "criteria", "before", "types", "with_recording")
"""Options that name files or folders to read: all others that name one are outputs."""
_PATHS: Final = ("FILE", "FOLDER", "DIR")


def guard_outputs(command: Callable[..., int]) -> Callable[..., int]:
    """The command, refusing outputs that would replace what no command may replace. It raises OutputError."""

    @functools.wraps(command)
    def guarded(**values: Any) -> int:
        if given := {name: values[name] for name in list_outputs(command) if values.get(name) not in (None, "")}:
            _check_outputs(command, given, values)
        return command(**values)

    return guarded


def list_outputs(command: Callable[..., int]) -> dict[str, OptionInfo]:
    """The options of a command that name a file or folder to write, by parameter."""
    return {
        name: info
        for name, (info, of) in _list_parameters(command).items()
        if isinstance(info, OptionInfo) and name not in INPUTS and (_takes_path(of) or info.metavar in _PATHS)
    }


def _list_parameters(command: Callable[..., int]) -> dict[str, tuple[OptionInfo | ArgumentInfo, Any]]:
    """What is said of each option and argument, and its type."""
    parameters = {}
    for name, hint in get_type_hints(command, include_extras=True).items():
        for info in getattr(hint, "__metadata__", ()):
            if isinstance(info, OptionInfo | ArgumentInfo):
                parameters[name] = info, hint.__origin__
    return parameters


def _takes_path(hint: Any) -> bool:
    return hint is Path or any(_takes_path(part) for part in get_args(hint))


def _check_outputs(command: Callable[..., int], given: dict[str, Any], values: dict[str, Any]) -> None:
    from copem_replay.results.outputs import check_output, check_output_folder, check_outputs, is_converted

    options = list_outputs(command)
    outputs = {name: Path(value) for name, value in given.items() if "://" not in str(value) and str(value) != "-"}
    read = []
    for name, (info, _) in _list_parameters(command).items():
        if name in INPUTS or isinstance(info, ArgumentInfo):
            value = values.get(name) or []
            read += [Path(path) for path in (value if isinstance(value, list | tuple) else [value])]
    flags = {name: (options[name].param_decls or (f"--{name.replace('_', '-')}",))[0] for name in outputs}
    try:
        check_outputs({flags[name]: path for name, path in outputs.items()}, read)
        for name, path in outputs.items():
            if options[name].metavar == "FILE" or path.is_file():
                check_output(path, *([is_converted] if "overwrite" in values else []))
            else:
                check_output_folder(path)
    except OSError as error:
        raise OutputError(f"{error.filename}: cannot be written: {error.strerror}") from None
