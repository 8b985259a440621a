"""Part objects at the poses that the Parametric data set tells: their silhouettes, and whether they fit."""

from functools import lru_cache

import numpy as np
import trimesh
from numpy.typing import NDArray

from pnet.data.public.checks import distances_from_poses
from pnet.geometry.camera import Camera
from pnet.parts.base import ParametricPart
from pnet.records import Scene
from pnet.scenes.rendering import render_view

Points = NDArray[np.float64]

_MOST_PIXELS = 4_000_000  # of the rectangle about a body
_FARTHEST_PIXEL = 1e6


def part_mesh(part: ParametricPart, parameters: Points, where: str) -> trimesh.Trimesh:
    """The mesh of a part object, (k,) metres; made once. ValueError where there is none names `where`."""
    try:
        return _mesh(part, tuple(parameters.tolist()))
    except ValueError as fault:
        raise ValueError(f"{where}: {fault}") from fault


@lru_cache(maxsize=256)
def _mesh(part: ParametricPart, parameters: tuple[float, ...]) -> trimesh.Trimesh:
    return part.mesh(np.array(parameters))


def silhouettes(camera: Camera, mesh: trimesh.Trimesh, R: Points, t: Points, where: str) -> NDArray[np.int64]:
    """Pixels of each body alone, not clipped by the image.

    Args:
        camera: the view. mesh: part frame, metres. R: (d, 3, 3), t: (d, 3) part → camera, metres.
        where: the file of the poses, for the error.
    Returns:
        (d,) pixels.
    Raises:
        ValueError: a body reaches before the camera's near plane, or is too large or too far off to be seen.
    """
    corners = np.einsum("dij,nj->dni", R, mesh.vertices) + t[:, None]
    nearest = corners[..., 2].min(1)
    if not (nearest > camera.near).all():
        raise ValueError(
            f"{where}: body {nearest.argmin()} reaches to z = {nearest.min():.4g} m, nearer than the camera "
            f"sees ({camera.near:.4g} m); expected poses in the camera frame, metres"
        )
    pixels = camera.project(corners)
    size = np.prod(np.ptp(pixels, axis=1) + 1, axis=-1)
    if not (np.abs(pixels).max() <= _FARTHEST_PIXEL and size.max() <= _MOST_PIXELS):
        raise ValueError(
            f"{where}: body {size.argmax()} covers {size.max():.3g} pixels, or one is {_FARTHEST_PIXEL:g} "
            "pixels off the image; expected a camera and poses in metres, parameters in mm"
        )
    return render_view(camera, mesh, R, t).silhouette


def check_bodies_fit(scene: Scene, mesh: trimesh.Trimesh, where: str) -> None:
    """Raise ValueError where points lie behind the camera or far from the body that they are said to be on.

    The data's documents don't say in which frame poses are; with any other one, this is where it shows.

    Args:
        scene: with every body's points. mesh: of its part object. where: the file, for the error.
    """
    if not (np.isfinite(scene.points).all() and (scene.points[:, 2] > 0).all()):
        raise ValueError(f"{where}: points lie behind the camera, or are infinite; expected metres, z > 0")
    radius = float(np.linalg.norm(mesh.vertices, axis=1).max())
    distance, seen = distances_from_poses(scene)
    if len(distance) and not distance.max() <= 2 * radius:
        worst = int(distance.argmax())
        raise ValueError(
            f"{where}: points of body {seen[worst]} are {1000 * distance[worst]:.4g} mm from its pose on "
            f"average, its radius is {1000 * radius:.4g} mm; expected poses in the camera frame, metres, and "
            "the data set's object frame in data.source.frame"
        )
