"""Ghosts and outages of units, beside them in the scene. Nothing where no unit has any."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from copem_replay.core.colours import Rgb
from copem_replay.core.fused_tracks import FusedTracks
from copem_replay.core.tracks import Bool, Int, Tracks
from copem_replay.core.unit_faults import UnitFaults
from copem_replay.experiment.schema import Experiment
from copem_replay.pipeline.prepare import Replay
from copem_replay.viewer.sensors import unit_places
from copem_replay.viewer.sink import Out, f32

FALSE: Rgb = (255, 90, 90)
"""The colour of ghosts and outages, in the lists of any unit."""


class FaultsShown:
    """Ghosts and outages of the units of one run, time chunk by time chunk; each list is shown once."""

    def __init__(self, out: Out, replay: Replay, experiment: Experiment) -> None:
        self._out, self._replay, self._experiment = out, replay, experiment
        self._shown_until_ns: dict[str, int] = {}

    def add(self, run_tracks: Mapping[str, FusedTracks]) -> None:
        """The next time chunk."""
        told = [one for one in run_tracks.values() if one.faults is not None]
        if not told:
            return
        # Ideal fusion is not told of ghosts; any other fusion is told of all of them.
        fullest = max(told, key=lambda one: len(one.faults.ghosts) if one.faults is not None else 0)
        heard, faults = fullest.heard, fullest.faults
        assert faults is not None
        until_ns = int(heard.stamp_ns[heard.frame_ix].max(initial=np.iinfo(np.int64).min))
        for unit_ix, name in enumerate(heard.units):
            if name in self._experiment.modelled:
                last_ns = self._shown_until_ns.get(name, np.iinfo(np.int64).min)
                new = (heard.stamp_ns > last_ns) & (heard.stamp_ns <= until_ns)
                frames = np.flatnonzero((heard.frame_unit_ix == unit_ix) & new)
                if len(frames):
                    self._shown_until_ns[name] = int(heard.stamp_ns[frames[-1]])
                    self._of_unit(name, heard, faults, frames)

    def _of_unit(self, name: str, heard: Tracks, faults: UnitFaults, frames: Int) -> None:
        import rerun as rr

        elapsed_ns = heard.stamp_ns[frames] - self._replay.scene.t0_ns
        unit, path = self._experiment.units[name], ["world", "units", name]
        if self._experiment.pems[str(unit.pem)].ghosts:
            rows = faults.ghosts[np.isin(heard.frame_ix[faults.ghosts], frames) & heard.valid[0, faults.ghosts]]
            rows = rows[np.argsort(heard.frame_ix[rows], kind="stable")]
            place = f32(*(getattr(heard, axis)[0, rows] for axis in ("x_m", "y_m", "z_m")))
            count = np.bincount(np.searchsorted(frames, heard.frame_ix[rows]), minlength=len(frames))
            self._out.columns([*path, "ghosts"], elapsed_ns, rr.Points3D.columns(positions=place).partition(count))
            mark = rr.Radius.ui_points(4)
            self._out.static([*path, "ghosts"], rr.Points3D.from_fields(colors=[FALSE], radii=mark, labels=["false"]))
        if unit.outages is not None:
            self._down(path, heard, frames, faults.not_made[frames], elapsed_ns)

    def _down(self, path: list[str], heard: Tracks, frames: Int, down: Bool, elapsed_ns: Int) -> None:
        import rerun as rr

        place = unit_places(self._replay, self._experiment, heard)[frames[down]]
        columns = rr.Points3D.columns(positions=f32(*place.T)).partition(down.astype(np.int64))
        self._out.columns([*path, "outage"], elapsed_ns, columns)
        mark = rr.Radius.ui_points(6)
        said = rr.Points3D.from_fields(colors=[FALSE], radii=mark, labels=["makes no lists"], show_labels=True)
        self._out.static([*path, "outage"], said)
