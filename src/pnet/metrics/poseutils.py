"""The benchmark's `poseutils.json`: an object's symmetry, inertial frame and distance threshold.

Types: AffinePoseUtils (finite symmetry), RevolutionPoseUtils, and our own SphericalPoseUtils, which
the benchmark lacks. Metres. Lambda and G are in the inertial frame.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import roma
import torch
from numpy.typing import NDArray
from torch import Tensor

from pnet.geometry.pose_space import PoseSpace
from pnet.geometry.symmetry import (
    FiniteSymmetry,
    RevolutionSymmetry,
    SphericalSymmetry,
    Symmetry,
)
from pnet.scenes.record_file import write_atomically

ROTATION_TOLERANCE = 1e-3
_FINITE, _REVOLUTION, _SPHERE = "AffinePoseUtils", "RevolutionPoseUtils", "SphericalPoseUtils"


def read_poseutils(path: Path) -> PoseSpace:
    """Read a `poseutils.json`; ValueError names the file and the key.

    Note:
        A missing Rref2i is the identity, a missing tref2i zero.
    """
    fields = read_json(path)
    if not isinstance(fields, dict):
        raise ValueError(f"{path}: holds a {type(fields).__name__}, expected an object")
    where = str(path)
    symmetry, scale = _symmetry_and_scale(fields, where)
    fields = {"Rref2i": np.eye(3).tolist(), "tref2i": [0.0] * 3} | fields
    threshold = float(read_numbers(fields, "distance_threshold", where, ()))
    if threshold <= 0:
        raise ValueError(f"{where}: key 'distance_threshold' is {threshold}, expected more than 0")
    frame_R = torch.from_numpy(read_rotation(fields, "Rref2i", where))
    # files write the vector as a list, a column or a row
    frame_t = torch.from_numpy(read_numbers(fields, "tref2i", where, (3,), (3, 1), (1, 3)))
    return PoseSpace(symmetry, scale, frame_R, frame_t.reshape(3), threshold)


def write_poseutils(path: Path, space: PoseSpace) -> None:
    """Write what `read_poseutils` reads."""
    fields: dict[str, Any]
    match space.symmetry:
        case FiniteSymmetry(rotations=G):
            fields = {"type": _FINITE, "Lambda": space.scale.tolist(), "G": G.tolist()}
        case RevolutionSymmetry(rotoreflection=reflected):
            fields = {"type": _REVOLUTION, "lambda": float(space.scale)}
            fields["rotoreflection_symmetry"] = reflected
        case _:
            fields = {"type": _SPHERE}
    fields |= {"Rref2i": space.frame_R.tolist(), "tref2i": space.frame_t.tolist()}
    fields["distance_threshold"] = space.distance_threshold
    write_atomically(path, (json.dumps(fields, indent=2) + "\n").encode())


def read_json(path: Path) -> Any:
    """Parse a file; ValueError names it."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: is not valid JSON: {error}") from error


def read_numbers(
    fields: dict[str, Any], key: str, where: str, *shapes: tuple[int, ...]
) -> NDArray[np.float64]:
    """Finite numbers out of a JSON object.

    Args:
        where: file and entry, for the error.
        shapes: those allowed; −1 stands for any length.
    """
    if key not in fields:
        raise ValueError(f"{where}: key {key!r} is missing")
    expected = " or ".join(map(str, shapes)).replace("-1", "n")
    try:
        value = np.asarray(fields[key])
    except ValueError:
        raise ValueError(f"{where}: key {key!r} is ragged, expected shape {expected}") from None
    if value.dtype.kind not in "iuf":
        raise ValueError(f"{where}: key {key!r} does not hold numbers of shape {expected}")
    if not any(_fits(value.shape, shape) for shape in shapes):
        raise ValueError(f"{where}: key {key!r} has shape {value.shape}, expected {expected}")
    if not np.isfinite(value).all():
        raise ValueError(f"{where}: key {key!r} holds NaN or infinity")
    return value.astype(np.float64)


def read_rotation(fields: dict[str, Any], key: str, where: str) -> NDArray[np.float64]:
    """A (3, 3) rotation out of a JSON object."""
    R = read_numbers(fields, key, where, (3, 3))
    _check_rotations(R, key, where)
    return R


def _fits(shape: tuple[int, ...], pattern: tuple[int, ...]) -> bool:
    return len(shape) == len(pattern) and all(p in (-1, n) for n, p in zip(shape, pattern, strict=True))


def _check_rotations(R: NDArray[np.float64], key: str, where: str) -> None:
    """R: (..., 3, 3)."""
    gap = np.abs(R @ R.swapaxes(-1, -2) - np.eye(3)).max()
    if gap > ROTATION_TOLERANCE or (np.linalg.det(R) < 0).any():
        raise ValueError(
            f"{where}: key {key!r} is not a rotation (R Rᵀ is off the identity by {gap:.2g}, "
            f"smallest determinant {np.linalg.det(R).min():.2g})"
        )


def _symmetry_and_scale(fields: dict[str, Any], where: str) -> tuple[Symmetry, Tensor]:
    match fields.get("type"):
        case "AffinePoseUtils":
            scale = torch.from_numpy(read_numbers(fields, "Lambda", where, (3, 3)))
            return _read_group(fields, where), scale
        case "RevolutionPoseUtils":
            radius = float(read_numbers(fields, "lambda", where, ()))
            if radius < 0:
                raise ValueError(f"{where}: key 'lambda' is {radius}, expected 0 or more")
            return _read_revolution(fields, where), torch.tensor(radius, dtype=torch.float64)
        case "SphericalPoseUtils":
            return SphericalSymmetry(), torch.zeros((), dtype=torch.float64)
        case other:
            expected = ", ".join((_FINITE, _REVOLUTION, _SPHERE))
            raise ValueError(f"{where}: key 'type' is {other!r}, expected one of {expected}")


def _read_group(fields: dict[str, Any], where: str) -> FiniteSymmetry:
    values = read_numbers(fields, "G", where, (-1, 3, 3))
    _check_rotations(values, "G", where)
    # printed digits leave the rotations slightly off, the group check is strict
    G = roma.special_procrustes(torch.from_numpy(values))
    gap = (G - torch.eye(3, dtype=G.dtype)).abs().amax((-1, -2))
    order = [int(gap.argmin())] + [i for i in range(len(G)) if i != int(gap.argmin())]
    try:
        return FiniteSymmetry(G[order])
    except ValueError as error:
        raise ValueError(f"{where}: key 'G': {error}") from error


def _read_revolution(fields: dict[str, Any], where: str) -> RevolutionSymmetry:
    reflected = fields.get("rotoreflection_symmetry")
    if not isinstance(reflected, bool):
        raise ValueError(f"{where}: key 'rotoreflection_symmetry' is {reflected!r}, expected true or false")
    return RevolutionSymmetry(reflected)
