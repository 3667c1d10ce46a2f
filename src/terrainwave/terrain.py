"""`Terrain`: a `TerrainFile` with meshes, pictures and conversions to other libraries."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

from terrainwave.arguments import (
    check_flags,
    checked_number,
    shown,
)
from terrainwave.errors import InvalidArgumentError, InvalidHeightsError
from terrainwave.file import TerrainFile
from terrainwave.grid.quadtree import Block
from terrainwave.progress import ProgressCallback

if TYPE_CHECKING:
    import xarray as xr

    from terrainwave.export.mesh import Mesh
    from terrainwave.ext.notebook.explorer import Explorer
    from terrainwave.mesh.blocks import BlockMesher
    from terrainwave.raster_io.geotiff.sparse import GeoTIFFStream
    from terrainwave.render.look.style import Style
    from terrainwave.render.window.static import Picture
    from terrainwave.tri.block_mesh import BlockMesh

_NO_MESHES = "the file has no meshes: add them with terrainwave mesh"


class Terrain(TerrainFile):
    """An open .twz file: windows of heights at any level, meshes, pictures; decoded on demand.

    Parameters and errors are those of `TerrainFile`: a path, URL, bytes or binary file object,
    `cache_bytes` of decoded heights kept in memory, `threads` that decode. Thread-safe, picklable
    if opened by path or URL, a context manager.
    """

    @cached_property
    def _mesher(self) -> "BlockMesher":
        from terrainwave.mesh.sections import mesher_of

        return mesher_of(self)

    # Meshes.

    def mesh(
        self,
        window: Any = None,
        *,
        bounds: Sequence[float] | None = None,
        level: int = -1,
        max_error: float | None = None,
        max_triangles: int | None = None,
        optimise: int | None = None,
        guarantee: bool = True,
        progress: ProgressCallback | None = None,
    ) -> "Mesh":
        """Return one crack-free mesh of an area.

        Parameters
        ----------
        window, bounds : optional
            The area as in `read`, here between the centres of its outermost pixels.
        level : int
            The finest level to use, as in `read`. The mesh of a coarse level ends at its last
            sample, up to 2^j - 1 rows and columns before the end of the full grid.
        max_error : float, optional
            Largest vertical distance from any valid original sample, in physical units. The mesh
            mixes blocks of several levels to need few triangles. It is computed as `halves` from
            the decoded heights, whatever kind of meshes the file has. By default the tolerance is
            that of the stored meshes of `level`.
        max_triangles : int, optional
            Find the mesh with the smallest error (within 2 %) that has at most this number of
            triangles, within `max_error` if that is given too. If outlines of voids have more than
            one edge for four triangles, the outlines of a coarser level are used: the mesh then
            covers all valid samples, and also voids smaller than that level's cells.
        optimise : int, optional
            Number of sweeps of half-edge collapses over blocks of the full grid. The default, 1, is
            that of the command ``mesh`` and nearly halves the triangles. The meshes are computed as
            `halves`. With 0, and without `max_error` and `max_triangles`, the stored meshes are
            returned.
        guarantee : bool
            False returns the triangulation of the zero trees only (Yusov & Turlapov 2010, §2.4),
            without any of the three arguments above. Its `error` is measured. `level` -1 then means
            -2, the finest level with zero trees.
        progress : callable, optional
            Called with a `Progress`, which starts again with each attempt.

        Returns
        -------
        Mesh
            Every valid sample that it covers is within its `error`. It covers all quads of four
            valid samples and triangles of three; with `max_triangles` also parts of voids.

        Raises
        ------
        InvalidArgumentError
            If an argument is out of range, the area is less than 2 x 2 samples, or `max_error` is
            less than the file's own error.
        CorruptStreamError
            If a block is damaged.
        """
        from terrainwave.export.mesh import Mesh
        from terrainwave.mesh.area import mesh_area

        check_flags(guarantee=guarantee)
        if optimise is None:
            optimise = int(guarantee)  # zero trees must not be changed
        return mesh_area(
            self, Mesh, window, bounds=bounds, level=level, max_error=max_error,
            max_triangles=max_triangles, optimise=optimise, guarantee=guarantee, progress=progress,
        )  # fmt: skip

    def block_mesh(self, block: Block) -> "BlockMesh":
        """Return the stored mesh of a block, in samples and quanta.

        Rows and columns count from the block's first sample. The mesh may extend past the raster.
        """
        if self.mesh_kind == "none":
            raise InvalidHeightsError(_NO_MESHES)
        if not isinstance(block, Block) or not self.grid.contains(block):
            raise InvalidArgumentError(
                f"found `block` {shown(block)}, expected a Block of the file's levels"
            )
        return self._mesher.mesh(block)

    def mesh_error(self, block: Block) -> float:
        """Return a bound on the error of a block's mesh, in physical units.

        No valid original that the mesh covers is further from it. The bound is stored in the file,
        or else computed from the mesh, which is then made (see `measure_meshes` of `compress`).

        Raises
        ------
        InvalidHeightsError
            If the file has no meshes.
        """
        if self.mesh_kind == "none":
            raise InvalidHeightsError(_NO_MESHES)
        stored = self.stored_mesh_error(block)
        if stored is not None:
            return stored
        sixteenths = self._mesher.derived_error(block, self._mesher.mesh(block))
        return sixteenths / 16 * self.quantizer.quantum * abs(self.raster_info.scale)

    # Conversions to other libraries.

    def to_xarray(self, *, level: int = -1, mask_and_scale: bool = True) -> "xr.DataArray":
        """Return a level as a lazy DataArray: windows are read when they are computed.

        It has the coordinates of `xarray.open_dataset` and lives as long as this Terrain is open.

        Parameters
        ----------
        level : int
            Resolution level, as in `read`.
        mask_and_scale : bool
            Set voids to NaN and apply scale and offset. False returns values as stored.

        Raises
        ------
        TerrainwaveError
            If xarray is not installed.
        """
        from terrainwave.extras import need

        check_flags(mask_and_scale=mask_and_scale)
        need("xarray", extra="xarray")
        from terrainwave.ext.xarray_backend import terrain_dataset

        return terrain_dataset(self, level, mask_and_scale=mask_and_scale)["heights"]

    def geotiff(self) -> "GeoTIFFStream":
        """Return the terrain as a file object with a GeoTIFF that is made while it is read.

        ``rasterio.open(terrain.geotiff())`` opens it as a raster. No file is written, and windows
        are decoded when they are read. For functions that take a path and an opener, use
        ``terrain.geotiff().opener``. Heights of the full grid are those of `read`; overviews are
        averages, without a bound. The terrain must stay open.
        """
        from terrainwave.export.virtual_geotiff import VirtualGeoTIFF
        from terrainwave.raster_io.geotiff.sparse import GeoTIFFStream

        made = VirtualGeoTIFF(self)
        made.warn_of_crs()  # GDAL cannot pass on a warning turned into an error
        return GeoTIFFStream(made)

    def _repr_html_(self) -> str:
        from terrainwave.ext.html import terrain_html

        return terrain_html(self)

    # Pictures.

    def plot(
        self,
        ax: Any = None,
        *,
        bounds: Sequence[float] | None = None,
        cmap: str | None = None,
        shade: float = 0.7,
    ) -> Any:
        """Draw a map, coloured by height and hillshaded; needs matplotlib.

        Axes and colour bar have labels with units.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Where to draw; a new figure by default.
        bounds : (left, bottom, right, top), optional
            Area to show, in the CRS; by default all. The level read fits the size of the figure.
        cmap : str, optional
            matplotlib's name of a colour map. By default colours of land; on the Earth, heights
            below 0 get sea colours if some are below -450 m.
        shade : float
            Share of the hillshade, 0 … 1.

        Returns
        -------
        ax : matplotlib Axes
            In coordinates of the CRS; a rotated raster is drawn along its rows.
        """
        from terrainwave.render.window.static import plot

        shade = checked_number("shade", shade, least=0, most=1)

        return plot(self, ax, cmap=cmap, shade=shade, bounds=bounds)

    def view(
        self,
        *,
        size: tuple[int, int] = (960, 640),
        camera: str | None = None,
        bounds: Sequence[float] | None = None,
        max_pixel_error: float = 1.0,
        style: "Style | None" = None,
        mode: str = "adaptive",
        error: str = "measured",
        detail: float | None = None,
        order: int | None = None,
        stepwise: bool = False,
        tree: int | None = None,
        orientation: bool = False,
        drape: str | None = None,
        exaggeration: float = 1.0,
        radius: float | None = None,
    ) -> "Picture | None":
        """Open a window and fly over the terrain; in notebooks return a picture.

        Parameters
        ----------
        size : tuple of int
            Width and height in pixels.
        camera : str, optional
            ``x,y,z,heading,pitch,fov`` as `terrainwave view` prints it; by default all is shown.
        bounds : (left, bottom, right, top), optional
            Area to show first instead, in the CRS.
        max_pixel_error : float
            τ: largest distance of the picture from the original heights, in pixels.
        style : terrainwave.render.look.style.Style, optional
            Colours, light and haze.
        mode : str
            How to draw the terrain; docs/viewing.md describes the modes.
        error : {"measured", "paper", "coefficient"}
            Errors and formula that select blocks. coefficient is for mode rqt and files of cdf53.
        detail : float, optional
            With mode batched and error "paper": the error of a level is this factor, > 0, times its
            spacing; 0.5 by default.
        order : {2, 4}, optional
            With mode batched: order of the filter of levels; 4 by default.
        stepwise : bool
            With mode dynamic or vertex-texture: change one height of the quadtree in each frame.
        tree : int, optional
            With mode dynamic or vertex-texture: samples a side of a quadtree, a power of two from 2
            to 256; 16 by default.
        orientation : bool
            With mode adaptive, batched or loose: draw fewer triangles where the camera looks down.
        drape : str, optional
            Path or URL of an orthophoto to drape over the terrain.
        exaggeration : float
            Heights are multiplied by this factor, > 0.
        radius : float, optional
            Of the planet or moon in metres, > 0, for coordinates in degrees; by default that of the
            CRS's ellipsoid.

        Returns
        -------
        Picture, optional
            Where no window can be opened; notebooks show it, `Picture.save` writes a PNG. None
            after a window was closed.

        Raises
        ------
        InvalidArgumentError
            If an argument is invalid, or the mode does not support it.
        TerrainwaveError
            If neither a window nor OpenGL without a window is available; the message says what to
            install.
        """
        given = {name: value for name, value in locals().items() if name != "self"}
        from terrainwave.render.look.style import Style
        from terrainwave.render.window.static import view
        from terrainwave.render.window.view_options import ViewOptions

        return view(self, **vars(ViewOptions(**given)) | {"style": style or Style()})

    def explore(
        self,
        *,
        camera: Mapping[str, float] | None = None,
        height: int = 480,
        radius: float | None = None,
    ) -> "Explorer":
        """Return a map in 3-D for notebooks: the last line of a cell shows it.

        It is the page of `terrainwave publish` as a Jupyter widget. The kernel reads the file, so
        it needs no server, and local files, URLs and private stores work alike. The terrain must
        stay open. Where notebooks show no widgets, there is a picture instead.

        Parameters
        ----------
        camera : dict, optional
            ``lon`` and ``lat`` in degrees, ``zoom``, ``pitch`` and ``bearing``, as in the map; by
            default the map shows all of the terrain.
        height : int
            Of the map in pixels, 100 … 10000; it is as wide as the cell.
        radius : float, optional
            Of the planet or moon in metres, > 0, for coordinates in degrees; by default that of the
            CRS's ellipsoid.

        Returns
        -------
        Explorer
            Its `camera` is the view, and moves the map if you set it. Its `window` is the area
            drawn on the map, as ``terrain.read(window=...)`` takes it; None if nothing is drawn.

        Raises
        ------
        TerrainwaveError
            If anywidget or pyproj is not installed.
        InvalidHeightsError
            If the raster has no position on a globe, or none that polynomials can express.
        InvalidArgumentError
            If an argument is out of range.
        """
        from terrainwave.extras import need

        need("anywidget", extra="notebook", purpose="explore")
        from terrainwave.ext.notebook.explorer import explorer_of

        return explorer_of(self, camera=camera, height=height, radius=radius)
