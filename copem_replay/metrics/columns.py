"""Columns of `detections.parquet` as they are put together: one table is made of all, which is what takes longest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd


def beneath(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The columns of each part, which all have the same, one beneath the other."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def frame(columns: Mapping[str, Any]) -> pd.DataFrame:
    """The rows of columns; `braking_pass` is null where nothing is in conflict."""
    rows = dict(columns)
    if "braking_pass" in rows:
        rows["braking_pass"] = pd.arrays.BooleanArray(rows["braking_pass"], ~rows["conflict"])
    return pd.DataFrame(rows)
