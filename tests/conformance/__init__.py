"""Programs that answer `tools/run_conformance.py`, and the invalid files of the set.

The protocol and the digests are defined in tests/golden/README.md.
"""
