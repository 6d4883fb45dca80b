"""What lies beside a fused list as JSON: its schema; `io/write/detail_json_writer.py` says more."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from copem_replay.core.tracks import UNCERTAINTIES

SCHEMA = "copem_replay.ListDetail"
Event = Mapping[str, Any]
"""What was detected: `object`, `first_unit`, `onset_s`, `captured_s`, `time_to_detection_s`, and how far away."""

_NUMBER = {"type": ["number", "null"]}
JSON_SCHEMA = {
    "title": SCHEMA,
    "type": "object",
    "properties": {
        "available_ns": {"type": "integer"},
        "captured_ns": {"type": ["integer", "null"]},
        "objects": {
            "type": "array",
            "items": {
                "type": "object",
                "properties": {
                    "id": {"type": "string"},
                    "existence": {"type": "number"},
                    **dict.fromkeys(UNCERTAINTIES, _NUMBER),
                    "units": {"type": "array", "items": {"type": "string"}},
                    "captured_ns": {"type": "array", "items": {"type": "integer"}},
                    "range_m": {"type": "array", "items": _NUMBER},
                    "visible_share": {"type": "array", "items": _NUMBER},
                },
            },
        },
        "events": {"type": "array", "items": {"type": "object"}},
    },
}
