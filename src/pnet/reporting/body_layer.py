"""Estimated bodies as a sheet of glass to lay over a picture."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, maximum_filter

from pnet.geometry.camera import Camera
from pnet.reporting.picture import (
    OVERSAMPLING,
    first_hits,
    open_sky,
    outlines,
    oversampled,
    pixel_rays,
)
from pnet.reporting.relief import nearest
from pnet.reporting.scene_view import Bodies

Points = NDArray[np.float64]

_ROWS = 256  # of rays that are cast together, which bounds the memory
_BEFORE = 0.003  # metres: what was measured so far before a body hides it
_LINE = 3  # rendered pixels of a body's outline
_OPACITY = (1.0, 0.55)  # of outlines and of what they enclose
_BRIGHT = 0.75  # share of the way from white to their colour of outlines
_HIDDEN = (0.4, 0.15)  # the same where something lies before them


@dataclass(frozen=True, eq=False)
class Layer:
    """The estimated bodies as a sheet over a picture.

    Attributes:
        image: (h, w, 4) colour and opacity in [0, 1]. owner: (h, w) int64 whose body is seen in each pixel,
            −1 where none is.
    """

    image: Points
    owner: NDArray[np.int64]


def body_layer(view: Camera, bodies: Bodies, colours: Points, surface: Points | None = None) -> Layer:
    """Bodies as glass of their colour within firm outlines; paler where something was measured before them.

    Args:
        view: the camera. bodies: camera frame. colours: (d, 3) in [0, 1], of the bodies' owners.
        surface: see `measured_surface`; None: nothing is hidden by it.
    """
    shape = (view.height, view.width)
    image, body = np.zeros((*shape, 4)), np.full(shape, -1)
    left, top, right, bottom = _window_of(view, np.asarray(bodies.mesh.vertices))
    if left < right and top < bottom:
        fine = oversampled(_cut(view, left, top, right, bottom))
        seen, light, owner = _cast(fine, bodies)
        hidden = np.zeros(owner.shape, bool)
        if surface is not None:
            whole = (OVERSAMPLING * view.height, OVERSAMPLING * view.width)
            rows, columns = (
                slice(OVERSAMPLING * a, OVERSAMPLING * b) for a, b in ((top, bottom), (left, right))
            )
            # the deepest of neighbours: noise does not count, nor pixels that do not fit exactly at a step
            measured = nearest(maximum_filter(surface, 3), whole)[rows, columns]
            hidden = (measured > 0) & (measured < seen - _BEFORE)
        image[top:bottom, left:right] = _glass(owner, light, hidden, colours)
        body[top:bottom, left:right] = owner[::OVERSAMPLING, ::OVERSAMPLING]
    return Layer(image, body)


def _glass(
    owner: NDArray[np.int64], light: NDArray[np.float32], hidden: NDArray[np.bool_], colours: Points
) -> Points:
    """The image of a `Layer` out of oversampled ones (h, w)."""
    body = owner >= 0
    line = binary_dilation(outlines(owner), iterations=_LINE - 1) & body
    colour = np.concatenate([colours, np.zeros((1, 3))]).astype(np.float32)[owner]
    colour *= light[..., None]
    colour[line] = 1 - _BRIGHT * (1 - colours[owner[line]])
    opacity = np.array([*_OPACITY, *_HIDDEN, 0], np.float32)[np.where(body, 2 * hidden + ~line, 4)]
    n = OVERSAMPLING
    cells = [(slice(i, None, n), slice(j, None, n)) for i in range(n) for j in range(n)]
    mean = np.mean([opacity[cell] for cell in cells], axis=0)
    mixed = np.mean([opacity[cell][..., None] * colour[cell] for cell in cells], axis=0)
    return np.clip(np.concatenate([mixed / np.maximum(mean, 1e-6)[..., None], mean[..., None]], -1), 0, 1)


def _cast(view: Camera, bodies: Bodies) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int64]]:
    """(h, w) depth, light and owner of the nearest body in every pixel; owner −1 where none is."""
    shape = (view.height, view.width)
    depth, light, owner = np.full(shape, np.inf, np.float32), np.zeros(shape, np.float32), np.full(shape, -1)
    for first in range(0, view.height, _ROWS):
        hits = first_hits(
            bodies, pixel_rays(_cut(view, 0, first, view.width, min(first + _ROWS, view.height)))
        )
        ahead = hits.depth > 0  # not from within a body
        pixels = first * view.width + hits.ray[ahead]
        depth.flat[pixels], owner.flat[pixels] = hits.depth[ahead], hits.body[ahead]
        light.flat[pixels] = 0.3 + 0.8 * open_sky(hits.normal[ahead])
    return depth, light, owner


def _cut(view: Camera, left: int, top: int, right: int, bottom: int) -> Camera:
    """Some columns and rows of a view."""
    return replace(view, width=right - left, height=bottom - top, cx=view.cx - left, cy=view.cy - top)


def _window_of(view: Camera, vertices: Points) -> tuple[int, int, int, int]:
    """First column and row, and one past the last ones, of the pixels in which bodies may be."""
    size = np.array([view.width, view.height])
    if not len(vertices) or (vertices[:, 2] <= 1e-3).any():
        low, high = np.zeros(2), size * (len(vertices) > 0)
    else:
        pixels = view.project(vertices)
        low, high = np.clip([np.floor(pixels.min(0)), np.ceil(pixels.max(0)) + 1], 0, size)
    (left, top), (right, bottom) = low.astype(int).tolist(), high.astype(int).tolist()
    return left, top, right, bottom
