"""Triangulation of Yusov & Turlapov 2010: fine where its zero trees require it."""

from dataclasses import dataclass

from terrainwave.errors import InvalidArgumentError
from terrainwave.names import Method
from terrainwave.option_sets import option, words
from terrainwave.tri.mesh_options import MeshOptions


@dataclass(frozen=True, kw_only=True)
class Zerotree(MeshOptions):
    """Options of the guaranteed triangulation of Yusov & Turlapov 2010.

    Parameters
    ----------
    labels : str, optional
        Source of the labels: ``"layer"``, the zero trees of the decoded heights, for files of any
        method; ``"coded"``, those that a file with ``Cdf97(faithful=True)`` codes; ``"plain"``, no
        zero trees. By default layer with method cdf97, coded in its faithful files, else plain.
    """

    name = "zerotree"

    labels: str | None = option(
        words("plain", "layer", "coded"),
        "What the labels follow: layer, the zero trees of the decoded heights; coded, those that a"
        " faithful file of cdf97 codes; plain, none. Default: layer with cdf97 (coded if it is"
        " faithful), else plain.",
    )

    def stored(self, method: Method, *, is_faithful: bool) -> str:
        """Return the kind of meshes that a file of a method holds."""
        if self.labels == "coded" and not is_faithful:
            raise InvalidArgumentError(
                "found `labels`=coded for a file that codes no zero trees, expected `labels`=layer,"
                " which follows those of the decoded heights, or a file made with `faithful`"
            )
        usual = "plain" if not method.has_layers else "coded" if is_faithful else "layer"
        return f"{self.name}-{self.labels or usual}"
