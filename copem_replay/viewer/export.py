"""One shown run of a results folder as a Rerun recording."""

from __future__ import annotations

from pathlib import Path

from copem_replay.results.export import MCAP, Exporter, RunToExport
from copem_replay.viewer.selection import in_parts


def rrd_to(viewer: str | None) -> Exporter:
    """The exporter of `.rrd` files that also sends each recording to the Rerun viewer at this address, if any."""

    def write(path: Path, run: RunToExport) -> list[str]:
        from copem_replay.viewer.rrd import write_rrd

        shown = run.one.experiment.configurations
        every = {name: shown.get(name, one) for name, one in run.every.items()}
        return write_rrd(
            path,
            run.one.replay,
            run.one.experiment.model_copy(update={"configurations": every}),
            run.one.run_tracks,
            run.table,
            run.summary,
            run.shown.run,
            run_is=run.shown.why,
            viewer=viewer,
        )

    return Exporter(".rrd", write, _names)


def _names(stem: str, configurations: int) -> list[str]:
    path = Path(f"{stem}.rrd")
    return [part.path(path).as_posix() for part in in_parts([str(k) for k in range(configurations)])]


EXPORTERS = (MCAP, rrd_to(None))
"""Both kinds of files that `copem-replay run` writes of a shown run."""
