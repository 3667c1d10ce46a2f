"""Integrations: each needs an extra, and ``import terrainwave`` imports none of them.

Other libraries find theirs by the entry points in pyproject.toml.
"""
