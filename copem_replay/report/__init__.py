"""Report: figures of a results folder, and a page with figures, tables and words that opens without a network.

| module | holds |
|---|---|
| `figures/registry` | all figures, for `plot` and for the page; a module per figure beside it |
| `figures/style`, `figures/selection` | how configurations look; which object, run and configurations are drawn |
| `html/study` | the data of a report: results, provenance, comparisons, the baseline |
| `html/conclusions`, `html/setup` | the answer in words; the question, the configurations, the provenance |
| `html/tables` | summary, differences, missed objects, stages of the latency |
| `html/markup` | HTML in which texts of users are escaped |
| `html/page` | the page with its sections, and the file |
"""

from __future__ import annotations

from copem_replay.report.html.page import REPORT, check_report, write_html_report

__all__ = ["REPORT", "check_report", "write_html_report"]
