"""A depth image in grey, lit by its normals, whatever its noise."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pnet.geometry.camera import Camera
from pnet.reporting.picture import BACKGROUND, surface_light

Points = NDArray[np.float64]

SURFACE = np.array([0.62, 0.64, 0.67])  # what was measured, in full light
_STRIP = 32  # rows whose slopes are found together: they fit the processor's cache
_ROUNDING = 0.002  # metres: steps between depths up to it come of rounding
_LONE = 1e-3  # added to the sums of squares: pixels without neighbours face the camera
_ENOUGH = 1_000_000  # pixels that tell the noise


def measured_surface(depth: NDArray[np.floating], view: Camera) -> Points:
    """(h, w) planar depth, metres, 0 where nothing was measured; reduced where the view has fewer pixels."""
    if depth.shape[0] > view.height or depth.shape[1] > view.width:
        depth = nearest(depth, (view.height, view.width))
    return np.where(np.isfinite(depth) & (depth > 1e-6), depth, 0).astype(np.float64)


def surface_image(surface: Points, view: Camera) -> Points:
    """What was measured in grey and lit, (h, w, 3) of the view, background where nothing is.

    Args:
        surface: see `measured_surface`. view: the camera, `resized`.
    """
    measured = surface > 0
    light = np.zeros(surface.shape)
    if measured.any():
        normal = surface_normals(surface, with_size(view, surface.shape[1], surface.shape[0]))
        light[measured] = surface_light(normal[measured], surface[measured])
    lit = np.clip(light[..., None] * SURFACE, 0, 1)
    image = np.where(measured[..., None], lit, BACKGROUND)
    shown = Image.fromarray((255 * image + 0.5).astype(np.uint8))
    return np.asarray(shown.resize((view.width, view.height), Image.Resampling.BICUBIC)) / 255


def nearest(image: NDArray[np.floating], shape: tuple[int, int]) -> NDArray[np.floating]:
    """An image at another resolution (h, w), each pixel the nearest of the given ones."""
    rows, columns = (
        ((np.arange(n) + 0.5) * m / n).astype(int) for n, m in zip(shape, image.shape, strict=True)
    )
    return image[rows[:, None], columns]


def surface_normals(depth: NDArray[np.floating], camera: Camera) -> Points:
    """(h, w, 3) unit normals towards the camera, of planes fitted to each pixel's neighbours on its surface.

    The window is as large as the noise asks for. A plane is linear in inverse depth, and stereo noise is
    even in it.

    Args:
        depth: (h, w) planar, metres, 0 where nothing was measured.
    """
    inverse = np.divide(1, depth, where=depth > 0, out=np.zeros(depth.shape)).astype(np.float32)
    noise = depth_noise(depth)
    typical = float(np.median(inverse[inverse > 0]))
    reach = _window(noise * camera.fx / typical)
    reject = 4 * noise + 4 * reach * np.maximum(inverse, 1e-3) / camera.fx  # beyond: another surface
    along, down = _slopes(inverse, reach, reject)
    v, u = np.mgrid[: camera.height, : camera.width]
    x, y = along * camera.fx, down * camera.fy
    z = inverse - along * (u - camera.cx) - down * (v - camera.cy)
    normal = -np.stack([x, y, z], -1).astype(np.float64)
    return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)


def depth_noise(depth: NDArray[np.floating]) -> float:
    """Standard deviation of the noise in inverse depth (1/m), from what is no plane among three neighbours.

    At least that of rounding, where the depths are multiples of a step.

    Args:
        depth: (h, w) planar, metres, 0 where nothing was measured; something must be.
    """
    across = (depth if depth.shape[1] > 2 else depth.T)[:: max(depth.size // _ENOUGH, 1)]
    triple = np.stack([across[:, :-2], across[:, 1:-1], across[:, 2:]]).reshape(3, -1)
    triple = triple[:, (triple > 0).all(0)]
    bend = np.abs((1 / triple).T @ [1.0, -2.0, 1.0]) if triple.size else np.zeros(1)
    values = depth[depth > 0]
    values = np.unique(values[:: max(len(values) // 20_000, 1)])
    step = float(np.median(np.diff(values))) if len(values) > 1 else 0.0
    step = step if step <= _ROUNDING else 0.0
    return max(1.4826 * float(np.median(bend)) / 6**0.5, 0.3 * step / float(np.median(values)) ** 2)


def _window(noise: float) -> int:
    """Half width in pixels of the smallest window whose normals are good to some 3 degrees.

    Args:
        noise: of the depth, against a pixel's width on a surface that faces the camera.
    """
    return next((r for r in (1, 2, 3) if noise**2 <= 0.05**2 * (2 * r + 1) ** 2 * r * (r + 1) / 3), 4)


def _slopes(q: NDArray[np.float32], reach: int, reject: NDArray[np.floating]) -> tuple[Points, Points]:
    """Weighted least squares planes through each pixel's window: their slopes along rows and columns, 1/px.

    Args:
        q: (h, w) inverse depth, 0 where missing. reach: half width, pixels.
        reject: (h, w) differences from the middle of which a neighbour has no weight.
    """
    around, scale = np.pad(q, reach), (1 / reject**2).astype(np.float32)
    tops = range(0, len(q), _STRIP)  # in the processor's cache it is twice as fast
    strips = [(around[i : i + _STRIP + 2 * reach], scale[i : i + _STRIP]) for i in tops]
    along, down = zip(*(_strip_slopes(*strip, reach) for strip in strips), strict=True)
    return np.concatenate(along), np.concatenate(down)


def _strip_slopes(
    around: NDArray[np.float32], scale: NDArray[np.float32], reach: int
) -> tuple[Points, Points]:
    """`_slopes` of some rows; around: (h + 2 reach, w + 2 reach), scale: (h, w)."""
    h, w = scale.shape
    middle = around[reach : reach + h, reach : reach + w]
    n, u, v, uu, uv, vv, s, us, vs = np.zeros((9, h, w), np.float32)
    for dv in range(-reach, reach + 1):
        weights, values = np.zeros((3, h, w), np.float32), np.zeros((2, h, w), np.float32)
        for du in range(-reach, reach + 1):
            other = around[reach + dv : reach + dv + h, reach + du : reach + du + w]
            change = other - middle
            weight = np.maximum(1 - change * change * scale, 0)
            weight *= weight  # 0 where nothing was measured: that is far away in inverse depth
            change *= weight
            weights += np.multiply.outer(np.array([1, du, du * du], np.float32), weight)
            values += np.multiply.outer(np.array([1, du], np.float32), change)
        n, u, uu, s, us = n + weights[0], u + weights[1], uu + weights[2], s + values[0], us + values[1]
        v, uv, vv = v + dv * weights[0], uv + dv * weights[1], vv + dv * dv * weights[0]
        vs = vs + dv * values[0]
    n = np.maximum(n, 1e-6)
    suu, suv, svv = uu - u * u / n + _LONE, uv - u * v / n, vv - v * v / n + _LONE
    sus, svs = us - u * s / n, vs - v * s / n
    determinant = suu * svv - suv * suv
    return (sus * svv - svs * suv) / determinant, (svs * suu - sus * suv) / determinant


def with_size(camera: Camera, width: int, height: int) -> Camera:
    """The same view in another number of pixels."""
    across, down = width / camera.width, height / camera.height
    return replace(
        camera,
        width=width,
        height=height,
        fx=across * camera.fx,
        fy=down * camera.fy,
        cx=across * (camera.cx + 0.5) - 0.5,
        cy=down * (camera.cy + 0.5) - 0.5,
    )
