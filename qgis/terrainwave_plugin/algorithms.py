"""Processing algorithms: each runs a terrainwave command in a process of its own."""

from __future__ import annotations

from qgis.core import (
    QgsProcessingAlgorithm,
    QgsProcessingException,
    QgsProcessingOutputNumber,
    QgsProcessingParameterBand,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterEnum,
    QgsProcessingParameterFile,
    QgsProcessingParameterFileDestination,
    QgsProcessingParameterNumber,
    QgsProcessingParameterRasterDestination,
    QgsProcessingParameterRasterLayer,
    QgsProcessingProvider,
)

from terrainwave_plugin.command import run

INPUT, OUTPUT, ORIGINAL, BAND = "INPUT", "OUTPUT", "ORIGINAL", "BAND"
MAX_ERROR, MAX_TRIANGLES, METHOD, MESH, COG = "MAX_ERROR", "MAX_TRIANGLES", "METHOD", "MESH", "COG"
METHODS = ["auto", "rapid", "predictive", "cdf97", "cdf53", "store"]
MESH_ENDINGS = (".ply", ".obj", ".stl", ".glb", ".gltf", ".vtu", ".vtk", ".terrain")


class Algorithm(QgsProcessingAlgorithm):
    """A command with its parameters; subclasses say which.

    `numbers` are outputs: name, label, keys that lead to it in what the command prints.
    """

    command = ""
    label = ""
    about = ""
    numbers: tuple[tuple[str, str, tuple[str, ...]], ...] = ()

    def parameters(self) -> list:
        """Return the definitions of the parameters."""
        raise NotImplementedError

    def arguments(self, values, context) -> list[str]:
        """Return the arguments of the command but for its target, from values of parameters."""
        raise NotImplementedError

    def name(self) -> str:
        """Return the name within the provider."""
        return self.command

    def displayName(self) -> str:
        """Return what people see."""
        return self.label

    def shortHelpString(self) -> str:
        """Return what the algorithm does."""
        return self.about

    def createInstance(self) -> Algorithm:
        """Return another one."""
        return type(self)()

    def initAlgorithm(self, config=None) -> None:
        """Define parameters and outputs."""
        for parameter in self.parameters():
            self.addParameter(parameter)
        for name, label, _ in self.numbers:
            self.addOutput(QgsProcessingOutputNumber(name, label))

    def processAlgorithm(self, parameters, context, feedback) -> dict:
        """Run the command; what fails or is cancelled leaves no file."""
        arguments = [self.command, *self.arguments(parameters, context)]
        found = {}
        if self.parameterDefinition(OUTPUT):
            target = self.parameterAsOutputLayer(parameters, OUTPUT, context)
            arguments += [target, "--overwrite"]
            found[OUTPUT] = target
        printed = run(arguments, feedback)
        for name, _, keys in self.numbers:
            found[name] = _look_up(printed, keys)
        return found

    def raster(self, values, name, context) -> list[str]:
        """Return the arguments that name a raster and its band.

        Raises
        ------
        QgsProcessingException
            If GDAL does not read the layer.
        """
        layer = self.parameterAsRasterLayer(values, name, context)
        if layer is None or layer.providerType() != "gdal":
            raise QgsProcessingException(f"{name}: expected a raster that GDAL reads")
        band = self.parameterAsInt(values, BAND, context) or 1
        return ["--band", str(band), layer.source()]

    def bound(self, values, context) -> list[str]:
        """Return the option that names the bound, if one is given."""
        if values.get(MAX_ERROR) is None:
            return []
        return ["--max-error", repr(self.parameterAsDouble(values, MAX_ERROR, context))]


def _look_up(printed: dict, keys: tuple[str, ...]):
    for key in keys:
        printed = (printed or {}).get(key)
    return printed


def _bound_parameter(label: str) -> QgsProcessingParameterNumber:
    kind = QgsProcessingParameterNumber.Type.Double
    return QgsProcessingParameterNumber(MAX_ERROR, label, kind, None, optional=True, minValue=0)


def _band_parameter(label: str, raster: str) -> QgsProcessingParameterBand:
    # Optional, for QGIS takes none for granted otherwise.
    return QgsProcessingParameterBand(BAND, label, 1, raster, optional=True)


def _file_parameter() -> QgsProcessingParameterFile:
    return QgsProcessingParameterFile(
        INPUT, ".twz file (a path or an address)", fileFilter="terrainwave (*.twz)"
    )


class Compress(Algorithm):
    """``terrainwave compress``."""

    command = "compress"
    label = "Compress raster"
    about = (
        "Writes an elevation raster to a .twz file. Every height stays within the largest allowed"
        " error, which is checked by decoding the finished file."
    )
    numbers = (
        ("BOUND", "Guaranteed error", ("effective_error",)),
        ("MEASURED_ERROR", "Measured error", ("measured_error",)),
        ("RATIO", "Times smaller than raw", ("ratio",)),
    )

    def parameters(self) -> list:
        """Return the definitions of the parameters."""
        return [
            QgsProcessingParameterRasterLayer(INPUT, "Elevation raster"),
            _band_parameter("Band", INPUT),
            _bound_parameter(
                "Largest allowed error, in the raster's unit; 0 is lossless (default: lossless"
                " where the heights have a vertical step, else 0.01 m or less)"
            ),
            QgsProcessingParameterEnum(METHOD, "Method", METHODS, defaultValue=0),
            QgsProcessingParameterFileDestination(OUTPUT, "Compressed", "terrainwave (*.twz)"),
        ]

    def arguments(self, values, context) -> list[str]:
        """Return the arguments of the command but for its target."""
        method = METHODS[self.parameterAsEnum(values, METHOD, context)]
        options = ["--json", "--method", method, *self.bound(values, context)]
        return [*options, *self.raster(values, INPUT, context)]


class Decompress(Algorithm):
    """``terrainwave decompress``."""

    command = "decompress"
    label = "Decompress to GeoTIFF"
    about = "Writes a .twz file to a GeoTIFF with the heights, CRS, voids and tags of the raster."

    def parameters(self) -> list:
        """Return the definitions of the parameters."""
        return [
            _file_parameter(),
            QgsProcessingParameterBoolean(COG, "Cloud-optimised", defaultValue=False),
            QgsProcessingParameterRasterDestination(OUTPUT, "Decompressed"),
        ]

    def arguments(self, values, context) -> list[str]:
        """Return the arguments of the command but for its target."""
        cog = ["--cog"] if self.parameterAsBool(values, COG, context) else []
        return [*cog, self.parameterAsFile(values, INPUT, context)]


class Verify(Algorithm):
    """``terrainwave verify``."""

    command = "verify"
    label = "Verify file"
    about = (
        "Compares every height of a .twz file with its original raster; without that, checks all"
        " of the file. Fails where a height is further away than the bound."
    )
    numbers = (
        ("BOUND", "Bound", ("bound",)),
        ("MEASURED_ERROR", "Largest error", ("errors", "max_error")),
        ("N_VALID", "Heights compared", ("errors", "n_valid")),
    )

    def parameters(self) -> list:
        """Return the definitions of the parameters."""
        return [
            _file_parameter(),
            QgsProcessingParameterRasterLayer(ORIGINAL, "Original raster", optional=True),
            _band_parameter("Band of the original", ORIGINAL),
            _bound_parameter("Bound to hold it to (default: the file's own)"),
            QgsProcessingParameterBoolean(MESH, "Check all meshes too", defaultValue=False),
        ]

    def arguments(self, values, context) -> list[str]:
        """Return the arguments of the command."""
        options = ["--json", *self.bound(values, context)]
        if self.parameterAsBool(values, MESH, context):
            options.append("--mesh")
        file = self.parameterAsFile(values, INPUT, context)
        if values.get(ORIGINAL) is None:
            return [*options, file]
        return [*options, file, *self.raster(values, ORIGINAL, context)]


class Mesh(Algorithm):
    """``terrainwave mesh``."""

    command = "mesh"
    label = "Make mesh"
    about = (
        "Writes one watertight triangle mesh of a .twz file, no further from the original raster"
        " than the bound. The format follows from the target's ending."
    )
    numbers = (
        ("N_TRIANGLES", "Triangles", ("n_triangles",)),
        ("ERROR", "Guaranteed error", ("error",)),
    )

    def parameters(self) -> list:
        """Return the definitions of the parameters."""
        filters = ";;".join(f"{ending[1:].upper()} (*{ending})" for ending in MESH_ENDINGS)
        kind = QgsProcessingParameterNumber.Type.Integer
        return [
            _file_parameter(),
            _bound_parameter("Largest distance from the original heights"),
            QgsProcessingParameterNumber(
                MAX_TRIANGLES, "Most triangles", kind, None, optional=True, minValue=1
            ),
            QgsProcessingParameterFileDestination(OUTPUT, "Mesh", filters),
        ]

    def arguments(self, values, context) -> list[str]:
        """Return the arguments of the command but for its target."""
        options = ["--json", *self.bound(values, context)]
        if values.get(MAX_TRIANGLES) is not None:
            options += [
                "--max-triangles", str(self.parameterAsInt(values, MAX_TRIANGLES, context))
            ]  # fmt: skip
        return [*options, self.parameterAsFile(values, INPUT, context)]


class Provider(QgsProcessingProvider):
    """The algorithms, as QGIS lists them."""

    def __init__(self, icon) -> None:
        super().__init__()
        self._icon = icon

    def id(self) -> str:
        """Return the first part of the algorithms' names."""
        return "terrainwave"

    def name(self) -> str:
        """Return what people see."""
        return "terrainwave"

    def icon(self):
        """Return the picture in the toolbox."""
        return self._icon

    def supportedOutputRasterLayerExtensions(self) -> list[str]:
        """Return the endings of rasters that `Decompress` writes."""
        return ["tif", "tiff"]

    def loadAlgorithms(self) -> None:
        """Add the algorithms."""
        for algorithm in (Compress, Decompress, Verify, Mesh):
            self.addAlgorithm(algorithm())
