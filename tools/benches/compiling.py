"""The first run on a machine: what is compiled, in processor seconds of the thread that compiles."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator

from benches import common

_LONGEST = 12


def compile() -> Iterator[common.Line]:
    """The sample's run with an empty cache and again, and the functions that take longest, without what they call."""
    with common.scratch() as folder:
        command = [sys.executable, __file__, str(common.ROOT / "logs/tc016d.yaml"), str(folder / "out")]
        paths = os.pathsep.join([str(common.ROOT / "tools"), str(common.ROOT)])
        environment = os.environ | {"NUMBA_CACHE_DIR": str(folder / "cache"), "PYTHONPATH": paths}
        for name in ("first_run", "second_run"):
            printed = subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout
            spent = json.loads(printed.splitlines()[-1])
            functions = Counter(spent.pop("functions"))
            yield {"run": name, **spent}
            for function, seconds in functions.most_common(_LONGEST):
                yield {"function": function, "alone_s": round(seconds, 2)}


def _run_and_print(experiment: str, out: str) -> None:
    """Run an experiment in this process, and print what was compiled, and how long that took, as JSON."""
    from numba.core.event import Event, Listener, register

    class Compiling(Listener):  # type: ignore[misc]
        """Per function the seconds of its own; a callee is compiled while its caller is."""

        def __init__(self) -> None:
            self.alone_s: Counter[str] = Counter()
            self.count, self.begun = 0, []

        def on_start(self, event: Event) -> None:
            self.begun.append((time.thread_time(), 0.0))

        def on_end(self, event: Event) -> None:
            began, of_callees = self.begun.pop()
            took = time.thread_time() - began
            if self.begun:
                self.begun[-1] = self.begun[-1][0], self.begun[-1][1] + took
            function = event.data["dispatcher"].py_func
            self.alone_s[f"{function.__module__}.{function.__qualname__}"] += took - of_callees
            self.count += 1

    from copem_replay.cli.main import main

    compiling = Compiling()
    register("numba:compile", compiling)
    sys.argv = ["copem-replay", "run", experiment, "--out", out, "--overwrite"]
    try:
        main()
    except SystemExit as ended:
        if ended.code:
            raise
    total = {"cpu_s": round(time.process_time(), 1), "compile_s": round(sum(compiling.alone_s.values()), 1)}
    print(json.dumps({**total, "compiled": compiling.count, "functions": compiling.alone_s}))


if __name__ == "__main__":
    _run_and_print(*sys.argv[1:])
