"""Compare: configurations with a baseline, paired, within or across results folders.

`compare` reads folders and gives a `Comparison`; `comparison_text`, `comparison_markdown` and `write_comparison` say
what is in it.

| module | does |
|---|---|
| `folders`, `comparable`, `names` | what is read; whether it may be compared; which configurations are meant |
| `grid`, `sides`, `lists` | rows and lists of two configurations side by side |
| `regret`, `figures`, `intervals` | metrics of pairs, and their intervals |
| `notes`, `tables` | what is said |
| `beside`, `merge` | one run of all of them in one recording: imported by name, as it replays |
"""

from copem_replay.results.compare.compare import Comparison, compare
from copem_replay.results.compare.tables import check_out, comparison_markdown, comparison_text, write_comparison

__all__ = ["Comparison", "check_out", "compare", "comparison_markdown", "comparison_text", "write_comparison"]
