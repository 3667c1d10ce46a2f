"""Measurements of how the package holds: ``python -m benchmarks.reliability.NAME`` for each."""
