"""``python -m terrainwave``: the command line."""

from terrainwave.cli import main

main(prog_name="terrainwave")
