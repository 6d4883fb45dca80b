"""Benchmarks: a section per file, each a generator of lines; `tools/bench.py` runs them."""
