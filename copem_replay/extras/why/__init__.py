"""Why objects are known late: causes, worth of units, triage, sensitivity (docs/guide/why.md)."""
