"""Fusion: the receiver's tracks, from the lists that have arrived (f of the paper's coPEM)."""

from __future__ import annotations

FUSIONS = {
    "ideal": "copem_replay.fusion.interface:IdealFusion",
    "union": "copem_replay.fusion.union:Union",
    "nms": "copem_replay.fusion.nms:Nms",
    "gnn": "copem_replay.fusion.gnn:Gnn",
    "tracker": "copem_replay.fusion.tracker:Tracker",
}
"""Built-in names of `fusion: {kind: …}`."""
