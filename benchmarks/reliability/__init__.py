"""How reliable the package is: what docs/reliability.md says is measured here.

``python -m benchmarks.reliability.NAME`` for each module with a command.
"""
