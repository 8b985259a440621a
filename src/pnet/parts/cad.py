"""A part of fixed size from a CAD mesh: bounding primitives make it a parametric part of one size (Section
III.A).

"A non-parametric object can be converted into a part object from a shape template consisting of several
simple bounding primitives": the parameters are the sizes of those, all of one value.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from pnet.geometry.symmetry import RevolutionSymmetry, SphericalSymmetry, Symmetry
from pnet.parts.base import ParametricPart
from pnet.parts.declared_fields import (
    Fields,
    check_kind,
    keypoint_from,
    lookalikes_from,
    mirror_from,
    symmetry_from,
)
from pnet.parts.primitives import Circle, Corner, Plane, Sphere
from pnet.parts.selection import Keypoint
from pnet.parts.shapes import Shape

Points = NDArray[np.float64]
UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "inch": 0.0254}
ENDINGS = (".stl", ".obj", ".ply", ".off", ".glb")


class CadPart(ParametricPart):
    """A mesh with bounding primitives.

    Args:
        name: the template's name. mesh: a watertight .stl, .obj, .ply, .off or .glb; its coordinates are the
            frame of construction, its symmetry axis z. unit: mm, cm, m or inch.
        bounds: "cuboid" (sizes l, w, h along x, y, z, one corner as reference), "cylinder" (r, h about z),
            "sphere" (r); used where no keypoints are given.
        keypoints, sizes: a declaration of one's own as in `DeclaredPart`, and the value of every parameter,
            mm.
        symmetry, mirror, lookalikes: as in `DeclaredPart`.
        collision: "hull" or "coacd" (convex pieces by the package coacd) for physics.
    """

    is_fixed = True

    def __init__(
        self,
        name: str,
        mesh: str,
        unit: str = "mm",
        bounds: str = "cuboid",
        symmetry: str | Fields = "none",
        mirror: str | None = None,
        lookalikes: Sequence[Sequence[Sequence[str]]] = (),
        keypoints: Mapping[str, Fields] | None = None,
        sizes: Mapping[str, float] | None = None,
        collision: str = "hull",
        sections: int = 48,
    ) -> None:
        self.name = name
        if not isinstance(mesh, str):
            raise ValueError(f"{name}: mesh is {mesh!r}, expected a file's path; give it as part.mesh=")
        self.symmetry, self.mirror = symmetry_from(symmetry), mirror_from(mirror)
        try:
            self.lookalikes = lookalikes_from(lookalikes)
        except ValueError as fault:
            raise ValueError(f"{name}: {fault}") from fault
        self._body = CadShape(read_mesh(Path(mesh), unit), collision)
        if keypoints is None:
            chosen, found = bounding_keypoints(bounds, self._body.whole, self.symmetry)
        else:
            check_kind(Mapping, "a mapping", keypoints=keypoints)
            chosen = tuple(keypoint_from(key, fields) for key, fields in keypoints.items())
            if sizes is None:
                raise ValueError(
                    f"{name}: give sizes: with the value in mm of every parameter that keypoints measure"
                )
            check_kind(Mapping, "a mapping", sizes=sizes)
            for key, value in sizes.items():
                check_kind(Real, "a number in mm", **{f"sizes.{key}": value})
            found = {key: value / 1000 for key, value in sizes.items()}
        self.keypoints, self.parameter_names = chosen, tuple(found)
        super().__init__({key: [1000 * value] for key, value in found.items()}, None, sections)

    def solid(self, parameters: Points) -> Shape:
        """The mesh, whatever the parameters."""
        return self._body


@dataclass(frozen=True, eq=False)
class CadShape(Shape):
    """A given mesh as a shape.

    Attributes:
        whole: watertight, metres. collision: "hull" or "coacd".
    """

    whole: trimesh.Trimesh
    collision: str = "hull"
    axis: str = "z"
    at: tuple[Points | float, ...] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if self.collision not in ("hull", "coacd"):
            raise ValueError(f"collision is {self.collision!r}, choose hull or coacd")

    def own_volume_and_moment(self, sections: int) -> tuple[Points, Points]:
        """The mesh's."""
        volume = np.asarray(self.whole.volume)
        return volume, volume * np.asarray(self.whole.center_mass)

    def own_mesh(self, sections: int) -> trimesh.Trimesh:
        """A copy of the mesh."""
        return self.whole.copy()

    def own_pieces(self, sections: int) -> list[Points]:
        """The hull, or CoACD's pieces."""
        if self.collision == "hull":
            vertices = np.asarray(self.whole.vertices)
            return [vertices[ConvexHull(vertices).vertices]]
        return _coacd_pieces(self.whole)


def read_mesh(path: Path, unit: str) -> trimesh.Trimesh:
    """A watertight mesh in metres, faces wound outwards.

    Raises:
        FileNotFoundError, ValueError: names the file and what is wrong.
    """
    if unit not in UNITS:
        raise ValueError(f"unit is {unit!r}, choose {', '.join(UNITS)}")
    if path.suffix.lower() not in ENDINGS:
        raise ValueError(f"{path}: ends in {path.suffix or 'nothing'}, expected one of {', '.join(ENDINGS)}")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; give the mesh's path as part.mesh=")
    try:
        mesh = trimesh.load(path, force="mesh")
    except Exception as fault:  # every format's reader raises classes of its own
        raise ValueError(f"{path}: not readable as a mesh ({' '.join(str(fault).split())})") from fault
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise ValueError(f"{path}: holds no triangles")
    mesh.merge_vertices()
    if not mesh.is_watertight:
        raise ValueError(
            f"{path}: the mesh is not watertight; close its gaps in a CAD program or with trimesh.repair"
        )
    if not mesh.is_winding_consistent or mesh.volume < 0:
        trimesh.repair.fix_normals(mesh, multibody=True)  # type: ignore[no-untyped-call]
    if not mesh.is_volume:
        raise ValueError(
            f"{path}: the faces' directions contradict each other; let a CAD program write it anew"
        )
    mesh.apply_transform(np.diag([UNITS[unit]] * 3 + [1.0]))
    return mesh


def bounding_keypoints(
    bounds: str, mesh: trimesh.Trimesh, symmetry: Symmetry
) -> tuple[tuple[Keypoint, ...], dict[str, float]]:
    """Keypoints on a bounding primitive, and its sizes.

    Args:
        bounds: "cuboid", "cylinder" or "sphere". mesh: metres. symmetry: of the part.
    Returns:
        keypoints, and parameter → metres.
    """
    low = (1000 * mesh.bounds[0]).tolist()
    length, width, height = (mesh.bounds[1] - mesh.bounds[0]).tolist()
    wanted = {RevolutionSymmetry: "cylinder", SphericalSymmetry: "sphere"}.get(type(symmetry), bounds)
    if bounds != wanted:
        raise ValueError(f"bounds is {bounds!r}, but the symmetry asks for {wanted!r}")
    match bounds:
        case "cuboid":
            corner = Corner((low[0], low[1], low[2]))
            ends = zip(("x", "y", "z"), ("l", "w", "h"), strict=True)
            chosen = [Keypoint(f"{axis}_end", "corner", Plane(axis), size) for axis, size in ends]
            return (Keypoint("corner", "centroid", corner), *chosen), {"l": length, "w": width, "h": height}
        case "cylinder":
            radius = float(np.linalg.norm(mesh.vertices[:, :2], axis=1).max())
            off = float(np.linalg.norm(mesh.center_mass[:2]))
            if off > 0.01 * radius:
                raise ValueError(
                    f"the mesh's centroid lies {1000 * off:.2g} mm off its z axis: "
                    "move the mesh so that z is its axis"
                )
            base = Plane("-z", at=-low[2])
            found = (Keypoint("base", "centroid", base), Keypoint("top", "base", Plane("z"), "h"))
            return (*found, Keypoint("rim", "base", Circle("z"), "r")), {"h": height, "r": radius}
        case "sphere":
            radius = float(np.linalg.norm(mesh.vertices - mesh.center_mass, axis=1).max())
            return (Keypoint("surface", "centroid", Sphere(), "r"),), {"r": radius}
    raise ValueError(f"bounds is {bounds!r}, choose cuboid, cylinder or sphere")


def _coacd_pieces(mesh: trimesh.Trimesh) -> list[Points]:
    try:
        import coacd
    except ModuleNotFoundError as fault:
        raise ModuleNotFoundError(
            "convex pieces of a CAD mesh need the package coacd: pip install 'pnet[cad]', or collision=hull"
        ) from fault
    coacd.set_log_level("error")
    pieces = coacd.run_coacd(coacd.Mesh(mesh.vertices, mesh.faces), threshold=0.02, seed=0)
    return [np.asarray(vertices, np.float64) for vertices, _ in pieces]
