"""Solids out of shapes with union and difference, and the commonest shapes by their sizes.

Lengths are metres; circles are polygons of `sections` sides with their vertices on the circle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
import trimesh
from numpy.typing import NDArray

from pnet.parts.clipping import convex_difference
from pnet.parts.shapes import FRAMES, Extrusion, Revolution, Shape, manifold

Points = NDArray[np.float64]
Extent = tuple[Points | float, Points | float]


class Operation(StrEnum):
    """What a step of a construction does."""

    ADD = "add"
    CUT = "cut"
    HOLE = "hole"  # a cut too narrow for another part to enter: physics may leave it out


@dataclass(frozen=True, eq=False)
class Solid:
    """Shapes added and cut one after another.

    Attributes:
        steps: (operation, shape), the first an ADD.
    """

    steps: tuple[tuple[Operation, Shape], ...]

    def __or__(self, other: Shape | Solid) -> Solid:
        added = solid(other)
        if any(operation is not Operation.ADD for operation, _ in added.steps):
            raise ValueError("unite plain shapes first, then cut: (a | b) - c")
        return Solid(self.steps + added.steps)

    def __sub__(self, other: Shape | Solid) -> Solid:
        return Solid(self.steps + tuple((self._cutting(operation), s) for operation, s in solid(other).steps))

    @staticmethod
    def _cutting(operation: Operation) -> Operation:
        if operation is Operation.CUT:
            raise ValueError("cut with plain shapes: a - b - c, not a - (b - c)")
        return Operation.HOLE if operation is Operation.HOLE else Operation.CUT

    def signed_volume_and_moment(self, sections: int) -> tuple[Points, Points]:
        """Σ ± volume (...) and Σ ± moment (..., 3): the solid's own where added shapes don't overlap each
        other and cut ones lie inside them without overlapping."""
        volume, moment = np.zeros(()), np.zeros(3)
        for operation, shape in self.steps:
            sign = 1.0 if operation is Operation.ADD else -1.0
            v, m = shape.volume_and_moment(sections)
            volume, moment = volume + sign * v, moment + sign * m
        return volume, moment

    def mesh(self, sections: int) -> trimesh.Trimesh:
        """Watertight mesh of one size, faces wound outwards; without faces where nothing is left."""
        (_, first), *others = self.steps
        if not others:
            return first.mesh(sections)
        whole = manifold(first.mesh(sections))
        for operation, shape in others:
            part = manifold(shape.mesh(sections))
            whole = whole + part if operation is Operation.ADD else whole - part
        found = whole.to_mesh64()
        # copies: views would keep the library's object alive past its end
        vertices, faces = np.array(found.vert_properties[:, :3]), np.array(found.tri_verts, np.int64)
        return trimesh.Trimesh(vertices, faces, process=False)

    def pieces(self, sections: int, fill_holes: bool) -> list[Points]:
        """Convex pieces whose union is the solid, (n_i, 3) each; they may overlap.

        Args:
            sections: as in the mesh. fill_holes: leave the steps marked as holes out.
        """
        pieces: list[Points] = []
        for operation, shape in self.steps:
            if operation is Operation.ADD:
                pieces += shape.pieces(sections)
            elif operation is Operation.CUT or not fill_holes:
                for cutter in shape.pieces(shape.cutter_sections(sections)):
                    pieces = [rest for piece in pieces for rest in convex_difference(piece, cutter)]
        return pieces


def solid(body: Shape | Solid) -> Solid:
    """A shape as a solid of one step."""
    return body if isinstance(body, Solid) else Solid(((Operation.ADD, body),))


def hole(shape: Shape) -> Solid:
    """Marks a cut as a hole: `body - hole(cylinder(…))`."""
    return Solid(((Operation.HOLE, shape),))


def cylinder(radius: Points | float, low: Points | float, high: Points | float) -> Revolution:
    """A round bar along z from low to high; `moved(…, axis, at)` puts it elsewhere."""
    return cone(radius, radius, low, high)


def cone(
    low_radius: Points | float, high_radius: Points | float, low: Points | float, high: Points | float
) -> Revolution:
    """A cone or frustum along z; one of the radii may be 0."""
    return Revolution(outline([(0, low), (low_radius, low), (high_radius, high), (0, high)]))


def prism(outline: Points, low: Points | float, high: Points | float) -> Extrusion:
    """A polygon (..., n, 2) extruded along z."""
    return Extrusion(outline, low, high)


def box(x: Extent, y: Extent, z: Extent) -> Extrusion:
    """A cuboid by its extents (from, to), metres."""
    return Extrusion(outline([(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])]), *z)


def outline(corners: Sequence[tuple[Points | float, Points | float]]) -> Points:
    """Corners whose coordinates are numbers or (...) arrays as one array (..., n, 2)."""
    values = np.broadcast_arrays(*(np.asarray(x, float) for corner in corners for x in corner))
    return np.stack(values, -1).reshape(*values[0].shape, len(corners), 2)


def moved(shape: Shape, axis: str = "z", at: tuple[Points | float, ...] = (0.0, 0.0, 0.0)) -> Shape:
    """The shape with its own z along another axis and its origin at `at`."""
    if axis not in FRAMES:
        raise ValueError(f"axis {axis!r}: choose x, y or z")
    return replace(shape, axis=axis, at=at)  # type: ignore[type-var]
