"""Whether a declared part is sound: what `pnet-part` prints and what a new part should pass."""

from collections.abc import Iterator
from dataclasses import dataclass

import manifold3d
import numpy as np
import roma
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor

from pnet.geometry.rigid import apply_pose
from pnet.geometry.symmetry import RevolutionSymmetry, SphericalSymmetry, nearest_equivalent
from pnet.parts.base import ParametricPart
from pnet.parts.choice import KeypointChoice
from pnet.parts.shapes import manifold

Points = NDArray[np.float64]
ROUND_TRIP = 1e-9  # metres, largest error of parameters out of exact keypoints
UNION = 0.01  # share of the volume by which convex pieces may miss the solid


@dataclass(frozen=True)
class Check:
    """One statement about a part.

    Attributes:
        name: what must hold. passed: whether it does. detail: the figure.
        is_advice: it may be meant so, and is no fault of the declaration.
    """

    name: str
    passed: bool
    detail: str
    is_advice: bool = False


def check_part(part: ParametricPart, samples: int, seed: int = 0) -> Iterator[Check]:
    """Check the solid of the smallest and largest part objects, and the keypoints of random ones.

    Args:
        part: the template. samples: random (parameters, pose) pairs. seed: of them.
    """
    grid = part.grids["L"]
    ends = np.unique(grid[[0, -1]], axis=0)
    meshes = [part.mesh(row) for row in ends]
    closed = all(mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0 for mesh in meshes)
    yield Check("mesh is watertight, faces wound outwards", closed, f"{len(meshes[0].faces)} faces")
    off = max(float(np.linalg.norm(mesh.center_mass)) for mesh in meshes)
    yield Check("volume centroid is the origin", off < 1e-9, f"{1000 * off:.1e} mm off")
    yield _pieces_check(part, ends, meshes)
    yield _symmetry_check(part, meshes)
    if closed:
        yield _missing_symmetry_check(part, meshes)
    error = round_trip_error(part, *random_instances(part, samples, seed))
    yield Check("keypoints give the parameters back", error < ROUND_TRIP, f"{1000 * error:.1e} mm at most")


def random_instances(part: ParametricPart, samples: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Random valid parameters between the smallest and largest of all grids, and random poses.

    Returns:
        parameters (n, k) metres, R (n, 3, 3), t (n, 3) metres part → camera; float64.
    """
    rng = np.random.default_rng(seed)
    values = np.concatenate(list(part.grids.values()))
    parameters = np.empty((0, part.k))
    while len(parameters) < samples:
        drawn = rng.uniform(values.min(0), values.max(0), (samples, part.k))
        parameters = np.concatenate([parameters, drawn[[_valid(part, row) for row in drawn]]])
        if len(parameters) == 0:
            raise ValueError(f"{part.name}: no valid parameters between the grids' ends")
    quaternion = torch.from_numpy(rng.normal(size=(samples, 4)))
    R = roma.unitquat_to_rotmat(torch.nn.functional.normalize(quaternion, dim=-1))
    t = torch.from_numpy(rng.uniform([-0.1, -0.1, 0.4], [0.1, 0.1, 0.8], (samples, 3)))
    return torch.from_numpy(parameters[:samples]), R, t


def round_trip_error(part: ParametricPart, parameters: Tensor, R: Tensor, t: Tensor) -> float:
    """Largest error of parameters measured between the camera rule's label keypoints, metres."""
    local, _ = part.chain.select(KeypointChoice(), parameters, R)
    found = part.chain.parameters_from_keypoints(t, apply_pose(R, t, local))
    return float((found - parameters).abs().max())


def _valid(part: ParametricPart, parameters: Points) -> bool:
    try:
        part.check_named(parameters)
    except ValueError:
        return False
    return True


def _pieces_check(part: ParametricPart, ends: Points, meshes: list[trimesh.Trimesh]) -> Check:
    name = "convex pieces make up the solid"
    worst, count = 0.0, 0
    for row, mesh in zip(ends, meshes, strict=True):
        pieces = part.convex_pieces(row, fill_holes=False)
        hulls = [manifold3d.Manifold.hull_points(piece) for piece in pieces]
        union = manifold3d.Manifold.batch_boolean(hulls, manifold3d.OpType.Add).volume()
        worst, count = max(worst, abs(union / mesh.volume - 1)), len(pieces)
    filled = len(part.convex_pieces(ends[0], fill_holes=True))
    # a CAD part's hull is a choice of its config, not a fault
    passed = worst < UNION or part.is_fixed
    return Check(name, passed, f"{count} pieces ({filled} with holes filled), volume {100 * worst:.2g}% off")


def _symmetry_check(part: ParametricPart, meshes: list[trimesh.Trimesh]) -> Check:
    """Every symmetry element must carry the solid onto itself; turns by one side of the circles' polygons."""
    name = "symmetry carries the solid onto itself"
    elements = part.chain.group.numpy()
    if isinstance(part.symmetry, RevolutionSymmetry | SphericalSymmetry):
        elements = np.concatenate([elements, _turn("z", 2 * np.pi / part.sections)[None]])
    if any(manifold(mesh).volume() <= 0 for mesh in meshes):
        return Check(name, False, "the mesh is open")
    worst = max(_left_over(mesh, element) for mesh in meshes for element in elements)
    # where polygons stand for circles a turn by another angle leaves a little over
    return Check(name, worst < 0.005, f"{100 * worst:.2g}% of the volume left over")


def _missing_symmetry_check(part: ParametricPart, meshes: list[trimesh.Trimesh]) -> Check:
    """A turn that carries every size's solid onto itself should be declared: else labels are ambiguous.

    It is advice: a solid may stand for a body that is less symmetric than itself.
    """
    name, found = "no rotation symmetry is missing", []
    for axis in "xyz":
        for fraction in (2, 3, 4, 5, 6):
            turn = _turn(axis, 2 * np.pi / fraction)
            nearest = nearest_equivalent(torch.eye(3).double(), torch.from_numpy(turn), part.symmetry)
            declared = bool((nearest - torch.from_numpy(turn)).abs().max() < 1e-6)
            if not declared and all(_left_over(mesh, turn) < 1e-6 for mesh in meshes):
                found.append(f"1/{fraction} turn about {axis}")
    detail = f"{', '.join(found)} also fits" if found else "turns about x, y, z tried"
    return Check(name, not found, detail, is_advice=True)


def _left_over(mesh: trimesh.Trimesh, element: Points) -> float:
    """Share of the volume that an orthonormal matrix carries out of the solid."""
    solid = manifold(mesh)
    return float(1 - (solid ^ solid.transform(np.c_[element, np.zeros(3)])).volume() / solid.volume())


def _turn(axis: str, angle: float) -> Points:
    unit = torch.tensor([float(axis == name) for name in "xyz"], dtype=torch.float64)
    return np.asarray(roma.rotvec_to_rotmat(angle * unit))
