"""The default method: rows on a wavefront, rANS (docs/format-rapid.md)."""
