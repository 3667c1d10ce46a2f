"""Benchmarks: see README.md here for which script answers which question."""
