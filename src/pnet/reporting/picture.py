"""A still picture of one scene, made without a GPU: the cloud as the camera sees it, and the estimates."""

from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path

import numpy as np
import trimesh
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pnet.geometry.camera import Camera
from pnet.parts.base import ParametricPart
from pnet.records import Detections, Scene
from pnet.reporting.scene_view import (
    AXIS_COLOURS,
    GREY,
    Bodies,
    detected_bodies,
    estimated_axes,
    instance_colours,
    point_colours,
)
from pnet.scenes.record_file import write_atomically

Points = NDArray[np.float64]

SIZE = (1600, 900)  # pixels
PANEL = 784  # pixels, square
BACKGROUND = (0.055, 0.067, 0.086)
OVERSAMPLING = 2
_SECTIONS = 72  # polygon sides of a circle
_LIGHTS = 64  # directions of the sky
_SHADOW_CELL = 3  # rendered pixels a side that share their shadows, which makes it several times faster
_CHUNK = 4096  # normals that are lit together, which bounds the memory
_NEIGHBOURS = 12  # points from which a point's normal is estimated
_IN_FRONT = 0.003  # metres: points so far before the estimates are not explained by them
_TEXT, _QUIET = "#e8ecf1", "#8e98a4"


def scene_picture(scene: Scene, detections: Detections, part: ParametricPart, path: Path) -> None:
    """Write a PNG of two panels; the file appears when it is whole.

    Args:
        scene: what was seen; its truth may be empty. detections: what was found in its first points.
        part: the template of both. path: where to write; the folder must exist.
    """
    found = detected_bodies(part, _SECTIONS, detections)
    figure, _, right, camera, points = two_panels(scene, detections, found)
    image, depth = render_bodies(camera, found, instance_colours(len(detections.score)))
    draw_image(right, image)
    _draw_unexplained(right, camera, points, depth)
    axes = estimated_axes(part, detections)
    draw_axes(right, camera, axes)
    _caption(figure, *caption_texts(scene, detections, found.missing, len(axes)))
    write_png(figure, path)


def two_panels(
    scene: Scene, detections: Detections, found: Bodies
) -> tuple[Figure, Axes, Axes, Camera, Points]:
    """A figure with the clustered cloud on the left.

    Returns:
        the figure, its left and right axes, the camera of both, and the points (N, 3) that were clustered.
    """
    instance = detections.instance.cpu().numpy()
    points = scene.points[: len(instance)].astype(np.float64)
    camera = crop(scene.camera, points, np.asarray(found.mesh.vertices))
    figure = Figure(figsize=(SIZE[0] / 100, SIZE[1] / 100), dpi=100, facecolor=BACKGROUND)
    left, right = (pixel_axes(figure, (x, 64), (PANEL, PANEL)) for x in (8, SIZE[0] - PANEL - 8))
    draw_cloud(left, camera, points, point_colours(instance, len(detections.score)))
    return figure, left, right, camera, points


def crop(camera: Camera, points: Points, vertices: Points) -> Camera:
    """The view cut to a square of PANEL pixels about the points, or the bodies if there are none."""
    content = points if len(points) else vertices
    content = content[content[:, 2] > 0]
    if len(content):
        pixels = camera.project(content)
        low, high = pixels.min(0), pixels.max(0)
    else:
        low, high = np.zeros(2), np.array([camera.width - 1.0, camera.height - 1.0])
    zoom = PANEL / (1.1 * max(float((high - low).max()), 1.0))
    focal = zoom * np.array([camera.fx, camera.fy])
    principal = PANEL / 2 - 0.5 + zoom * (np.array([camera.cx, camera.cy]) - (low + high) / 2)
    (fx, fy), (cx, cy) = focal.tolist(), principal.tolist()
    return replace(camera, width=PANEL, height=PANEL, fx=fx, fy=fy, cx=cx, cy=cy)


def render_bodies(camera: Camera, bodies: Bodies, colours: Points) -> tuple[Points, Points]:
    """Bodies under an even sky, with the shadows that they throw on each other.

    Args:
        camera: the view. bodies: camera frame. colours: (d, 3) in [0, 1], of the bodies' owners.
    Returns:
        Image (h, w, 3) in [0, 1] and planar depth (h, w), metres, inf where no body is; both larger
        than the camera's by the oversampling.
    """
    camera = oversampled(camera)
    rays = pixel_rays(camera)
    image = np.tile(BACKGROUND, (len(rays), 1))
    depth = np.full(len(rays), np.inf)
    body = np.full(len(rays), -1)
    hits = first_hits(bodies, rays)
    depth[hits.ray], body[hits.ray] = hits.depth, hits.body
    if len(hits.ray):
        v, u = np.divmod(hits.ray, camera.width)
        row = hits.body * camera.height + v // _SHADOW_CELL
        cell = row * camera.width + u // _SHADOW_CELL
        light = _sky_light(bodies.mesh, rays[hits.ray] * hits.depth[:, None], hits.normal, cell)
        image[hits.ray] = np.clip(colours[hits.body] * light[:, None], 0, 1)
    shape = (camera.height, camera.width)
    image = image.reshape(*shape, 3)
    image[outlines(body.reshape(shape))] *= 0.35
    return image, depth.reshape(shape)


@dataclass(frozen=True, eq=False)
class Hits:
    """Where rays from the camera first meet bodies.

    Attributes:
        ray: (n,) int64 indices of the rays that meet one. depth: (n,) planar, metres.
        normal: (n, 3) outwards. body: (n,) int64 the bodies' owners.
    """

    ray: NDArray[np.int64]
    depth: Points
    normal: Points
    body: NDArray[np.int64]


def first_hits(bodies: Bodies, rays: Points) -> Hits:
    """The nearest surface along each ray.

    Args:
        bodies: camera frame, metres. rays: (r, 3) from the camera's centre, with z = 1.
    """
    if not len(bodies.mesh.faces):
        none = np.zeros(0, np.int64)
        return Hits(none, np.zeros(0), np.zeros((0, 3)), none)
    face = bodies.mesh.ray.intersects_first(np.zeros_like(rays), rays)
    hit = np.flatnonzero(face >= 0)
    normal = bodies.mesh.face_normals[face[hit]]
    corner = bodies.mesh.triangles[face[hit], 0]
    slope = np.einsum("nj,nj->n", normal, rays[hit])
    depth = np.einsum("nj,nj->n", normal, corner) / np.minimum(slope, -1e-9)
    return Hits(hit, depth, normal, bodies.face_owner[face[hit]])


def unexplained(camera: Camera, points: Points, depth: Points) -> NDArray[np.bool_]:
    """(n,) which points lie beside the rendered bodies or clearly before them.

    Args:
        camera: the view. points: (n, 3) metres. depth: as `render_bodies` gives it.
    """
    z = np.where(points[:, 2] > 0, points[:, 2], np.nan)
    pixels = OVERSAMPLING * (camera.project(np.c_[points[:, :2], z]) + 0.5) - 0.5
    column, row = np.nan_to_num(pixels, nan=-1).round().astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (column < depth.shape[1]) & (row < depth.shape[0])
    behind = np.full(len(points), np.inf)
    behind[inside] = depth[row[inside], column[inside]]
    return points[:, 2] < behind - _IN_FRONT


def _sky_light(mesh: trimesh.Trimesh, place: Points, normal: Points, cell: NDArray[np.int64]) -> Points:
    """Light on each place from a sky behind the camera; about 1 where nothing is in the way.

    Args:
        mesh: what throws shadows. place, normal: (n, 3). cell: (n,) places of a cell share the shadows
            of its first.
    """
    _, first, of = np.unique(cell, return_index=True, return_inverse=True)
    start = place[first] + 1e-4 * mesh.scale * normal[first]
    light = np.full(len(place), 0.18)
    for direction, weight in zip(*_sky(), strict=True):
        facing = np.clip(normal @ direction, 0, None)
        lit = facing[first] > 0
        rays = np.tile(direction, (int(lit.sum()), 1))
        lit[lit] = mesh.ray.intersects_first(start[lit], rays) < 0
        light += weight * facing * lit[of]
    return light


def _sky() -> tuple[Points, Points]:
    """Directions (l, 3) towards a half sky about −z and their weights (l,); brighter above on the left."""
    i = np.arange(_LIGHTS)
    height = 1 - (i + 0.5) / _LIGHTS
    angle, radius = i * np.pi * (3 - np.sqrt(5)), np.sqrt(1 - height**2)
    directions = np.stack([radius * np.cos(angle), radius * np.sin(angle), -height], -1)
    weights = np.exp(2.0 * (directions @ np.array([-0.38, -0.55, -0.74]) - 1))
    return directions, 0.88 * weights / (weights @ height)


def oversampled(camera: Camera) -> Camera:
    """The same view with more pixels."""
    n = OVERSAMPLING
    return replace(
        camera,
        width=n * camera.width,
        height=n * camera.height,
        fx=n * camera.fx,
        fy=n * camera.fy,
        cx=n * (camera.cx + 0.5) - 0.5,
        cy=n * (camera.cy + 0.5) - 0.5,
    )


def pixel_rays(camera: Camera) -> Points:
    """(h w, 3) the pixels' rays, row by row."""
    v, u = np.mgrid[: camera.height, : camera.width]
    return camera.rays(u.ravel(), v.ravel())


def outlines(body: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(h, w) pixels on the border between two bodies or a body and nothing."""
    border = np.zeros(body.shape, bool)
    across, down = body[:, 1:] != body[:, :-1], body[1:] != body[:-1]
    border[:, 1:] |= across
    border[:, :-1] |= across
    border[1:] |= down
    border[:-1] |= down
    return border & (body >= 0)


def draw_cloud(axes: Axes, camera: Camera, points: Points, colours: Points) -> None:
    """Points from far to near, shaded by the slope of the surface about them and by their depth."""
    shaded = np.clip(colours * _cloud_light(points)[:, None], 0, 1)
    order = np.argsort(-points[:, 2])
    _scatter(axes, camera, points[order], shaded[order], 1.45 * _spacing(camera, points))


def _draw_unexplained(axes: Axes, camera: Camera, points: Points, depth: Points) -> None:
    alone = points[unexplained(camera, points, depth)]
    _scatter(axes, camera, alone, np.tile(GREY, (len(alone), 1)), 0.4 * _spacing(camera, points))


def draw_axes(panel: Axes, camera: Camera, axes: Points) -> None:
    """Lines (a, 3, 2, 3) of the estimates that have no solid, the nearest last."""
    before = axes[(axes[..., 2] > 0).all((1, 2))]
    for lines in before[np.argsort(-before[:, 0, 0, 2])]:
        for ends, colour in zip(lines, AXIS_COLOURS, strict=True):
            panel.plot(*camera.project(ends).T, color=colour, linewidth=2.5, solid_capstyle="round")


def _scatter(axes: Axes, camera: Camera, points: Points, colours: Points, diameter: float) -> None:
    """Discs of a diameter in pixels; the first point is painted first."""
    before = points[:, 2] > 0
    u, v = camera.project(points[before]).T
    axes.scatter(u, v, s=(0.72 * diameter) ** 2, c=colours[before], linewidths=0)  # 100 dots an inch


def _spacing(camera: Camera, points: Points) -> float:
    """Median distance in pixels from a point to the nearest other, at least 2."""
    if len(points) < 2:
        return 8.0
    near = cKDTree(points).query(points, 2)[0][:, 1]
    pixels = camera.fx * float(np.median(near / np.maximum(points[:, 2], 1e-6)))
    return float(np.clip(pixels, 2.0, 12.0))


def _cloud_light(points: Points) -> Points:
    """(n,) brightness: towards the light brighter, deeper darker."""
    if not len(points):
        return np.zeros(0)
    neighbours = cKDTree(points).query(points, min(_NEIGHBOURS, len(points)))[1]
    around = points[neighbours.reshape(len(points), -1)]
    around = around - around.mean(1, keepdims=True)
    normal = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][:, :, 0]
    normal *= -np.sign(normal[:, 2:] + 1e-12)  # towards the camera
    return surface_light(normal, points[:, 2])


def surface_light(normal: Points, z: Points) -> Points:
    """(n,) brightness of places on a surface under the open sky: towards the light brighter, deeper darker.

    Args:
        normal: (n, 3) towards the camera. z: (n,) depth, metres; at least one.
    """
    nearness = (np.quantile(z, 0.98) - z) / max(float(np.ptp(z)), 1e-6)
    return (0.16 + open_sky(normal)) * (0.7 + 0.35 * np.clip(nearness, 0, 1))


def open_sky(normal: Points) -> Points:
    """(n,) light of the whole sky on surfaces with normals (n, 3), nothing in the way."""
    directions, weights = _sky()
    chunks = (normal[i : i + _CHUNK] for i in range(0, len(normal), _CHUNK))
    light = [np.clip(chunk @ directions.T, 0, None) @ weights for chunk in chunks]
    return np.concatenate([np.zeros(0), *light])


def pixel_axes(figure: Figure, corner: tuple[int, int], size: tuple[int, int]) -> Axes:
    """Axes whose data coordinates are pixels, (0, 0) the centre of the upper left one.

    Args:
        corner: pixels from the figure's left and upper border. size: width and height, pixels.
    """
    (left, top), (width, height) = corner, size
    whole, high = figure.get_size_inches() * figure.dpi
    box = (left / whole, 1 - (top + height) / high, width / whole, height / high)
    axes = figure.add_axes(box, facecolor=BACKGROUND)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), autoscale_on=False)
    axes.set_axis_off()
    return axes


def draw_image(axes: Axes, image: Points, above: bool = False) -> None:
    """Fill `pixel_axes` with an image (h, w, 3 or 4) in [0, 1] of any resolution; above: over points."""
    extent = (*axes.get_xlim(), *axes.get_ylim())
    axes.imshow(image, extent=extent, interpolation="antialiased", zorder=1.5 if above else 0)


def write_png(figure: Figure, path: Path) -> None:
    """Write a figure; the file appears when it is whole."""
    buffer = BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(buffer, format="png")
    write_atomically(path, buffer.getvalue())


def _caption(figure: Figure, headings: tuple[str, str], foot: str) -> None:
    for x, heading in zip((28, SIZE[0] - PANEL + 12), headings, strict=True):
        figure.text(x / SIZE[0], 1 - 40 / SIZE[1], heading, color=_TEXT, size=15, va="center")
    figure.text(28 / SIZE[0], 26 / SIZE[1], foot, color=_QUIET, size=11.5, va="center")


def caption_texts(
    scene: Scene, detections: Detections, missing: int, sizeless: int = 0
) -> tuple[tuple[str, str], str]:
    """Headings of the two panels, and the line below them.

    Args:
        missing: estimates without a valid solid. sizeless: those of them that are drawn as axes.
    """
    points, count = len(detections.instance), len(detections.score)
    cloud = f"Points, coloured by instance ({points:,})" if points else "This scene has no points"
    poses = f"Estimated poses ({count})" if count else "Nothing was found"
    parts = [scene.part.upper(), str(scene.id)]
    if len(scene.R):
        parts.append(f"{len(scene.R)} bodies in the bin, {count} poses estimated")
    if sizeless:
        parts.append("sizes are not estimated: axes stand for the bodies")
    if missing > sizeless:
        parts.append(f"{missing - sizeless} without a valid solid, not drawn")
    if points and count:
        parts.append("small grey: points beside or before the estimates")
    return (cloud, poses), "   ·   ".join(parts)
