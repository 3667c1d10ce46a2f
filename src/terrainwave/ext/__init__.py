"""Terrainwave inside other libraries; each module needs its library and is found by entry point.

Nothing here is imported by ``import terrainwave``.
"""
