"""Small .twz files in memory."""

import tempfile
from pathlib import Path

from terrainwave.codec.method_options import chosen_with
from terrainwave.tri.mesh_options import of_former_name
from terrainwave.write.compress import compress

# Of methods, with their defaults: tests that draw options from tables name them side by side.
OF_METHODS = {"border_rings": 1, "faithful": False, "rate": None, "psnr": None}


def grouped(options):
    """Return options side by side as `compress` takes them, in those of methods and meshes."""
    options = dict(options)
    given = {name: options.pop(name) for name in OF_METHODS if name in options}
    given = {name: value for name, value in given.items() if value != OF_METHODS[name]}
    if given:
        own = chosen_with(options.get("method", "auto"), options.get("effort", "default"), given)
        options["method"], options["effort"] = own
    if "mesh" in options:
        options["mesh"] = of_former_name(str(options["mesh"])) or options["mesh"]
    return options


def twz_bytes(heights, **options):
    """Return the bytes of the file that `compress` makes of an array or a path."""
    with tempfile.TemporaryDirectory() as directory:
        target = Path(directory) / "small.twz"
        compress(heights, target, **{"block": 32, "threads": 1, **grouped(options)})
        return target.read_bytes()
