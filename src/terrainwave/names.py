"""Registry of methods, meshes and efforts, as files number them; capabilities of each method.

A new method is a package in `codec` and an entry in `METHODS`; no other module names a method.
"""

from collections.abc import Callable
from dataclasses import dataclass

# In the order in which files number them.
EFFORTS = ("fast", "default", "best")
# Sides of the original on which the decoded heights of a file may lie.
SIDES = BOTH, ABOVE, BELOW = "both", "above", "below"
DEFAULT_EFFORT = EFFORTS[1]
# Kinds of meshes, in the order in which files number them.
MESHES = ("none", "halves", "zerotree-plain", "rqt", "zerotree-layer", "zerotree-coded",
          "rqt-coefficient")  # fmt: skip
# Kinds that users can ask for, with module and class in `tri` of their options; "auto" is the
# first. `tri.mesh_options.stored_mesh` returns the kind that the file then stores.
MESH_KINDS = {"halves": "", "zerotree": "zerotree.Zerotree", "rqt": "rqt.Rqt"}
DEFAULT_MESH = "halves"
# Kinds whose tolerance only selects vertices: their errors are measured, and may be larger.
UNBOUNDED_MESHES = ("rqt-coefficient",)
# Encodings of heights in terrain-RGB tiles (`globe.terrain_rgb.ENCODINGS`).
TILE_ENCODINGS = ("mapbox", "terrarium")
# Their lossless image formats (`globe.terrain_rgb.TILE_IMAGES`); the first is an archive's default.
TILE_IMAGES = ("webp", "png")
# Tasks whose kernels can be compiled in advance (`cli.warmup.TASKS`).
WARMUP_TASKS = ("compress", "read", "verify", "patch", "mesh", "render")


@dataclass(frozen=True, kw_only=True)
class Method:
    """Properties of a method that the rest of the package uses.

    Attributes
    ----------
    name, number : str, int
        Its name for users, and its number in a file's header (FORMAT.md §4.1).
    options : str
        Module and class in `codec` of its options.
    refiner : str, optional
        Module and class in `codec` that code its units; None if these are gathered in tiles of
        several levels (`codec.cdf53.tile_layout`), which have no aprons.
    pyramid : str
        How coarse levels are made (`write.pyramid`): every second sample, averages of the 9/7
        filter or of the reversible 5/3.
    effort : str
        What its efforts vary; empty if all give the same bytes.
    is_cuttable : bool
        Its streams can end early: at a rate, at a mean error, or where a reader has enough.
    is_clusterable : bool
        A part of the raster can be coded without the rest, on another machine.
    may_be_faithful : bool
        Its files may follow its paper (`faithful` of `codec.cdf97.Cdf97`).
    is_patchable : bool
        A unit can be coded again so that unchanged heights come back exactly: its loop takes
        corrections (`codec.corrections`).
    has_rings : bool
        Its blocks may share three rings of samples with their neighbours.
    has_file_tables : bool
        The file's header may hold tables for all of its units.
    has_layers : bool
        It codes difference layers, whose zero trees drive its meshes of the kind "zerotree".
    has_coefficients : bool
        Its files hold wavelet coefficients, which meshes may follow.
    has_remainders : bool
        It keeps heights that lie on no vertical grid exactly, and heights rounded to fixed steps.
    """

    name: str
    number: int
    options: str
    refiner: str | None = None
    pyramid: str = "nested"
    effort: str = ""
    is_cuttable: bool = False
    is_clusterable: bool = True
    may_be_faithful: bool = False
    is_patchable: bool = False
    has_rings: bool = False
    has_file_tables: bool = False
    has_layers: bool = False
    has_coefficients: bool = False
    has_remainders: bool = True

    @property
    def is_tiled(self) -> bool:
        """Return whether its units are gathered in tiles."""
        return self.refiner is None


# In the order of the documentation; the first is the default.
METHODS = {
    method.name: method
    for method in (
        Method(name="rapid", number=4, options="rapid.Rapid",
               refiner="rapid.refiner.RapidRefiner", has_file_tables=True, is_patchable=True),
        Method(name="predictive", number=2, options="predictive.Predictive",
               refiner="predictive.refiner.PredictiveRefiner",
               has_file_tables=True, is_patchable=True, has_rings=True,
               effort="1, 2 or 8 sets of weights"),
        Method(name="cdf97", number=1, options="cdf97.Cdf97",
               refiner="cdf97.refiner.Cdf97Refiner", pyramid="lowpass",
               effort="1, up to 3 or up to 7 steps", has_layers=True, may_be_faithful=True,
               has_rings=True),
        Method(name="cdf53", number=3, options="cdf53.Cdf53",
               pyramid="lowpass53", is_cuttable=True, is_clusterable=False,
               has_coefficients=True, has_remainders=False),
        Method(name="store", number=0, options="store.Store",
               refiner="store.refiner.StoreRefiner", has_rings=True),
    )
}  # fmt: skip
DEFAULT_METHOD = METHODS["rapid"]  # of "auto", for every raster (decision 21)
# For archives: "auto" with effort "best".
SMALLEST_METHOD = METHODS["predictive"]
# Used for heights that no method compresses.
PLAIN_METHOD = METHODS["store"]


def mesh_without_coefficients(mesh: str, method: Method) -> str:
    """Return the kind of meshes to use if a method lacks what this kind needs."""
    return "rqt" if mesh in UNBOUNDED_MESHES and not method.has_coefficients else mesh


def methods_that(can: Callable[[Method], bool]) -> str:
    """Return the names of the methods with a capability, for messages."""
    return " or ".join(method.name for method in METHODS.values() if can(method))
