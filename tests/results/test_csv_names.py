"""Names in CSV files: no spreadsheet takes them for formulas, and they are read back as they were."""

from __future__ import annotations

from io import StringIO

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from copem_replay.results.table_files import quote_formulas, unquote_names

BEGINNINGS = st.sampled_from(["", "=", "+", "-", "@", "\t", "\r", "\n", "'", "''", "'="])


@given(st.lists(st.tuples(BEGINNINGS, st.text(max_size=5)).map("".join), min_size=1))
def test_every_name_comes_back(names: list[str]) -> None:
    table = pd.DataFrame({"configuration": names, "n": range(len(names))})
    quoted = quote_formulas(table)
    assert not quoted["configuration"].str.startswith(("=", "+", "-", "@", "\t", "\r", "\n")).any()
    assert unquote_names(quoted, ["configuration"])["configuration"].tolist() == names


@pytest.mark.parametrize("dtype", ["object", "str"])
def test_numbers_and_what_is_missing_stay(dtype: str) -> None:
    table = pd.DataFrame({"d": [-0.5, np.nan], "k": [-1, 2], "over": pd.Series(["-a", None], dtype=dtype)})
    written = quote_formulas(table).to_csv(index=False)
    assert written == "d,k,over\n-0.5,-1,'-a\n,2,\n"
    assert pd.read_csv(StringIO(written))["d"].iloc[0] == -0.5
