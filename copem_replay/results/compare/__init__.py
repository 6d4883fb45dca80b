"""Compare: configurations with a baseline, paired, within or across results folders.

`compare` reads folders and gives a `Comparison`; `comparison_text`, `comparison_markdown` and `write_comparison` say
what is in it.

| module | does |
|---|---|
| `inputs`, `comparable`, `same_drive`, `labels` | what is read; may it be compared; which configurations are meant |
| `pairing`, `configuration_data`, `per_list` | rows and lists of two configurations of a log side by side |
| `metrics`, `differences`, `equal_ghosts` | metrics of a pair in a log |
| `all_logs` | what is kept of a pair while its logs are gone through |
| `bootstrap`, `limits`, `paired_statistics` | their intervals |
| `notes`, `tables` | what is said |
"""

from copem_replay.results.compare.compare import Comparison, compare
from copem_replay.results.compare.tables import check_out, comparison_markdown, comparison_text, write_comparison

__all__ = ["Comparison", "check_out", "compare", "comparison_markdown", "comparison_text", "write_comparison"]
