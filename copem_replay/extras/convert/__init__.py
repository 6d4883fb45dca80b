"""Converters of public data sets and simulations to OSI truth, one module per format (docs/guide/data-sets.md)."""
