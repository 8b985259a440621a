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
from torch import Tensor

from pnet.data.json_files import check_rotations, read_numbers, read_object, read_rotation
from pnet.geometry.pose_space import PoseSpace
from pnet.geometry.symmetry import (
    FiniteSymmetry,
    RevolutionSymmetry,
    SphericalSymmetry,
    Symmetry,
)
from pnet.scenes.record_file import write_atomically

_FINITE, _REVOLUTION, _SPHERE = "AffinePoseUtils", "RevolutionPoseUtils", "SphericalPoseUtils"


def read_poseutils(path: Path) -> PoseSpace:
    """Read a `poseutils.json`; ValueError names the file and the key.

    Note:
        A missing Rref2i is the identity, a missing tref2i zero.
    """
    fields = read_object(path)
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
    check_rotations(values, "G", where)
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
