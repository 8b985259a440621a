"""BOP's `models` folder: meshes, sizes and symmetries of the part objects; millimetres, part frame."""

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from pnet.data.export.files import ply_content, write_json
from pnet.data.export.object_scenes import ObjectScenes
from pnet.data.json_files import read_json
from pnet.geometry.symmetry import FLIP, FiniteSymmetry, RevolutionSymmetry, Symmetry
from pnet.scenes.record_file import write_atomically

INFO = "models_info.json"


def add_model(folder: Path, obj_id: int, shown: ObjectScenes) -> None:
    """Write a part object's mesh and its entry in models_info.json, beside those that are there.

    Raises:
        ValueError: another part object has this number there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    mesh = trimesh.Trimesh(1000 * shown.mesh.vertices, shown.mesh.faces, process=False)
    entry = {**model_sizes(mesh), **model_symmetries(shown.part.symmetry)}
    entry["parameters"] = {name: 1000 * value for name, value in shown.named_parameters.items()}  # ours
    models = _read_info(folder / INFO)
    if models.setdefault(str(obj_id), entry) != entry:
        raise ValueError(
            f"{folder / INFO}: object {obj_id} is another part object there, not {shown.part.name} with "
            f"{shown.part.text(shown.parameters)}; export to another folder"
        )
    write_atomically(folder / f"obj_{obj_id:06d}.ply", ply_content(mesh, normals=True))
    write_json(folder / INFO, {key: models[key] for key in sorted(models, key=int)})


def model_sizes(mesh: trimesh.Trimesh) -> dict[str, float]:
    """Diameter (largest distance of two vertices), least corner and size of a mesh, in its unit."""
    low, high = mesh.bounds
    least = {f"min_{axis}": float(value) for axis, value in zip("xyz", low, strict=True)}
    sizes = {f"size_{axis}": float(value) for axis, value in zip("xyz", high - low, strict=True)}
    corners = mesh.convex_hull.vertices
    diameter = max(float(np.linalg.norm(corners - corner, axis=1).max()) for corner in corners)
    return {"diameter": diameter, **least, **sizes}


def model_symmetries(symmetry: Symmetry) -> dict[str, Any]:
    """A symmetry as models_info.json says it; the part frame's origin lies on every axis.

    Note:
        A finite group is discrete, without the identity. A revolution is continuous about z; where its ends
        are equal, a half turn about x comes beside, and the benchmark combines the two. BOP has no sphere: it
        gets the continuous axes x, y and z; turns about them are symmetries, but not all that a sphere has.
    """
    match symmetry:
        case FiniteSymmetry(rotations=G):
            discrete, axes = G[1:].double().numpy(), ""
        case RevolutionSymmetry(rotoreflection=reflected):
            discrete, axes = np.array([FLIP] * reflected).reshape(-1, 3, 3), "z"
        case _:
            discrete, axes = np.zeros((0, 3, 3)), "xyz"
    found: dict[str, Any] = {}
    if len(discrete):
        found["symmetries_discrete"] = [_homogeneous(R) for R in discrete]
    if axes:
        unit = {axis: [int(axis == other) for other in "xyz"] for axis in axes}
        found["symmetries_continuous"] = [{"axis": unit[axis], "offset": [0, 0, 0]} for axis in axes]
    return found


def _homogeneous(R: NDArray[np.float64]) -> list[float]:
    """(3, 3) → 16 numbers of the 4 x 4 matrix without translation, row by row."""
    matrix = np.eye(4)
    matrix[:3, :3] = R
    return [float(value) for value in matrix.reshape(-1)]


def _read_info(path: Path) -> dict[str, Any]:
    if not path.exists():
        return {}
    models = read_json(path)
    if not isinstance(models, dict) or not all(key.isdecimal() for key in models):
        raise ValueError(
            f"{path}: expected an object with a number for each model; delete it or export elsewhere"
        )
    return models
