"""Write the C reader in one source, its header and command to a folder.

As ``python -m terrainwave.capsule FOLDER``.
"""

import sys
from pathlib import Path

from terrainwave.capsule import decoder_sources

if len(sys.argv) != 2:
    raise SystemExit("usage: python -m terrainwave.capsule FOLDER")
folder = Path(sys.argv[1])
folder.mkdir(parents=True, exist_ok=True)
for name, text in decoder_sources().items():
    (folder / name).write_text(text, encoding="utf-8", newline="\n")
