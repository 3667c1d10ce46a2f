"""View frustum as planes."""

import math

import numpy as np
from numpy.typing import NDArray

from terrainwave.render.scene.camera import Camera, Viewport
from terrainwave.render.scene.select_kernels import is_outside


def frustum_planes(camera: Camera, viewport: Viewport) -> NDArray[np.float64]:
    """Return five inward planes, shape (5, 4): left, right, bottom, top and one through the eye.

    They are unit normals and offsets: n·p + w >= 0 inside. There is no far plane.
    """
    vertical = math.tan(math.radians(camera.fov) / 2)
    horizontal = vertical * viewport.aspect
    seen = np.array(
        [
            [1.0, 0.0, horizontal],
            [-1.0, 0.0, horizontal],
            [0.0, 1.0, vertical],
            [0.0, -1.0, vertical],
            [0.0, 0.0, 1.0],
        ]
    )
    planes = np.empty((len(seen), 4))
    planes[:, :3] = seen @ camera.axes
    planes[:, :3] /= np.linalg.norm(planes[:, :3], axis=1, keepdims=True)
    planes[:, 3] = -planes[:, :3] @ camera.eye
    return planes


def may_see(
    planes: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]
) -> bool:
    """Return whether a box may be in view; never False for one that is."""
    return not is_outside(planes, tuple(low), tuple(high))
