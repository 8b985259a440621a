"""Silhouettes and boxes of single bodies, as BOP's scene_gt_info.json and masks want them."""

import math
from dataclasses import replace

import numpy as np
import trimesh
from numpy.typing import NDArray

from pnet.geometry.camera import Camera
from pnet.scenes.rendering import Points, render_view

NOWHERE = [-1, -1, -1, -1]  # the box of no pixel

Mask = NDArray[np.bool_]


def box_of(mask: Mask, left: int = 0, top: int = 0) -> list[int]:
    """Box of a mask's pixels as the benchmark counts it.

    Args:
        mask: (h, w). left, top: image coordinates of its first pixel.
    Returns:
        First column and row, last less first column and row; pixels. `NOWHERE` where the mask is empty.
    """
    v, u = np.nonzero(mask)
    if not len(u):
        return NOWHERE
    x, y = int(u.min()), int(v.min())
    return [x + left, y + top, int(u.max()) - x, int(v.max()) - y]


def silhouette(camera: Camera, mesh: trimesh.Trimesh, R: Points, t: Points) -> tuple[Mask, list[int]]:
    """A body alone.

    Args:
        camera: the view; how far it sees does not count. mesh: the part object, part frame, metres.
        R: (3, 3), t: (3,) part → camera, metres; wholly in front of the camera's near plane.
    Returns:
        (h, w) pixels of the body; box of its whole silhouette, also outside of the image (see `box_of`).
    """
    pixels = camera.project(mesh.vertices @ R.T + t)
    left, top = (int(x) for x in np.ceil(pixels.min(0)))
    width, height = (max(int(x), 1) for x in np.floor(pixels.max(0)) - (left - 1, top - 1))
    window = replace(
        camera, width=width, height=height, cx=camera.cx - left, cy=camera.cy - top, far=math.inf
    )
    inner = render_view(window, mesh, R[None], t[None]).instance == 0
    mask = np.zeros((camera.height, camera.width), bool)
    rows, columns = (slice(max(a, 0), max(a + n, 0)) for a, n in ((top, height), (left, width)))
    cut = inner[max(-top, 0) :, max(-left, 0) :]
    target = mask[rows, columns]
    target[:] = cut[: target.shape[0], : target.shape[1]]
    return mask, box_of(inner, left, top)
