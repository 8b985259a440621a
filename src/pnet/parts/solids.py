"""Watertight solids and convex pieces that several templates share."""

import numpy as np
import trimesh
from numpy.typing import NDArray

Points = NDArray[np.float64]


def circle(radius: float, sections: int) -> Points:
    """(sections, 2) vertices of a regular polygon on a circle, counter-clockwise, the first on +x."""
    angle = np.arange(sections) * (2 * np.pi / sections)
    return radius * np.stack([np.cos(angle), np.sin(angle)], -1)


def prism(outline: Points, bottom: float, top: float) -> trimesh.Trimesh:
    """Convex prism over a convex outline.

    Args:
        outline: (n, 2) metres. bottom, top: z of the end faces, metres.
    Returns:
        A watertight mesh, faces wound outwards.
    """
    return trimesh.Trimesh(*_hull(extrude_points(outline, bottom, top)))


def extrude_points(outline: Points, bottom: float, top: float) -> Points:
    """(2n, 3) the outline at both heights."""
    return np.concatenate([np.c_[outline, np.full(len(outline), z)] for z in (bottom, top)])


def lathe(profile: Points, sections: int) -> trimesh.Trimesh:
    """Solid of revolution about z of a closed profile that stays off the axis.

    Args:
        profile: (n, 2) radius and z, metres, radius > 0, counter-clockwise in the (radius, z) plane.
        sections: polygon sides about the axis.
    Returns:
        A watertight ring-shaped mesh, faces wound outwards.
    """
    ring = circle(1.0, sections)
    n = len(profile)
    vertices = np.concatenate([np.c_[profile[:, :1] * direction, profile[:, 1:]] for direction in ring])
    s, p = np.divmod(np.arange(sections * n), n)
    here, up = s * n + p, s * n + (p + 1) % n
    beside, across = (here + n) % (sections * n), (up + n) % (sections * n)
    faces = np.concatenate([np.c_[here, beside, across], np.c_[here, across, up]])
    return trimesh.Trimesh(vertices, faces, process=False)


def ring_sectors(inner: Points, outer: Points, bottom: float, top: float) -> list[Points]:
    """Convex sectors of a straight ring between two polygons of equally many vertices.

    Args:
        inner, outer: (n, 2) metres, vertices at the same angles. bottom, top: metres.
    Returns:
        n arrays (8, 3): each the corners of one sector.
    """
    following = np.roll(np.arange(len(inner)), -1)
    return [
        extrude_points(np.stack([inner[i], outer[i], outer[j], inner[j]]), bottom, top)
        for i, j in enumerate(following)
    ]


def _hull(points: Points) -> tuple[Points, NDArray[np.int64]]:
    hull = trimesh.convex.convex_hull(points)
    return np.asarray(hull.vertices), np.asarray(hull.faces)
