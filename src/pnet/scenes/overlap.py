"""How deep bodies reach into each other, by separating axes; no physics engine needed.

Two convex polyhedra are apart if and only if one of their face normals, or the cross product of an edge of
each, separates them (Gottschalk et al. 1996); where none does, the smallest overlap along them is the
penetration depth.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import ConvexHull

from pnet.scenes.pile import Points

PARALLEL = 1e-6  # sine below which two edges give no axis


@dataclass(frozen=True, eq=False)
class ConvexPiece:
    """A convex polyhedron. corners: (n, 3) part frame, metres."""

    corners: Points

    @cached_property
    def normals(self) -> Points:
        """(f, 3) distinct outward unit normals of its faces."""
        return _distinct(self._hull.equations[:, :3])

    @cached_property
    def edges(self) -> Points:
        """(e, 3) distinct unit directions of the edges between faces that are not coplanar."""
        hull, found = self._hull, []
        for face, (simplex, neighbours) in enumerate(zip(hull.simplices, hull.neighbors, strict=True)):
            for k, other in enumerate(neighbours):
                if np.abs(hull.equations[face] - hull.equations[other])[:3].max() > 1e-9:
                    a, b = np.delete(simplex, k)
                    found.append(hull.points[a] - hull.points[b])
        edges = np.array(found) / np.linalg.norm(found, axis=1, keepdims=True)
        return _distinct(edges * np.where(edges @ [1.0, np.e, np.pi] < 0, -1, 1)[:, None])

    @cached_property
    def _hull(self) -> ConvexHull:
        return ConvexHull(self.corners)


def penetration(
    pieces: Sequence[ConvexPiece], R: Points, t: Points, others: Sequence[tuple[Points, Points]]
) -> float:
    """How deep a body reaches into others of its kind.

    Args:
        pieces: convex pieces whose union is the body. R (3, 3), t (3,): its pose. others: poses of the rest.
    Returns:
        The largest penetration depth of any two pieces, metres; not positive where all are apart, and then no
        distance but a bound of one.
    """
    deepest = -np.inf
    for R_other, t_other in others:
        turn, shift = R.T @ R_other, R.T @ (t_other - t)  # the other body in this one's frame
        for a in pieces:
            for b in pieces:
                deepest = max(deepest, _depth(a, b, turn, shift))
    return deepest


def _depth(a: ConvexPiece, b: ConvexPiece, R: Points, t: Points) -> float:
    """Smallest overlap of a and b (posed R, t in a's frame) along all candidate axes."""
    placed = b.corners @ R.T + t
    depth = _smallest_overlap(a.corners, placed, np.concatenate([a.normals, -b.normals @ R.T]))
    if depth <= 0:
        return depth
    cross = np.cross(a.edges[:, None], (b.edges @ R.T)[None]).reshape(-1, 3)
    sine = np.linalg.norm(cross, axis=1, keepdims=True)
    cross = (cross / np.maximum(sine, PARALLEL))[sine[:, 0] > PARALLEL]
    return min(depth, _smallest_overlap(a.corners, placed, np.concatenate([cross, -cross])))


def _smallest_overlap(a: Points, b: Points, axes: Points) -> float:
    """Along axes (n, 3) that point from a to b."""
    if not len(axes):
        return np.inf
    return float(((a @ axes.T).max(0) - (b @ axes.T).min(0)).min())


def _distinct(directions: Points) -> Points:
    _, first = np.unique(directions.round(7) + 0.0, axis=0, return_index=True)
    return directions[np.sort(first)]
