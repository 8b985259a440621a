"""Closed bodies that solids are made of: extrusions, revolutions and spheres.

Every shape tells its polyhedron's volume and first moment in closed form for many sizes at once, and for one
size its mesh and convex pieces. Lengths are metres; circles are polygons of `sections` sides with their
vertices on the circle.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import manifold3d
import numpy as np
import trimesh
from numpy.typing import NDArray

if TYPE_CHECKING:
    from pnet.parts.solids import Solid

Points = NDArray[np.float64]
PICOMETRES = 12  # decimals: 0.4 h and h - 0.6 h must touch, whatever their last bits
# where a shape's own z goes: columns are the images of its x, y and z
FRAMES = {
    "x": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    "y": np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
    "z": np.eye(3),
}


class Shape(ABC):
    """A closed body with a place; `a | b` unites, `a - b` cuts."""

    axis: str
    at: tuple[Points | float, ...]

    @abstractmethod
    def own_volume_and_moment(self, sections: int) -> tuple[Points, Points]:
        """Volume (...) and first moment (..., 3) in the shape's own frame."""

    @abstractmethod
    def own_mesh(self, sections: int) -> trimesh.Trimesh:
        """Watertight mesh of one size in the shape's own frame."""

    @abstractmethod
    def own_pieces(self, sections: int) -> list[Points]:
        """Corners of convex pieces of one size, (n_i, 3) each, in the shape's own frame."""

    def __or__(self, other: Shape | Solid) -> Solid:
        from pnet.parts.solids import solid  # here, as solids are made of shapes

        return solid(self) | other

    def __sub__(self, other: Shape | Solid) -> Solid:
        from pnet.parts.solids import solid  # here, as solids are made of shapes

        return solid(self) - other

    def cutter_sections(self, sections: int) -> int:
        """Polygon sides of a circle where the shape is cut out of convex pieces."""
        return sections

    def volume_and_moment(self, sections: int) -> tuple[Points, Points]:
        """Volume (...), m³, and first moment (..., 3), m⁴, about the origin of construction."""
        volume, moment = self.own_volume_and_moment(sections)
        place = np.stack(np.broadcast_arrays(*map(np.asarray, self.at)), -1)
        return volume, moment @ FRAMES[self.axis].T + volume[..., None] * place

    def is_valid(self, sections: int) -> NDArray[np.bool_]:
        """(...) whether the sizes make a body with an inside."""
        return self.own_volume_and_moment(sections)[0] > 0

    def mesh(self, sections: int) -> trimesh.Trimesh:
        """Watertight mesh of one size where it is placed."""
        mesh = self.own_mesh(sections).apply_transform(self._matrix())
        mesh.vertices = np.round(mesh.vertices, PICOMETRES)
        return mesh

    def pieces(self, sections: int) -> list[Points]:
        """Convex pieces of one size where they are placed."""
        matrix = self._matrix()
        return [points @ matrix[:3, :3].T + matrix[:3, 3] for points in self.own_pieces(sections)]

    def _matrix(self) -> Points:
        matrix = np.eye(4)
        matrix[:3, :3] = FRAMES[self.axis]
        matrix[:3, 3] = [float(x) for x in self.at]
        return matrix


@dataclass(frozen=True, eq=False)
class Extrusion(Shape):
    """A simple polygon drawn along the axis.

    Attributes:
        outline: (..., n, 2) counter-clockwise, metres. low, high: along the axis.
        axis: "x", "y" or "z"; the outline's two coordinates are the next two in turn. at: shift.
    """

    outline: Points
    low: Points | float
    high: Points | float
    axis: str = "z"
    at: tuple[Points | float, ...] = (0.0, 0.0, 0.0)

    def own_volume_and_moment(self, sections: int) -> tuple[Points, Points]:
        """Shoelace formulas times the height."""
        a, b = self.outline, np.roll(self.outline, -1, -2)
        cross = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
        area, first = cross.sum(-1) / 2, (cross[..., None] * (a + b)).sum(-2) / 6
        low, high = np.asarray(self.low, float), np.asarray(self.high, float)
        height = high - low
        flat = first * height[..., None]
        upright = area * (high**2 - low**2) / 2
        flat, upright = np.broadcast_arrays(flat, upright[..., None])
        return area * height, np.concatenate([flat, upright[..., :1]], -1)

    def own_mesh(self, sections: int) -> trimesh.Trimesh:
        """Outline triangulated, extruded."""
        faces = np.asarray(manifold3d.triangulate([self.outline]))
        low, height = float(self.low), float(self.high) - float(self.low)
        mesh = trimesh.creation.extrude_triangulation(self.outline, faces, height)
        return mesh.apply_translation([0, 0, low])

    def own_pieces(self, sections: int) -> list[Points]:
        """One prism over a convex outline, else one over each triangle."""
        if _is_convex(self.outline):
            return [extrude_points(self.outline, float(self.low), float(self.high))]
        triangles = np.asarray(manifold3d.triangulate([self.outline]))
        return [extrude_points(self.outline[t], float(self.low), float(self.high)) for t in triangles]


@dataclass(frozen=True, eq=False)
class Revolution(Shape):
    """A profile turned about the axis.

    Attributes:
        profile: (..., n, 2) radius >= 0 and height along the axis, metres, counter-clockwise in that plane; a
            profile may touch the axis. axis, at: as in `Extrusion`.
    """

    profile: Points
    axis: str = "z"
    at: tuple[Points | float, ...] = (0.0, 0.0, 0.0)

    def own_volume_and_moment(self, sections: int) -> tuple[Points, Points]:
        """∮ κ r² dz and ∮ κ r² z dz, κ r² the polygon's area; exact for straight edges."""
        kappa = sections / 2 * np.sin(2 * np.pi / sections)
        (r, z), (s, w) = np.moveaxis(self.profile, -1, 0), np.moveaxis(np.roll(self.profile, -1, -2), -1, 0)
        rise = w - z
        volume = kappa * (rise * (r * r + r * s + s * s) / 3).sum(-1)
        weighted = z * (3 * r * r + 2 * r * s + s * s) + w * (r * r + 2 * r * s + 3 * s * s)
        upright = kappa * (rise * weighted / 12).sum(-1)
        return volume, np.stack([np.zeros_like(volume), np.zeros_like(volume), upright], -1)

    def is_valid(self, sections: int) -> NDArray[np.bool_]:
        """Radii must not be negative: their squares would hide it."""
        return super().is_valid(sections) & (self.profile[..., 0] >= 0).all(-1)

    def own_mesh(self, sections: int) -> trimesh.Trimesh:
        """The lathe's mesh."""
        return lathe(self.profile, sections)

    def own_pieces(self, sections: int) -> list[Points]:
        """Of every slab between two corner heights the frusta, or the sectors of a ring."""
        pieces: list[Points] = []
        for low, high, inner, outer in _slabs(np.round(self.profile, PICOMETRES)):
            pieces += _ring_pieces(low, high, inner, outer, sections)
        return pieces


@dataclass(frozen=True, eq=False)
class Ball(Shape):
    """A sphere; a polyhedron of circles of latitude.

    Attributes:
        radius: metres. axis: where its poles lie. at: its centre.
    """

    radius: Points | float
    axis: str = "z"
    at: tuple[Points | float, ...] = (0.0, 0.0, 0.0)

    def own_volume_and_moment(self, sections: int) -> tuple[Points, Points]:
        """Those of the turned half circle."""
        return self._revolution(sections).own_volume_and_moment(sections)

    def own_mesh(self, sections: int) -> trimesh.Trimesh:
        """The turned half circle."""
        return self._revolution(sections).own_mesh(sections)

    def cutter_sections(self, sections: int) -> int:
        """A ball's facets grow with the square, and every one makes a piece: a few must do."""
        return min(sections, 12)

    def own_pieces(self, sections: int) -> list[Points]:
        """One piece: it is convex."""
        return [np.asarray(self.own_mesh(sections).vertices)]

    def _revolution(self, sections: int) -> Revolution:
        angle = np.linspace(-np.pi / 2, np.pi / 2, sections // 2 + 1)
        half = np.stack([np.cos(angle), np.sin(angle)], -1)
        half[[0, -1], 0] = 0.0
        return Revolution(np.asarray(self.radius, float)[..., None, None] * half)


def polygon(sides: int, circumradius: Points | float) -> Points:
    """(..., sides, 2) vertices of a regular polygon, counter-clockwise, the first on +x."""
    angle = np.arange(sides) * (2 * np.pi / sides)
    return np.asarray(circumradius, float)[..., None, None] * np.stack([np.cos(angle), np.sin(angle)], -1)


def extrude_points(outline: Points, low: float, high: float) -> Points:
    """(2n, 3) the outline at both heights."""
    return np.concatenate([np.c_[outline, np.full(len(outline), z)] for z in (low, high)])


def lathe(profile: Points, sections: int) -> trimesh.Trimesh:
    """Mesh of a closed profile turned about z.

    Args:
        profile: (n, 2) radius and z, metres, radius >= 0, counter-clockwise in the (radius, z) plane.
        sections: polygon sides about the axis.
    Returns:
        A watertight mesh, faces wound outwards.
    """
    ring, n = polygon(sections, 1.0), len(profile)
    vertices = np.concatenate([np.c_[profile[:, :1] * direction, profile[:, 1:]] for direction in ring])
    s, p = np.divmod(np.arange(sections * n), n)
    here, up = s * n + p, s * n + (p + 1) % n
    beside, across = (here + n) % (sections * n), (up + n) % (sections * n)
    faces = np.concatenate([np.c_[here, beside, across], np.c_[here, across, up]])
    # corners on the axis come once a section: let one stand for all, and drop what has no area
    on_axis = np.tile(profile[:, 0] == 0, sections)
    own = np.where(on_axis, np.tile(np.arange(n), sections), np.arange(sections * n))
    faces = own[faces]
    a, b, c = faces.T
    mesh = trimesh.Trimesh(vertices, faces[(a != b) & (b != c) & (c != a)], process=False)
    mesh.remove_unreferenced_vertices()
    return mesh


def manifold(mesh: trimesh.Trimesh) -> manifold3d.Manifold:
    """A watertight mesh for Boolean operations in double precision."""
    vertices, faces = np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.uint64)
    return manifold3d.Manifold(manifold3d.Mesh64(vertices, faces))


def _is_convex(outline: Points) -> bool:
    edge = np.roll(outline, -1, 0) - outline
    following = np.roll(edge, -1, 0)
    return bool((edge[:, 0] * following[:, 1] - edge[:, 1] * following[:, 0] >= -1e-15).all())


def _slabs(profile: Points) -> list[tuple[float, float, tuple[float, float], tuple[float, float]]]:
    """Trapezoids of a profile between its corner heights: low, high, inner and outer radius at both."""
    edges = [(a, b) for a, b in zip(profile, np.roll(profile, -1, 0), strict=True) if a[1] != b[1]]
    heights = np.unique(profile[:, 1])
    slabs = []
    for low, high in pairwise(heights.tolist()):
        across = []
        for a, b in edges:
            bottom, top = sorted((a[1], b[1]))
            if bottom <= low and top >= high:
                share = (np.array([low, high]) - a[1]) / (b[1] - a[1])
                across.append(a[0] + share * (b[0] - a[0]))
        across.sort(key=lambda radii: float(radii.sum()))
        for inner, outer in zip(across[::2], across[1::2], strict=True):
            slabs.append((float(low), float(high), tuple(inner.tolist()), tuple(outer.tolist())))
    return slabs


def _ring_pieces(
    low: float, high: float, inner: tuple[float, float], outer: tuple[float, float], sections: int
) -> list[Points]:
    ring = polygon(sections, 1.0)

    def circle(radius: float, z: float) -> Points:
        return np.c_[radius * ring, np.full(sections, z)]

    corners = [circle(r, z) for radii in (inner, outer) for r, z in zip(radii, (low, high), strict=True)]
    if max(inner) == 0:
        return [np.unique(np.concatenate(corners[2:]), axis=0)]
    stacked = np.stack(corners, 1)
    return [
        np.unique(np.concatenate([stacked[i], stacked[(i + 1) % sections]]), axis=0) for i in range(sections)
    ]
