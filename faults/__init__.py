"""Trials of what can go wrong round the program: see `faults.run` and docs/reliability.md."""
