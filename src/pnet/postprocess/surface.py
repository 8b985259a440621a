"""A part's surface, onto which clouds are registered: its triangles, and samples of it."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from pnet.parts.base import ParametricPart, Points

SLIVER = 1e-12  # square metres; what has no area has no normal
MOST_TRIANGLES = 2000  # of a finer mesh patches about the samples stand for the surface
GRAZING = math.sin(math.radians(10))  # faces turned away by less may be seen, as the pose is not exact yet


@dataclass(frozen=True, eq=False)
class Triangles:
    """Attributes:
    corners: (f, 3, 3) part frame, metres; three times the same place is that place alone.
    normals: (f, 3) outward unit vectors.
    """

    corners: Points
    normals: Points


@dataclass(frozen=True, eq=False)
class Surface:
    """Samples of a surface.

    Attributes:
        points: (n, 3) part frame, metres. normals: (n, 3) outward unit vectors.
        exact: what they are samples of, or patches that cover it; None: nobody knows.
    """

    points: Points
    normals: Points
    exact: Triangles | None = None

    @property
    def triangles(self) -> Triangles:
        """The surface itself; where nobody knows it its samples, each a place alone."""
        return self.exact or Triangles(np.repeat(self.points[:, None], 3, 1), self.normals)

    def facing(self, R: Points, t: Points) -> "Surface":
        """Those that the pose R (3, 3), t (3,) part → camera turns to the camera."""
        ray = self.points + t @ R  # from the camera, in the part frame
        turned = (ray * self.normals).sum(1) < GRAZING * np.linalg.norm(ray, axis=1)
        return Surface(self.points[turned], self.normals[turned])


@lru_cache(maxsize=1024)  # a scene's instances, or a data set's, share their sizes
def sample_surface(part: ParametricPart, parameters: tuple[float, ...], count: int) -> Surface | None:
    """So many samples, the same every time, of a part of these parameters (k), metres.

    Returns:
        None where no such part is possible, as estimates may have it.
    """
    try:
        part.check_named(np.array(parameters))
        mesh = part.mesh(np.array(parameters))
    except ValueError:
        return None
    points, face = mesh.sample(count, return_index=True, seed=0)
    corners, normals = np.asarray(mesh.triangles, np.float64), np.asarray(mesh.face_normals, np.float64)
    wide = mesh.area_faces > SLIVER
    points = np.asarray(points, np.float64)
    if wide.sum() <= MOST_TRIANGLES:
        return Surface(points, normals[face], Triangles(corners[wide], normals[wide]))
    return Surface(points, normals[face], _patches(points, normals[face], math.sqrt(mesh.area / count)))


def _patches(points: Points, normals: Points, radius: float) -> Triangles:
    """A triangle about each sample in its tangent plane, wound outwards, with corners so far off, metres:
    together they cover the surface nearly as its own would."""
    least = np.eye(3)[np.abs(normals).argmin(1)]
    first = np.cross(normals, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normals, first)
    angles = 2 * np.pi / 3 * np.arange(3)
    around = np.cos(angles)[:, None] * first[:, None] + np.sin(angles)[:, None] * second[:, None]
    return Triangles(points[:, None] + radius * around, normals)
