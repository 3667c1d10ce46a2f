"""The refiners by name; each is imported when it is asked for."""

from terrainwave.codec.refiner import Refiner
from terrainwave.errors import InvalidHeightsError, UnsupportedVersionError

METHODS = ("predictive", "rapid", "cdf97", "cdf53", "store")
# Of what heights each method makes coarse levels (`pyramid.Pyramid`).
PYRAMIDS = {
    "predictive": "nested",
    "rapid": "nested",
    "cdf97": "lowpass",
    "cdf53": "lowpass53",
    "store": "nested",
}
DEFAULT_METHOD = "predictive"


def refiner_by_name(name: str, parameters: bytes = b"") -> Refiner:
    """Return the refiner of a file's method, with the `parameters` of its header.

    Method cdf53 has none: its units are tiles (`codec.tiles`).

    Raises
    ------
    UnsupportedVersionError
        If this version has no such method, or doesn't know its parameters.
    CorruptStreamError
        If the parameters contradict FORMAT.md.
    """
    if name == "predictive":
        from terrainwave.codec.predictive import Predictive

        return Predictive(parameters)
    if name == "rapid":
        from terrainwave.codec.rapid import Rapid

        return Rapid(parameters)
    if parameters and name in METHODS:
        raise UnsupportedVersionError(
            f"the file has parameters for method {name}, which this terrainwave does not know:"
            " install a newer one"
        )
    if name == "store":
        from terrainwave.codec.store import Store

        return Store()
    if name == "cdf97":
        from terrainwave.codec.cdf97 import Cdf97

        return Cdf97()
    raise UnsupportedVersionError(
        f"the file uses method {name!r}; this terrainwave has {', '.join(METHODS)}:"
        " install a newer one"
    )


def check_method(name: str) -> str:
    """Return `name` if it can be encoded with; ``"auto"`` becomes the default.

    Raises
    ------
    InvalidHeightsError
        If there is no such method.
    """
    if name == "auto":
        return DEFAULT_METHOD
    if name not in METHODS:
        raise InvalidHeightsError(f"found method {name!r}, expected auto, {', '.join(METHODS)}")
    return name
