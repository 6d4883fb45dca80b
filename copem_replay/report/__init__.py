"""Report: what a results folder says, in one file that opens without a network.

| module | does |
|---|---|
| `html/study` | what is read: results, provenance, comparisons, the baseline |
| `html/conclusions`, `html/setup` | the question and the answer in words; what was compared |
| `html/tables`, `html/missed_objects`, `html/latency_breakdown`, `html/provenance` | tables |
| `figures/registry` | all figures, for `plot` and for the page |
| `html/embedded`, `html/swatches`, `html/markup` | figures in a page; HTML that takes no text of users literally |
| `html/page`, `html/write` | the page, and the file |
"""

from copem_replay.report.html.write import REPORT, check_report, write_report

__all__ = ["REPORT", "check_report", "write_report"]
