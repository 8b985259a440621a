"""Chains of keypoints that between them have every freedom and every kind of symmetry; checks of solids."""

from collections.abc import Callable

import numpy as np
import pytest
import roma
import torch
import trimesh
from scipy.spatial import ConvexHull
from torch import Tensor

from pnet.geometry.symmetry import (
    RevolutionSymmetry,
    SphericalSymmetry,
    Symmetry,
    cyclic,
    dihedral,
    reflection,
)
from pnet.parts.keypoints import KeypointChain
from pnet.parts.primitives import Circle, Corner, Cylinder, Plane, Polygon, Sphere
from pnet.parts.selection import Keypoint, cone_keypoints
from pnet.parts.solids import Solid

SECTIONS = 24  # of the circles in test_shapes and test_solids
Declaration = tuple[list[Keypoint], str, Symmetry, Tensor | None]
NUT = [
    Keypoint("face", "centroid", Plane("z"), "h", 0.5),
    Keypoint("hole", "face", Circle("z"), "r"),
    Keypoint("vertex", "face", Polygon(6), "d"),
]
# the lower triangle is turned by 60°: half turns about x carry towards y to towards -y
ANTIPRISM = [
    Keypoint("face", "centroid", Plane("z"), "h", 0.5),
    Keypoint("vertex", "face", Polygon(3, towards="y"), "d"),
    Keypoint("waist", "centroid", Cylinder("z"), "r"),
]
DECLARATIONS: dict[str, Declaration] = {
    "nut": (NUT, "rhd", dihedral(6), None),
    "nut with mirror": (NUT, "rhd", dihedral(6), reflection((0, 0, 1))),
    "antiprism": (ANTIPRISM, "rhd", dihedral(3), None),
    "antiprism with inversion": (ANTIPRISM, "rhd", dihedral(3), -torch.eye(3, dtype=torch.float64)),
    "flange": (
        [Keypoint("end", "centroid", Plane("-z"), "h"), Keypoint("rim", "end", Circle("z"), "r")],
        "rh",
        RevolutionSymmetry(),
        None,
    ),
    "double cone": (
        [
            Keypoint("end", "centroid", Plane("z"), "h", 0.5),
            *cone_keypoints("rim", "apex", reference="end", axis="z", radius="r", height="c"),
        ],
        "rhc",
        RevolutionSymmetry(rotoreflection=True),
        None,
    ),
    "ball": ([Keypoint("skin", "centroid", Sphere(), "r")], "r", SphericalSymmetry(), None),
    "wedge": (
        [
            Keypoint("foot", "centroid", Corner(("-0.3 * l", 0, "-0.4 * a"))),
            Keypoint("toe", "foot", Plane("x"), "l"),
            Keypoint("head", "foot", Plane("z"), "a"),
            Keypoint("side", "centroid", Plane("y"), "w", 0.5),
        ],
        "law",
        cyclic(1),
        reflection((0, 1, 0)),
    ),
    "crossed pipes": (
        [
            Keypoint("pipe", "centroid", Cylinder("x", towards="z"), "r"),
            Keypoint("end", "centroid", Plane("x"), "l", 0.5),
            Keypoint("lid", "centroid", Plane("z"), "h", 0.5),
        ],
        "rlh",
        dihedral(4),
        None,
    ),
    "lug": (
        [
            Keypoint("lid", "centroid", Plane("z"), "h", 0.5),
            Keypoint("eye", "lid", Plane("x"), "a"),
            Keypoint("rim", "eye", Circle("z"), "r"),
            Keypoint("floor", "rim", Plane("-z"), "h"),
        ],
        "har",
        cyclic(2),
        None,
    ),
}
Rotations = Callable[..., Tensor]


@pytest.fixture(params=DECLARATIONS)
def chain(request: pytest.FixtureRequest) -> KeypointChain:
    return KeypointChain(*DECLARATIONS[request.param])


@pytest.fixture(scope="session")
def declare() -> Callable[[str], KeypointChain]:
    """One of the declarations by its name."""
    return lambda name: KeypointChain(*DECLARATIONS[name])


@pytest.fixture(scope="session")
def rotations() -> Rotations:
    """Makes (n, 3, 3) float64 random rotations."""

    def make(n: int, seed: int = 0) -> Tensor:
        normal = torch.randn(n, 3, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        return roma.special_procrustes(normal)

    return make


@pytest.fixture(scope="session")
def sizes() -> Callable[..., Tensor]:
    """Makes (n, k) float64 random parameters of a chain from 5 to 25 mm."""

    def make(chain: KeypointChain, n: int, seed: int = 1) -> Tensor:
        share = torch.rand(n, len(chain.parameters), generator=torch.Generator().manual_seed(seed))
        return 0.005 + 0.02 * share.double()

    return make


@pytest.fixture(scope="session")
def symmetries() -> Callable[[KeypointChain], Tensor]:
    """(g, 3, 3) of a declared chain's symmetries, reflections and some turns too."""

    def make(chain: KeypointChain) -> Tensor:
        generator = torch.Generator().manual_seed(2)
        if chain.names == ["skin"]:
            normal = torch.randn(6, 3, 3, generator=generator, dtype=torch.float64)
            return roma.special_procrustes(normal)
        if chain.names in (["end", "rim"], ["end", "rim", "apex"]):
            angle = 6.28 * torch.rand(6, generator=generator).double()
            turns = roma.rotvec_to_rotmat(angle[:, None] * torch.tensor([0.0, 0, 1]).double())
            return (turns[:, None] @ chain.group).flatten(0, 1)
        return chain.group

    return make


@pytest.fixture(scope="session")
def polygon_area() -> Callable[..., float]:
    """Area of a regular polygon by its circumradius."""
    return lambda radius, sections=SECTIONS: sections / 2 * radius**2 * np.sin(2 * np.pi / sections)


@pytest.fixture(scope="session")
def check_pieces() -> Callable[..., list[np.ndarray]]:
    """Each piece is its own hull's corners; their union has the volume."""

    def check(body: Solid, volume: float, fill_holes: bool = False) -> list[np.ndarray]:
        pieces = body.pieces(SECTIONS, fill_holes)
        hulls = [trimesh.convex.convex_hull(piece) for piece in pieces]
        for piece, hull in zip(pieces, hulls, strict=True):
            assert len(ConvexHull(piece).vertices) <= len(piece) and hull.volume > 0
        assert trimesh.boolean.union(hulls, engine="manifold").volume == pytest.approx(volume, rel=0.01)
        return pieces

    return check
