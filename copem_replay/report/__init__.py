"""Report: what a results folder says, in one file that opens without a network.

| module | does |
|---|---|
| `study` | what is read: results, provenance, comparisons, who is compared with whom |
| `answer`, `described` | the question and the answer in words; what was compared |
| `tables`, `never`, `provenance` | tables: summary and regret, who was never detected, what made the results |
| `curves`, `distances`, `waterfall`, `sweeps` | figures, as plotly.js draws them |
| `drawing`, `markup` | how figures look; HTML of which nothing is taken literally that comes from users |
| `page`, `write` | the page, and the file |
"""

from copem_replay.report.html.write import REPORT, check_report, write_report

__all__ = ["REPORT", "check_report", "write_report"]
