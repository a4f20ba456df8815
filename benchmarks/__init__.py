"""Measurements against truth and against named peers. `python -m benchmarks --help` lists them."""
