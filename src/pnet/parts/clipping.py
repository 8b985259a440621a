"""Difference of convex polyhedra as convex pieces."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

Points = NDArray[np.float64]
SLIVER = 1e-9  # pieces below this share of the whole's volume are left out


def convex_difference(body: Points, cutter: Points) -> list[Points]:
    """Convex pieces that make up a convex body less a convex cutter.

    Facet by facet of the cutter, what lies beyond the facet is a piece and what lies before it goes on.

    Args:
        body: (n, 3), cutter: (m, 3) corners, metres.
    Returns:
        Arrays (n_i, 3) of corners, disjoint but for their borders; the body itself where they don't overlap;
        nothing where the cutter holds it all.
    """
    try:
        smallest = SLIVER * ConvexHull(body).volume
    except QhullError:  # the body has no volume
        return []
    pieces, rest = [], body
    for normal, offset in _facets(cutter):
        beyond, rest = _split(rest, normal, offset, smallest)
        if len(rest) == 0:
            return [body]
        if len(beyond):
            pieces.append(beyond)
    return pieces


def _facets(points: Points) -> list[tuple[Points, float]]:
    """Outward unit normals n and offsets d of a hull's facets: n·x <= d inside."""
    equations = ConvexHull(points).equations
    scale = np.abs(points).max()
    _, first = np.unique(np.round(equations / [1, 1, 1, scale], 7), axis=0, return_index=True)
    return [(equation[:3], -float(equation[3])) for equation in equations[np.sort(first)]]


def _split(points: Points, normal: Points, offset: float, smallest: float) -> tuple[Points, Points]:
    """Corners beyond a plane and before it; a side without volume is empty."""
    height = points @ normal - offset
    tolerance = 1e-12 + 1e-10 * np.abs(points).max()
    if (height <= tolerance).all():
        return points[:0], points
    if (height >= -tolerance).all():
        return points, points[:0]
    simplices = ConvexHull(points).simplices
    edges = np.unique(
        np.sort(np.concatenate([simplices[:, [0, 1]], simplices[:, [1, 2]], simplices[:, [0, 2]]])), axis=0
    )
    a, b = edges[(height[edges[:, 0]] > 0) != (height[edges[:, 1]] > 0)].T
    share = (height[a] / (height[a] - height[b]))[:, None]
    crossing = points[a] + share * (points[b] - points[a])
    sides = [np.concatenate([points[chosen], crossing]) for chosen in (height >= 0, height <= 0)]
    beyond, before = (_corners(side, smallest) for side in sides)
    return beyond, before


def _corners(points: Points, smallest: float) -> Points:
    """The hull's corners, or none where it has no volume."""
    try:
        hull = ConvexHull(points)
    except QhullError:
        return points[:0]
    return points[hull.vertices] if hull.volume > smallest else points[:0]
