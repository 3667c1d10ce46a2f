"""Benchmarks: other codecs at equal bounds, a matrix of cases, memory."""
