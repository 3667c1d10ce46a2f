"""A scene with its own framebuffer, for the window or for pictures without one."""

from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import InvalidArgumentError, TerrainwaveError
from terrainwave.extras import need
from terrainwave.file import TerrainFile
from terrainwave.grid.quadtree import Region
from terrainwave.render import DEFAULT_MAX_BYTES
from terrainwave.render.gpu.shaders import SOLID_ALPHA
from terrainwave.render.look.drape_detail import DETAIL_SIDE
from terrainwave.render.look.style import Style
from terrainwave.render.look.water import read_water
from terrainwave.render.modes import mode_class
from terrainwave.render.modes.mode import Frames
from terrainwave.render.paging.scene import Scene
from terrainwave.render.scene.camera import Camera, Viewport, focal_length
from terrainwave.render.scene.frame import Frame
from terrainwave.render.scene.selection import View
from terrainwave.render.scene.walls import Solid, build_solid

if TYPE_CHECKING:
    from terrainwave.raster_io.drape import Drape, Photo

_HELP = (
    "terrainwave render needs EGL and an OpenGL 3.3 driver; on Debian and Ubuntu: apt-get install"
    " libegl1 libgl1 libgl1-mesa-dri"
)
# The drape takes at most this fraction (1 / n) of the memory.
_DRAPE_SHARE = 4


def create_context() -> Any:
    """Return an OpenGL 3.3 core context without a window."""
    moderngl = need("moderngl", extra="view", purpose="drawing")
    problems = []
    backends: tuple[dict[str, Any], ...] = ({"backend": "egl"}, {})
    for options in backends:
        try:
            return moderngl.create_context(standalone=True, require=330, **options)
        except Exception as error:  # noqa: BLE001  glcontext raises what its backend raises
            problems.append(str(error).splitlines()[0] if str(error) else type(error).__name__)
    raise TerrainwaveError(f"no OpenGL context ({'; '.join(problems)}): {_HELP}")


def _open_photo(terrain: TerrainFile, path: str) -> "Photo":
    from terrainwave.raster_io.drape import Photo  # imported late: rasterio

    return Photo(path, crs=terrain.crs, affine=terrain.raster_info.transform, shape=terrain.shape)


def _from_above(
    frame: Frame, eye: NDArray[np.float64], region: Region, near: float, far: float
) -> NDArray[np.float64]:
    """Return a projection of positions relative to an eye, 4 x 4: a pixel for each sample.

    Depths are those of heights from `near` to `far`.
    """
    a, b, c, d, e, f = frame.sample_matrix
    matrix = np.eye(4)
    matrix[:2, :2] = np.linalg.inv(np.array([[a, b], [d, e]]))
    first = matrix[:2, :2] @ (eye[:2] - (c, f)) - (region.col, region.row)
    shape = np.array([region.n_cols, region.n_rows], dtype=np.float64)
    matrix[:2, :2] *= (2 / shape)[:, None]
    matrix[:2, 3] = (first + 0.5) * 2 / shape - 1
    matrix[2, 2] = 2 / (far - near)
    matrix[2, 3] = (eye[2] - near) * 2 / (far - near) - 1
    return matrix


class _Drawn(NamedTuple):
    view: View
    depth_range: tuple[float, float]
    frames: Frames


class Canvas:
    """A scene with its own framebuffer, which the window shows and commands save."""

    def __init__(
        self,
        terrain: TerrainFile,
        size: tuple[int, int],  # width and height in pixels
        *,
        mode: str = "adaptive",  # one of `terrainwave.render.modes.MODES`
        # path or URL of an orthophoto to drape over the terrain, as for `raster_io.drape.Photo`
        drape: str | None = None,
        samples: int = 4,  # samples per pixel, for smooth edges; 0 none
        max_bytes: int = DEFAULT_MAX_BYTES,
        context: Any = None,
        # leave out parts that may take long to read: the block under the terrain until `set_solid`,
        # the orthophoto until the renderer's `set_drape`, and water until its `set_water`
        is_late: bool = False,
        **options: Any,  # of `Scene`
    ) -> None:
        mode_class(mode)  # raises for unknown ones, before anything is opened
        self._owns_context = context is None
        self.context = context or create_context()
        from terrainwave.render.gpu.renderer import Renderer  # imported late: moderngl
        from terrainwave.render.gpu.surfaces import surface_of

        self.photo = None if drape is None else _open_photo(terrain, drape)
        side = int(self.context.info["GL_MAX_TEXTURE_SIZE"])
        if is_late:  # finer parts follow as the camera approaches
            side = min(side, DETAIL_SIDE)
        self._drape_limits = side, max_bytes // _DRAPE_SHARE
        picture = None if is_late else self.read_drape()
        self._drape_bytes = self._bytes_of_drape(has_detail=is_late)
        self.surface = surface_of(
            mode, self.context, terrain.grid.block, max_bytes=max_bytes - self._drape_bytes
        )
        self.store = self.surface.store
        self.scene = Scene(terrain, self.store, mode=mode, **options)
        self._has_horizon = self.scene.has_horizon
        self._samples = min(samples, int(self.context.max_samples))
        self._target: Any = None
        self.framebuffer: Any = None
        self._drawn: Any = None  # a `_Drawn` once there is a picture
        try:
            solid = None if is_late else build_solid(terrain, self.scene.frame)
            self.has_voids = solid is not None and solid.has_lids
            self.water = None if is_late else read_water(terrain, self.scene.frame)
            self.renderer = Renderer(
                self.context, self.scene, self.surface, picture, solid, self.water
            )
            self.resize(size)
        except BaseException:
            self.scene.close()  # otherwise its threads would continue
            raise

    def set_solid(self, solid: Solid) -> None:
        self.has_voids = solid.has_lids
        self.renderer.set_solid(solid)

    def read_drape(self) -> "Drape | None":
        """Return the whole orthophoto, read now, in any thread; None without one."""
        return None if self.photo is None else self.photo.whole(*self._drape_limits)

    @property
    def drape_texels_per_pixel(self) -> float:
        assert self.photo is not None
        width, _ = self.photo.size(*self._drape_limits)
        return width / self.photo.place[2]

    def _bytes_of_drape(self, *, has_detail: bool) -> int:
        if self.photo is None:
            return 0
        width, height = self.photo.size(*self._drape_limits)
        texels = width * height + (DETAIL_SIDE**2 if has_detail else 0)
        return texels * 4 * 4 // 3

    @property
    def n_bytes(self) -> int:
        return self.store.n_bytes + self._drape_bytes

    def resize(self, size: tuple[int, int]) -> None:
        limit = int(self.context.info["GL_MAX_VIEWPORT_DIMS"][0])
        if not (1 <= min(size) and max(size) <= limit):
            raise InvalidArgumentError(
                f"found `size` {size[0]}x{size[1]}, expected at most {limit} pixels each way"
            )
        self._release_framebuffers()
        self.viewport = Viewport(*size)
        self._target = self._framebuffer(size, self._samples)
        self.framebuffer = self._framebuffer(size, 0) if self._samples else self._target

    def _framebuffer(self, size: tuple[int, int], samples: int) -> Any:
        return self.context.framebuffer(
            [self.context.renderbuffer(size, 4, samples=samples)],
            self.context.depth_renderbuffer(size, samples=samples),
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self.scene.close()
        if self.photo is not None:
            self.photo.close()
        self.renderer.release()
        self._release_framebuffers()
        if self._owns_context:
            self.context.release()

    def _release_framebuffers(self) -> None:
        if self._target is None:
            return
        # moderngl binds the last framebuffer used again, released or not.
        self.context.detect_framebuffer(0).use()
        if self.framebuffer is not self._target:
            self.framebuffer.release()
        self._target.release()

    def draw(
        self,
        camera: Camera,
        style: Style,
        *,
        max_pixel_error: float = 1.0,
        settle: bool = True,
    ) -> Frames:
        """Draw a picture and leave it on the GPU, in `framebuffer`; return its frames.

        `settle` waits until everything in view has been read. If a pixel has several samples, its
        colour is their mean, and its depth is one of theirs or a mean, too.
        """
        view = self.scene.view(camera, self.viewport, max_pixel_error)
        self.scene.has_horizon = self._has_horizon and not style.wireframe
        self._target.use()
        if self.scene.mode.is_partwise:
            frames = self._draw_parts(view, style)
        else:
            frames = self.scene.settle(view) if settle else self.scene.update(view)
            self.renderer.draw(view, frames, style)
        self._drawn = _Drawn(view, self.renderer.depth_range(view, frames), frames)
        if self.framebuffer is not self._target:
            self.context.copy_framebuffer(self.framebuffer, self._target)
        return frames

    @property
    def camera(self) -> Camera:
        return self._drawn.view.camera

    @property
    def kept_error(self) -> float:
        return self.scene.kept_error(self._drawn.view, self._drawn.frames)

    def picture(
        self, camera: Camera, style: Style, *, max_pixel_error: float = 1.0, settle: bool = True
    ) -> tuple[NDArray[np.uint8], Frames]:
        """Return the picture, uint8 (height, width, 3), the first row on top, and its frames.

        As `draw`.
        """
        frames = self.draw(camera, style, max_pixel_error=max_pixel_error, settle=settle)
        return self.grab(), frames

    def grab(self) -> NDArray[np.uint8]:
        """Return the last picture, uint8 (height, width, 3), the first row on top."""
        data = self.framebuffer.read(components=3, alignment=1)
        size = (self.viewport.height, self.viewport.width, 3)
        return np.frombuffer(data, dtype=np.uint8).reshape(size)[::-1].copy()

    def is_blank(self) -> bool:
        """Return whether the last picture shows no terrain. Waits for the GPU."""
        return not self._shows_terrain((0, 0, self.viewport.width, self.viewport.height)).any()

    def _shows_terrain(self, part: tuple[int, int, int, int]) -> NDArray[np.bool_]:
        """Return which pixels of a part of the last picture are terrain, not sky, wall or hatch."""
        data = self.framebuffer.read(part, components=1, attachment=-1, dtype="f4")
        colors = self.framebuffer.read(part, components=4, alignment=1)
        # If samples of a pixel differ, the majority counts.
        is_data = np.frombuffer(colors, dtype=np.uint8)[3::4] > (255 + SOLID_ALPHA) // 2
        return (np.frombuffer(data, dtype=np.float32) < 1.0) & is_data

    def pick(self, x: float, y: float) -> NDArray[np.float64] | None:
        """Return the point of the last picture's surface under a pixel (y down), in local metres.

        None for sky, and for walls and hatch, which are not data. Waits for the GPU.
        """
        if self._drawn is None or not (
            0 <= x < self.viewport.width and 0 <= y < self.viewport.height
        ):
            return None
        _, places = self.places_seen((int(x), self.viewport.height - 1 - int(y), 1, 1))
        return places[0] if len(places) else None

    def places_seen(
        self, part: tuple[int, int, int, int] | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the centres of the last picture's terrain pixels, and the points there.

        Pixels (x right, y down), shape (n, 2), and local metres, shape (n, 3). By default of the
        whole picture; a part is its left and lower pixel, counted upwards, width and height. Waits
        for the GPU.
        """
        view, (near, far), _ = self._drawn
        part = part or (0, 0, self.viewport.width, self.viewport.height)
        data = self.framebuffer.read(part, components=1, attachment=-1, dtype="f4")
        shown = np.flatnonzero(self._shows_terrain(part))
        depth = np.frombuffer(data, dtype=np.float32)[shown].astype(np.float64)
        depth = 2 * near * far / (far + near - (2 * depth - 1) * (far - near))
        up, right = np.divmod(shown, part[2])
        x, y = part[0] + right + 0.5, self.viewport.height - (part[1] + up + 0.5)
        focal = focal_length(view.camera, self.viewport)
        across = np.column_stack([
            (x - self.viewport.width / 2) / focal, (self.viewport.height / 2 - y) / focal,
            np.ones(len(shown)),
        ])  # fmt: skip
        places = view.camera.eye + (across * depth[:, None]) @ view.camera.axes
        return np.column_stack([x, y]), places

    def samples_in_view(self) -> Region:
        """Return the samples of the full grid around all terrain in the last picture."""
        _, places = self.places_seen()
        grid = Region(0, 0, *self.scene.frame.shape)
        if not len(places):
            return grid._replace(n_rows=0, n_cols=0)
        rows, cols = self.scene.frame.samples_at(places[:, :2])
        first = int(np.floor(rows.min())), int(np.floor(cols.min()))
        last = int(np.ceil(rows.max())), int(np.ceil(cols.max()))
        return Region(*first, last[0] - first[0] + 1, last[1] - first[1] + 1).intersect(grid)

    def drawn_heights(self, region: Region, style: Style) -> NDArray[np.float64]:
        """Return the last picture's surface at samples of the full grid: its highest and lowest.

        Local z, shape (2, n_rows, n_cols), NaN where nothing is drawn. The pieces of the picture
        are drawn once more, from above, with a pixel for each sample.
        """
        (view, _, drawn), shape = self._drawn, region.shape
        low, high = (float(corner[2]) for corner in self.scene.frame.solid_box)
        low, high = low - (high - low), high + (high - low)  # surfaces may leave the box
        ends = [(high, low), (low, high)]
        targets = [self._framebuffer(shape[::-1], 0) for _ in ends]
        try:
            for target in targets:
                target.clear(depth=1.0)
            is_partwise = self.scene.mode.is_partwise
            for frames in self.scene.parts(view) if is_partwise else [drawn]:
                for target, (near, far) in zip(targets, ends, strict=True):
                    target.use()
                    matrix = _from_above(self.scene.frame, view.camera.eye, region, near, far)
                    self.renderer.draw_terrain(view, frames, style, matrix)
            found = []
            for target, (near, far) in zip(targets, ends, strict=True):
                data = target.read(components=1, attachment=-1, dtype="f4", alignment=1)
                depth = np.frombuffer(data, dtype=np.float32).reshape(shape).astype(np.float64)
                found.append(np.where(depth < 1, near + depth * (far - near), np.nan))
        finally:
            self.framebuffer.use()
            for target in targets:
                target.release()
        return np.stack(found)

    def metres_per_pixel(self) -> float | None:
        """Return the scale at the middle of the last picture, or else at the raster's middle.

        None if the first shows no terrain and the second is behind the camera.
        """
        if self._drawn is None:
            return None
        camera = self._drawn.view.camera
        middle = self.pick(self.viewport.width / 2, self.viewport.height / 2)
        if middle is None:
            middle = np.mean(self.scene.frame.box, axis=0)
        away = float((middle - camera.eye) @ camera.forward)
        return away / focal_length(camera, self.viewport) if away > 0 else None

    def _draw_parts(self, view: View, style: Style) -> Frames:
        """Draw all finest blocks in view, as many at a time as fit into memory."""
        self.renderer.clear(view, style)
        none = np.empty(0)
        frames = Frames(np.empty(0, dtype=np.int32), none, none, none, 0, 0.0, 0)
        nodes, distances, n_triangles = [frames.nodes], [none], 0
        for frames in self.scene.parts(view):
            self.renderer.draw_terrain(view, frames, style)
            nodes.append(frames.nodes)
            distances.append(frames.distances)
            n_triangles += frames.n_triangles
        self.renderer.draw_solid(view, frames, style)
        return Frames(
            np.concatenate(nodes), np.concatenate(distances), none, none, n_triangles, 0.0, 0
        )
