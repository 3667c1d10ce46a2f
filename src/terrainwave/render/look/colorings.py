"""Names of colourings and ramps, for help that imports nothing else."""

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
AUTO = "auto"
NO_SEA = "none"
RAMP_NAMES = ("tints", "cividis", "grey", "mars")
