"""Names of colourings and ramps, for help that imports nothing else."""

from terrainwave.arguments import checked_number
from terrainwave.option_sets import Kind, number_in

# Meaning of colours, one line each, for help and documentation.
MEANINGS = {
    "auto": "absolute on the Earth, else relative",
    "absolute": "by metres: water, land, snow",
    "relative": "from the lowest to the highest height",
    "ramp": "relative, without rock where it is steep",
    "slope": "by steepness, 0 to 60 degrees",
    "textured": "as auto, with soil, scree and rock by slope, curvature and height",
    "plain": "grey: light and shadow alone",
    "level": "by the level of blocks",
    "error": "by the error of meshes",
    "flat": "one colour without light",
}
# One line each: the blank lines keep click from joining them.
COLORING_HELP = "Meaning of the colours.\n\n\b\n" + "\n".join(
    f"{name}: {meaning}" for name, meaning in MEANINGS.items()
)
AUTO = "auto"
NO_SEA = "none"


def _checked_sea_level(name: str, value: object) -> object:
    words = f"{AUTO}, {NO_SEA} or a height"
    return value if value in (AUTO, NO_SEA) else checked_number(name, value, expected=words)


SEA_LEVEL = Kind(_checked_sea_level, number_in, "height")
RAMP_NAMES = ("tints", "cividis", "grey", "mars")
