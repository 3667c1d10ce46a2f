"""PyInstaller's hook, found by the entry point ``hook-dirs``."""

import os


def hook_dirs() -> list[str]:
    return [os.path.dirname(__file__)]
