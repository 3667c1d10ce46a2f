"""Pictures without a screen."""

from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from terrainwave.errors import TerrainwaveError
from terrainwave.render.camera import Camera, Viewport
from terrainwave.render.scene import DEFAULT_MAX_BYTES, Frames, Scene
from terrainwave.render.selection import View

if TYPE_CHECKING:
    from terrainwave.render.renderer import Style
    from terrainwave.terrain import Terrain

_HELP = (
    "terrainwave render needs EGL and an OpenGL 3.3 driver; on Debian and Ubuntu: apt-get install"
    " libegl1 libgl1 libgl1-mesa-dri"
)


def create_context() -> Any:
    """Return an OpenGL 3.3 core context without a window.

    Raises
    ------
    TerrainwaveError
        If moderngl or a driver is missing; one line that says what to install.
    """
    try:
        import moderngl
    except ImportError as error:
        raise TerrainwaveError("pictures need moderngl: pip install 'terrainwave[view]'") from error
    problems = []
    backends: tuple[dict[str, Any], ...] = ({"backend": "egl"}, {})
    for options in backends:
        try:
            return moderngl.create_context(standalone=True, require=330, **options)
        except Exception as error:  # noqa: BLE001  glcontext raises what its backend raises
            problems.append(str(error).splitlines()[0] if str(error) else type(error).__name__)
    raise TerrainwaveError(f"no OpenGL context ({'; '.join(problems)}): {_HELP}")


class Offscreen:
    """A scene with a framebuffer of its own.

    Parameters
    ----------
    size : tuple of int
        Width and height in pixels.
    samples : int
        Per pixel, against jagged edges; 0 none.
    options
        Of `Scene`.
    """

    def __init__(
        self,
        terrain: "Terrain",
        size: tuple[int, int],
        *,
        samples: int = 4,
        max_bytes: int = DEFAULT_MAX_BYTES,
        context: Any = None,
        **options: Any,
    ) -> None:
        self._owns_context = context is None
        self.context = context or create_context()
        from terrainwave.render.mesh_buffers import GpuStore
        from terrainwave.render.renderer import Renderer

        limit = int(self.context.info["GL_MAX_VIEWPORT_DIMS"][0])
        if not (1 <= min(size) and max(size) <= limit):
            raise TerrainwaveError(f"found size {size[0]}x{size[1]}, expected 1 to {limit} pixels")
        self.viewport = Viewport(*size)
        self.store = GpuStore(self.context, terrain.grid.block, max_bytes=max_bytes)
        self.scene = Scene(terrain, self.store, **options)
        self.renderer = Renderer(self.context, self.scene, self.store)
        samples = min(samples, int(self.context.max_samples))
        self._target = self._framebuffer(size, samples)
        self._resolved = self._framebuffer(size, 0) if samples else self._target

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
        """Stop the workers and free the GPU's memory."""
        self.scene.close()
        self.renderer.release()
        self.store.release()
        # moderngl binds the last framebuffer used again, released or not.
        self.context.detect_framebuffer(0).use()
        if self._resolved is not self._target:
            self._resolved.release()
        self._target.release()
        if self._owns_context:
            self.context.release()

    def picture(
        self, camera: Camera, style: "Style", *, max_pixel_error: float = 1.0, settle: bool = True
    ) -> tuple[NDArray[np.uint8], Frames]:
        """Return the picture, uint8 (height, width, 3), the first row on top, and what was drawn.

        `settle` waits until all that the view needs has been read.
        """
        view = self.scene.view(camera, self.viewport, max_pixel_error)
        self._target.use()
        if self.scene.mode == "full":
            frames = self._draw_parts(view, style)
        else:
            frames = self.scene.settle(view) if settle else self.scene.update(view)
            self.renderer.draw(view, frames, style)
        if self._resolved is not self._target:
            self.context.copy_framebuffer(self._resolved, self._target)
        data = self._resolved.read(components=3, alignment=1)
        size = (self.viewport.height, self.viewport.width, 3)
        return np.frombuffer(data, dtype=np.uint8).reshape(size)[::-1].copy(), frames

    def _draw_parts(self, view: View, style: "Style") -> Frames:
        """Draw all finest blocks in view, as many at a time as memory holds."""
        self.renderer.clear(view, style)
        nodes, n_triangles = [np.empty(0, dtype=np.int32)], 0
        none = np.empty(0)
        for frames in self.scene.parts(view):
            self.renderer.draw(view, frames, style, clear=False)
            nodes.append(frames.nodes)
            n_triangles += frames.n_triangles
        return Frames(np.concatenate(nodes), none, none, none, n_triangles, 0.0, 0)
