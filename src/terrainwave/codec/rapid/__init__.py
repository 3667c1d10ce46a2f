"""The default method: all details of a unit before any height, rANS (docs/format-rapid.md)."""

from dataclasses import dataclass

from terrainwave.codec.method_options import MethodOptions


@dataclass(frozen=True, kw_only=True)
class Rapid(MethodOptions):
    """Options of method rapid, the default: it has none."""

    name = "rapid"
