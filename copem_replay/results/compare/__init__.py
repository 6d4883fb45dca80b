"""Compare: configurations with a baseline, paired, within or across results folders.

`compare_folders` reads folders and gives a `Comparison`; `comparison_text`, `comparison_markdown` and
`write_comparison` format it. `labels` names configurations and pairs logs, `pairing` lays rows and lists of two
configurations side by side, `metrics` has the metrics of a pair, `limits` their intervals.
"""

from __future__ import annotations

from copem_replay.results.compare.compare import Comparison, compare_folders
from copem_replay.results.compare.tables import check_out, comparison_markdown, comparison_text, write_comparison

__all__ = ["Comparison", "check_out", "compare_folders", "comparison_markdown", "comparison_text", "write_comparison"]
