"""The command line `copem-replay`: its commands, and the one place where errors become exit codes.

0 done · 1 done, but a log was skipped, a replay or page could not be written, a criterion does not pass, or a fitted
model fails its replay check · 2 wrong input: plain lines on stderr · 70 internal error: traceback · 130 interrupted.
"""

from __future__ import annotations

import sys

try:  # an interrupt during the imports, too, ends without a traceback
    import gc
    import io
    import os
    import signal
    import traceback
    from contextlib import suppress
    from itertools import chain
    from typing import Annotated, Any

    import typer
    import typer.core

    from copem_replay.cli import inspect, results, run
    from copem_replay.cli.guard import guard_outputs
    from copem_replay.cli.terminal import print_problems
    from copem_replay.core.compiled import call_in_room
    from copem_replay.core.errors import CopemError, InputError
    from copem_replay.core.extras import EXTRAS, has_extra, load_extra
    from copem_replay.core.kernel_cache import cache_note
    from copem_replay.core.waiting import tell_waits
except KeyboardInterrupt:
    print("interrupted", file=sys.stderr)
    sys.exit(130)


class _Grouped(typer.core.TyperGroup):
    """The commands of `--help` in groups; those of no group are of the first."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the names and the first line of each."""
        named = [[c if isinstance(c, str) else c.__name__ for c in commands] for commands in GROUPS.values()]
        named[0] += [name for name in self.commands if not any(name in group for group in named)]
        width = formatter.width - max(map(len, self.commands)) - 6
        for title, names in zip(GROUPS, named, strict=True):
            with formatter.section(title):
                formatter.write_dl([(name, self.commands[name].get_short_help_str(width)) for name in names])


app = typer.Typer(
    cls=_Grouped,
    help="Replay recorded traffic through perception error models of one or many cooperating units.",
    add_completion=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback(invoke_without_command=True)
def version(
    context: typer.Context,
    show: Annotated[bool, typer.Option("--version", help="Print the version.", is_eager=True)] = False,
) -> None:
    """Print the version."""
    if show:
        from importlib.metadata import version as installed

        print(f"copem-replay {installed('copem-replay')}")
        raise typer.Exit(0)
    if context.invoked_subcommand is None:
        commands = ", ".join(typer.main.get_group(app).commands)
        raise InputError(f"copem-replay: expected a command, one of {commands}; --help tells more")


GROUPS = {
    "From a recording to an experiment": (inspect.info, inspect.init, inspect.check, inspect.schema, inspect.samples),
    "Replay": (run.run, "why", "fit"),
    "Judge": (results.compare, results.verdict, "require", "history"),
    "Look": (results.view, results.report, results.plot, "film", "layout", "export"),
}
"""Commands by what they are for: functions of the core, names of extras. Extras of no group are of the first."""


def _add_extra(name: str) -> None:
    """Add the command of an extra; where the extra is not installed, one that says so."""
    if not has_extra("command", name):

        @app.command(name, add_help_option=False, context_settings={"ignore_unknown_options": True})
        def say_missing(arguments: Annotated[list[str] | None, typer.Argument(hidden=True)] = None) -> None:
            """Not installed: `copem_replay/extras` lacks it."""
            load_extra("command", name)

    elif isinstance(command := load_extra("command", name), typer.Typer):
        for subcommand in command.registered_commands:
            subcommand.callback = subcommand.callback and guard_outputs(subcommand.callback)
        app.add_typer(command, name=name)
    else:
        app.command(name)(guard_outputs(command))


_OF_NO_GROUP = tuple(name for name in EXTRAS["command"] if name not in chain(*GROUPS.values()))
for commands_of_group in (*GROUPS.values(), _OF_NO_GROUP):
    for command in commands_of_group:
        if isinstance(command, str):
            _add_extra(command)
        else:
            app.command()(guard_outputs(command))


def main() -> None:
    """Entry point: runs a command and ends with its exit code."""
    gc.set_threshold(100_000, 50, 100)  # at Python's own thresholds a tenth of the imports' time is garbage collection
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a terminal without “×” gets `\\xd7`
    exit_on_signals()
    tell_waits(lambda words: print_problems([words]))
    code = _run_to_exit_code()
    if (note := cache_note()) is not None:
        print_problems([f"note: {note}"])
    gc.freeze()  # else Python looks through all objects once more as it ends: up to half a second
    sys.exit(code)


def exit_on_signals() -> None:
    """Have SIGTERM and, where the system has it, SIGHUP raise SystemExit, so that unfinished files are removed."""
    for number in (signal.SIGTERM, getattr(signal, "SIGHUP", None)):
        if number == signal.SIGTERM or (number and signal.getsignal(number) != signal.SIG_IGN):  # nohup ignores SIGHUP
            signal.signal(number, lambda number, frame: sys.exit(128 + number))


def _run_to_exit_code() -> int:
    try:
        code = call_in_room(_call_command, sys.argv[1:])
        if sys.stdout is not None:
            sys.stdout.flush()
        return code
    except CopemError as error:
        print_problems(str(error).splitlines())
        return 2
    except (KeyboardInterrupt, typer.Abort) as error:
        print_problems([str(error) or "interrupted"])
        return 130
    except BrokenPipeError:  # the reader of the output has gone: `copem-replay info … | head`
        _discard_output()
        return 0
    except MemoryError:
        print_problems(["copem-replay: not enough memory; take fewer runs, units or objects at a time"])
        return 2
    except Exception as error:
        if hasattr(error, "format_message"):  # typer on options and arguments
            print_problems([f"copem-replay: {' '.join(error.format_message().split())}"])
            return 2
        if isinstance(error, OSError) and not isinstance(error, FileNotFoundError | FileExistsError):
            _discard_output()  # a full disk, a failing device, no permission: no internal error
            print_problems(
                [f"copem-replay: {f'{error.filename}: ' if error.filename else ''}{error.strerror or error}"]
            )
            return 2
        if isinstance(error, RuntimeError) and str(error).startswith("cannot cache function"):  # Numba's words
            print_problems(
                ["copem-replay: no folder to cache compiled code in; set NUMBA_CACHE_DIR to one that can be written"]
            )
            return 2
        traceback.print_exc()
        print("copem-replay: internal error; please report it with the lines above", file=sys.stderr)
        return 70


def _call_command(arguments: list[str]) -> int:
    """Run a command and return its exit code. Typer's own `main` would print errors and interrupts its own way."""
    command = typer.main.get_command(app)
    _hide_argument_types(command)
    if "_COPEM_REPLAY_COMPLETE" in os.environ:  # a shell asks what may follow
        command.main(prog_name="copem-replay")
    try:
        with command.make_context("copem-replay", arguments) as context:
            code = command.invoke(context)
    except typer.Exit as ended:
        return ended.exit_code
    return code if isinstance(code, int) else 0


def _hide_argument_types(command: Any) -> None:
    """Leave `<path>` and `list[Path]` out of `--help` beside arguments: their help says it in words."""
    for under in getattr(command, "commands", {}).values():
        _hide_argument_types(under)
    for parameter in command.params:
        if parameter.param_type_name == "argument" and hasattr(parameter, "display_type_rich"):
            parameter.display_type_rich = lambda ctx: None


def _discard_output() -> None:
    """Discard output that is still buffered: nothing reads it, or it cannot be written."""
    with suppress(OSError, ValueError, AttributeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    main()
