"""Primitives and where the second keypoint lies on each (Fig. 2 of the paper).

A distance-type parameter is the distance from a reference keypoint to a primitive. Out-Prim: the reference
lies off the primitive, the second keypoint is the foot of the perpendicular (plane, sphere, cylinder, cone).
In-Prim: the reference lies in it, the second keypoint follows from the primitive's shape (circle, polygon).

A primitive tells the direction from the reference to the template's own keypoint, and its freedom: which
other points are as good by the primitive itself. The equivalents R(kp) of Fig. 4 are those, carried through
the part's symmetry (`pnet.parts.equivalents`).
"""

import math
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from typing import Protocol

import torch
from torch import Tensor

from pnet.parts.expressions import Expression

Direction = str | tuple[float, float, float]  # "x", "-z", …, or a vector
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_NEXT = {"x": "y", "y": "z", "z": "x"}  # where a turn's template keypoint lies if nothing is said


class Freedom(Enum):
    """Which points of a primitive are as near to the reference as the foot itself."""

    NONE = "none"  # Fig. 4(c, d): one point; its equivalents are the part's symmetry's
    TURN = "turn"  # Fig. 4(b): a circle about an axis
    SPHERE = "sphere"  # Fig. 4(a): every direction


class Primitive(Protocol):
    """What a keypoint rule needs to know of a primitive."""

    @property
    def direction(self) -> Tensor:
        """(3,) float64 unit vector from the reference to the template's keypoint, part frame."""
        ...

    @property
    def freedom(self) -> Freedom:
        """Which points of the primitive are as good."""
        ...

    @property
    def axis(self) -> Tensor:
        """(3,) float64 unit vector: what a TURN turns about."""
        ...


@dataclass(frozen=True)
class Plane:
    """Kp-in-plane: the foot of the perpendicular.

    Attributes:
        normal: from the reference to the plane. at: where the plane lies along its normal, from the
            origin of the solid's construction, an expression in mm; needed only for a keypoint that
            measures no parameter.
    """

    normal: Direction
    at: Expression | None = None

    @property
    def direction(self) -> Tensor:
        """The normal."""
        return unit(self.normal)

    @property
    def freedom(self) -> Freedom:
        """One foot."""
        return Freedom.NONE

    @property
    def axis(self) -> Tensor:
        """The normal."""
        return self.direction


@dataclass(frozen=True)
class Sphere:
    """Kp-in-sphere: the reference is the centre, every surface point is a foot."""

    @property
    def direction(self) -> Tensor:
        """The template's own: z."""
        return unit("z")

    @property
    def freedom(self) -> Freedom:
        """Every direction."""
        return Freedom.SPHERE

    @property
    def axis(self) -> Tensor:
        """None in particular: z."""
        return self.direction


class _Around:
    """What lies about an axis: the directions of a cylinder and of a polygon."""

    around: Direction
    towards: Direction | None

    @property
    def direction(self) -> Tensor:
        """From the axis to the template's keypoint."""
        return _towards(_plain(self.around), None if self.towards is None else _plain(self.towards))

    @property
    def axis(self) -> Tensor:
        """The cylinder's axis; the normal of the polygon's plane."""
        return unit(self.around)


@dataclass(frozen=True)
class Cylinder(_Around):
    """Kp-in-cylinder: the reference lies on the axis, every point at its height is a foot.

    Attributes:
        around: the axis. towards: the template's own foot, perpendicular to the axis; None: the next of x, y,
            z.
    """

    around: Direction = "z"
    towards: Direction | None = None

    @property
    def freedom(self) -> Freedom:
        """A circle."""
        return Freedom.TURN


@dataclass(frozen=True)
class Circle(Cylinder):
    """In-Prim: the reference is a circle's centre, in its plane (the rim of an end face, of a cone's
    base)."""


@dataclass(frozen=True)
class Polygon(_Around):
    """In-Prim: the reference is the centre of a regular polygon, the keypoint a vertex.

    Attributes:
        sides: number of vertices. around: normal of its plane. towards: its first vertex.
    """

    sides: int
    around: Direction = "z"
    towards: Direction | None = None

    def __post_init__(self) -> None:
        if self.sides < 3:
            raise ValueError(f"a polygon of {self.sides} sides: expected at least 3")

    @property
    def freedom(self) -> Freedom:
        """One vertex; the others are its equivalents if the part's symmetry says so."""
        return Freedom.NONE


@dataclass(frozen=True)
class Corner:
    """A point of the solid at a known place; it measures nothing and serves as a reference.

    Attributes:
        at: x, y, z from the origin of the solid's construction, expressions in mm.
    """

    at: tuple[Expression, Expression, Expression]

    @property
    def direction(self) -> Tensor:
        """Unused: the place says it."""
        return torch.zeros(3, dtype=torch.float64)

    @property
    def freedom(self) -> Freedom:
        """One point."""
        return Freedom.NONE

    @property
    def axis(self) -> Tensor:
        """Unused."""
        return self.direction


def unit(direction: Direction) -> Tensor:
    """(3,) float64 unit vector of "x", "-z", … or three numbers; always the same tensor."""
    return _unit(_plain(direction))


def _plain(direction: Direction) -> str | tuple[float, ...]:
    return direction if isinstance(direction, str) else tuple(direction)


@lru_cache
def _unit(direction: str | tuple[float, ...]) -> Tensor:
    if isinstance(direction, str):
        name = direction.removeprefix("-")
        if name not in _AXES:
            raise ValueError(f"direction {direction!r}: choose x, y, z, -x, -y, -z or three numbers")
        vector = torch.tensor(_AXES[name], dtype=torch.float64)
        return -vector if direction.startswith("-") else vector
    if len(direction) != 3 or not all(map(math.isfinite, direction)) or not any(direction):
        raise ValueError(f"direction {direction}: expected three finite numbers, not all zero")
    return torch.nn.functional.normalize(torch.tensor(direction, dtype=torch.float64), dim=0)


@lru_cache
def _towards(around: str | tuple[float, ...], towards: str | tuple[float, ...] | None) -> Tensor:
    axis = _unit(around)
    if towards is None:
        if not isinstance(around, str):
            raise ValueError(f"about the axis {around}: say with towards= where the keypoint lies")
        towards = _NEXT[around.removeprefix("-")]
    direction = _unit(towards)
    if abs(float(axis @ direction)) > 1e-9:
        raise ValueError(f"towards {towards} is not perpendicular to the axis {around}")
    return direction
