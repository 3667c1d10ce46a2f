"""The version of the package; the format of the files has its own (docs/FORMAT.md)."""

__version__ = "0.1.0"
