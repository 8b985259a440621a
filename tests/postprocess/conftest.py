"""Parts of every class of symmetry, and what compares poses modulo it."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from pnet.geometry.rigid import axis_angle_between, rotation_angle
from pnet.geometry.symmetry import (
    FiniteSymmetry,
    RevolutionSymmetry,
    SphericalSymmetry,
    Symmetry,
    cyclic,
    dihedral,
    reflection,
)
from pnet.parts.base import ParametricPart, Points
from pnet.parts.primitives import Plane, Sphere
from pnet.parts.selection import Keypoint
from pnet.parts.shapes import Ball, Shape
from pnet.parts.solids import Solid, box, moved
from pnet.parts.tn16 import TN16
from pnet.parts.tn42 import TN42


def cube(x: Points, y: Points, z: Points) -> Shape:
    """A cuboid about the origin by its edges."""
    return box((-x / 2, x / 2), (-y / 2, y / 2), (-z / 2, z / 2))


class Brick(ParametricPart):
    """Three different edges; three mirror planes, so half of its face choices are mirror images."""

    name = "brick"
    parameter_names = ("a", "b", "c")
    symmetry = dihedral(2)
    mirror = reflection((0, 0, 1))
    keypoints = tuple(
        Keypoint(axis, "centroid", Plane(axis), parameter, 0.5)
        for axis, parameter in zip("xyz", parameter_names, strict=True)
    )

    def solid(self, parameters: Points) -> Shape:
        return cube(*self.split(parameters))


class Plug(ParametricPart):
    """A plate with posts on two opposite corners: one half turn and no mirror."""

    name = "plug"
    parameter_names = ("l", "w", "h")
    symmetry = cyclic(2)
    keypoints = (
        Keypoint("base", "centroid", Plane("-z", at=0)),
        Keypoint("top", "base", Plane("z"), "h"),
        Keypoint("end", "centroid", Plane("x"), "l", 0.5),
        Keypoint("side", "centroid", Plane("y"), "w", 0.5),
    )

    def solid(self, parameters: Points) -> Solid:
        length, w, h = self.split(parameters)
        plate = box((-length / 2, length / 2), (-w / 2, w / 2), (0 * h, h / 2))
        posts = [
            box((x, x + length / 4), (y, y + w / 4), (h / 2, h))
            for x, y in ((length / 4, w / 4), (-length / 2, -w / 2))
        ]
        return plate | posts[0] | posts[1]


class Marble(ParametricPart):
    """A ball."""

    name = "marble"
    parameter_names = ("r",)
    symmetry = SphericalSymmetry()
    keypoints = (Keypoint("surface", "centroid", Sphere(), "r"),)

    def solid(self, parameters: Points) -> Shape:
        return Ball(self.split(parameters)[0])


THIRD = torch.eye(3, dtype=torch.float64)[[2, 0, 1]]  # x → y → z → x
HALVES = [torch.diag(torch.tensor(d).double()) for d in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))]
TURNS = [torch.eye(3, dtype=torch.float64), THIRD, THIRD @ THIRD]
BALL = 0.004  # radius of the jack's balls, metres


class Jack(ParametricPart):
    """A cube of width b with balls that reach out to s at four of its corners: twelve turns."""

    name = "jack"
    parameter_names = ("b", "s")
    symmetry = FiniteSymmetry(torch.stack([h @ t for h in HALVES for t in TURNS]))
    keypoints = (
        Keypoint("tip", "centroid", Plane((1.0, 1.0, 1.0)), "s"),
        Keypoint("face", "centroid", Plane("x"), "b", 0.5),
    )

    def solid(self, parameters: Points) -> Solid:
        b, s = self.split(parameters)
        body: Shape | Solid = cube(b, b, b)
        corner = (s - BALL) / np.sqrt(3)
        for half in HALVES:
            body = body | moved(Ball(BALL), at=tuple(corner * sign for sign in half.diagonal().tolist()))
        return body


OWN = {
    "brick": (Brick, {"a": [10, 12], "b": [16, 19], "c": [24, 28]}),
    "plug": (Plug, {"l": [30, 34], "w": [20, 22], "h": [12, 14]}),
    "marble": (Marble, {"r": [8, 11]}),
    "jack": (Jack, {"b": [14, 16], "s": [15, 16.5]}),
    "tn16": (TN16, {"r": [6, 12], "h": [12, 24], "c": [4, 10]}),
    "tn42": (TN42, {"l": [30, 48], "a": [10, 19], "w": [8, 17]}),
}


@pytest.fixture(scope="session", params=["tn06", "tn34", *OWN])
def any_part(request: pytest.FixtureRequest) -> ParametricPart:
    """A part of every class of symmetry in turn."""
    if request.param not in OWN:
        return request.getfixturevalue(request.param)
    kind, grid = OWN[request.param]
    return kind(grid)


@pytest.fixture(scope="session")
def brick() -> ParametricPart:
    return Brick(OWN["brick"][1])


@pytest.fixture(scope="session")
def tn42() -> ParametricPart:
    return TN42(OWN["tn42"][1])


@pytest.fixture(scope="session")
def random_poses() -> Callable[..., tuple[torch.Tensor, torch.Tensor]]:
    """R (n, 3, 3), t (n, 3) in the bin."""

    def make(n: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
        rng = np.random.default_rng(seed)
        R = torch.from_numpy(Rotation.random(n, rng).as_matrix())
        return R, torch.from_numpy(rng.uniform([-0.1, -0.1, 0.4], [0.1, 0.1, 0.8], (n, 3)))

    return make


@pytest.fixture(scope="session")
def random_sizes() -> Callable[..., torch.Tensor]:
    """(n, k) valid parameters between those of the grid."""

    def make(part: ParametricPart, n: int, seed: int = 0) -> torch.Tensor:
        rng = np.random.default_rng(seed)
        grid = part.grids["L"]
        mix = rng.dirichlet(np.ones(3), n)
        return torch.from_numpy(np.einsum("nj,njk->nk", mix, grid[rng.integers(0, len(grid), (n, 3))]))

    return make


@pytest.fixture(scope="session")
def error_modulo() -> Callable[..., float]:
    """Largest angle between rotations (n, 3, 3), radians, after the symmetry is taken out."""

    def error(symmetry: Symmetry, Ra: torch.Tensor, Rb: torch.Tensor) -> float:
        match symmetry:
            case FiniteSymmetry(rotations=G):
                each = rotation_angle(Ra[:, None] @ G, Rb[:, None].expand(-1, len(G), 3, 3))
                return float(each.amin(1).max())
            case RevolutionSymmetry(rotoreflection=reflected):
                angle = axis_angle_between(Ra[..., 2], Rb[..., 2])
                return float((torch.minimum(angle, math.pi - angle) if reflected else angle).max())
        return 0.0

    return error
