"""What every parametric part declares, and what follows from it."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache
from itertools import product
from numbers import Real

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor

from pnet.geometry.pose_space import PoseSpace
from pnet.geometry.symmetry import FiniteSymmetry, Symmetry
from pnet.parts.keypoints import Exchange, KeypointChain
from pnet.parts.selection import Keypoint
from pnet.parts.shapes import Shape
from pnet.parts.solids import Solid, solid

Points = NDArray[np.float64]
Grid = Mapping[str, Sequence[float]]


class ParametricPart(ABC):
    """A shape template; a part object is the template with parameter values.

    A subclass declares the class attributes and the solid; everything else follows. The solid may be built
    about any origin (the frame of construction); the part frame has the same axes and its origin at the
    volume centroid.

    Attributes:
        name: the template's name. parameter_names: (k) in the order of every parameter array.
        keypoints: the declaration from which labels, parameters and the fit follow.
        symmetry: proper rotations that leave the part unchanged; a revolution's axis is z.
        mirror: (3, 3) an improper symmetry, or None; only where no proper one does the same to the keypoints.
        lookalikes: ways to exchange pairs of keypoints (names) such that those of the part in another pose,
            which looks much the same, lie nearly where they lay; see `KeypointChain`.
        closed_form_centroid: whether the centroid is the signed sum of the shapes' own; None: find out with
            the first and last part objects. False where shapes overlap, or are cut beyond their borders, for
            some sizes only.
        is_fixed: all bodies have the same, known sizes, so estimates take them from the part.
    """

    name: str
    parameter_names: tuple[str, ...]
    keypoints: tuple[Keypoint, ...]
    symmetry: Symmetry
    mirror: Tensor | None = None
    lookalikes: tuple[Exchange, ...] = ()
    closed_form_centroid: bool | None = None
    is_fixed: bool = False

    def __init__(
        self,
        learning: Grid,
        generalization: Grid | None = None,
        sections: int = 48,
    ) -> None:
        """
        Args:
            learning: parameter → values in mm; all combinations are the part objects of the training
                set and of the L-dataset. generalization: the same for the G-dataset; None where there is
                none.
            sections: polygon sides that stand for a circle in the mesh.
        """
        if len(set(self.parameter_names)) < len(self.parameter_names):
            raise ValueError(f"{self.name}: a parameter name comes twice in {list(self.parameter_names)}")
        if not isinstance(sections, int) or sections < 6 or sections % 6:
            raise ValueError(f"{self.name}: sections is {sections}, expected a multiple of 6")
        self.sections = sections
        self.grids = {"L": self._grid("learning", learning)}
        if generalization is not None:
            self.grids["G"] = self._grid("generalization", generalization)
        for grid in self.grids.values():
            self._check_grid(grid)
        try:
            self.chain = KeypointChain(
                self.keypoints,
                self.parameter_names,
                self.symmetry,
                self.mirror,
                self.centroid,
                typical=np.concatenate(list(self.grids.values())),
                lookalikes=self.lookalikes,
            )
        except ValueError as fault:
            raise ValueError(f"{self.name}: {fault}") from fault

    @abstractmethod
    def solid(self, parameters: Points) -> Solid | Shape:
        """The solid in the frame of construction, out of `pnet.parts.shapes` and `pnet.parts.solids`.

        Args:
            parameters: (..., k) metres. Write it with broadcasting in mind: unpack with
                `r, h = self.split(parameters)`, each (...).
        """

    def check(self, parameters: Points) -> None:  # noqa: B027  most parts have nothing to refuse
        """Raise ValueError where values make no valid solid, with the reason. parameters: (k,) metres."""

    def split(self, parameters: Points) -> list[Points]:
        """(..., k) → k arrays (...)."""
        return list(np.moveaxis(np.asarray(parameters, float), -1, 0))

    def mesh(self, parameters: Points) -> trimesh.Trimesh:
        """The watertight solid, faces wound outwards, in the part frame. parameters: (k,) metres.

        Raises:
            ValueError: where it vanishes or falls apart.
        """
        mesh, centroid = self._construct(parameters), self.centroid(parameters[None])[0]
        if mesh.body_count > 1:  # an inner void is a body too, turned inside out
            count = sum(piece.volume > 0 for piece in mesh.split(only_watertight=False))
            if count > 1:
                raise ValueError(
                    f"{self.name}: the solid falls into {count} pieces with {self.text(parameters)}; "
                    "a cut goes through it, or added shapes don't touch"
                )
        if self.closed_form and np.abs(mesh.center_mass - centroid).max() > 1e-6 * mesh.scale:
            raise ValueError(
                f"{self.name}: shapes overlap, or are cut beyond their borders, with "
                f"{self.text(parameters)}, though not with the first part object; "
                "set closed_form_centroid to false"
            )
        return mesh.apply_translation(-centroid)

    def _construct(self, parameters: Points) -> trimesh.Trimesh:
        """The mesh in the frame of construction."""
        mesh = solid(self.solid(parameters)).mesh(self.sections)
        if len(mesh.faces) == 0 or mesh.volume <= 0:
            raise ValueError(f"{self.name}: nothing is left of the solid with {self.text(parameters)}")
        return mesh

    def convex_pieces(self, parameters: Points, fill_holes: bool) -> list[Points]:
        """Corner points of convex pieces for collision, in the part frame.

        Args:
            parameters: (k,) metres.
            fill_holes: leave holes out; fewer pieces, for holes too small for another part to enter.
        Returns:
            Arrays (n_i, 3), metres; the union of their hulls is the solid (with or without its holes).
        """
        centroid = self.centroid(parameters[None])[0]
        pieces = solid(self.solid(parameters)).pieces(self.sections, fill_holes)
        return [piece - centroid for piece in pieces]

    def centroid(self, parameters: Points) -> Points:
        """Volume centroid in the frame of construction.

        Args:
            parameters: (n, k) metres.
        Returns:
            (n, 3) metres: of the mesh's polyhedron, exactly; in closed form where shapes neither overlap nor
            are cut beyond their borders, else from the mesh.
        """
        if not self.closed_form:
            rows = [self._mesh_centroid(tuple(row)) for row in parameters.tolist()]
            return np.stack(rows) if rows else np.zeros((0, 3))
        volume, moment = solid(self.solid(parameters)).signed_volume_and_moment(self.sections)
        centroid = moment / volume[..., None]
        return np.broadcast_to(centroid, (len(parameters), 3))

    @cached_property
    def closed_form(self) -> bool:
        """Whether `centroid` is a signed sum, see `closed_form_centroid`."""
        if self.closed_form_centroid is not None:
            return self.closed_form_centroid
        ends = np.unique([grid[i] for grid in self.grids.values() for i in (0, -1)], axis=0)
        return all(self._adds_up(row) for row in ends)

    def _adds_up(self, parameters: Points) -> bool:
        volume, _ = solid(self.solid(parameters)).signed_volume_and_moment(self.sections)
        return bool(abs(float(volume) / self._construct(parameters).volume - 1) < 1e-6)

    @lru_cache(maxsize=4096)  # noqa: B019  a part lives as long as its process
    def _mesh_centroid(self, parameters: tuple[float, ...]) -> Points:
        return np.asarray(self._construct(np.array(parameters)).center_mass)

    @property
    def only_size(self) -> Points | None:
        """(k,) metres of the one part object that all grids hold; None where there are several."""
        grid = np.concatenate(list(self.grids.values()))
        return grid[0] if bool((grid == grid[0]).all()) else None

    def part_object(self, grid: str, index: int) -> Points:
        """Parameters of a part object.

        Args:
            grid: "L" or "G". index: position in the grid, the first parameter fastest.
        Returns:
            (k,) metres.
        """
        if grid not in self.grids:
            raise ValueError(f"{self.name} has no grid {grid!r}: choose {' or '.join(self.grids)}")
        values = self.grids[grid]
        if not 0 <= index < len(values):
            raise ValueError(
                f"{self.name} has no part object {index} in grid {grid}: choose 0 to {len(values) - 1}"
            )
        return values[index]

    def pose_space(self, parameters: Points) -> PoseSpace:
        """The benchmark's pose distance of a part object, by the rule that generated the data set's files.

        Centre: area-weighted surface centroid; Λ: square root of the area-weighted covariance of the
        surface; threshold: 0.1 of the diameter of the sphere about the centre that holds the mesh.
        """
        return pose_space_of_mesh(self.mesh(parameters), self.symmetry)

    @cached_property
    def k(self) -> int:
        """Number of parameters."""
        return len(self.parameter_names)

    def check_named(self, parameters: Points) -> None:
        """`check`, and what holds for every part: k finite positive values."""
        if parameters.shape != (self.k,):
            raise ValueError(f"{self.name} takes parameters {self.parameter_names}, got {parameters}")
        if not (np.isfinite(parameters).all() and (parameters > 0).all()):
            raise ValueError(f"{self.name}: parameters must be positive, got {self.text(parameters)}")
        self.check(parameters)

    def text(self, parameters: Points) -> str:
        """Readable parameter values in mm, for messages and tables."""
        pairs = zip(self.parameter_names, parameters, strict=True)
        return ", ".join(f"{name} = {1000 * value:g} mm" for name, value in pairs)

    def _check_grid(self, grid: Points) -> None:
        """Valid values, and shapes that don't turn inside out; all part objects at once."""
        for parameters in grid:
            self.check_named(parameters)
        for _, shape in solid(self.solid(grid)).steps:
            valid = np.broadcast_to(shape.is_valid(self.sections), len(grid))
            if not valid.all():
                raise ValueError(
                    f"{self.name}: the solid's {type(shape).__name__.lower()} vanishes or turns inside out "
                    f"with {self.text(grid[int(valid.argmin())])}"
                )

    def _grid(self, key: str, values: Grid) -> Points:
        if not isinstance(values, Mapping) or set(values) != set(self.parameter_names):
            names = sorted(values) if isinstance(values, Mapping) else values
            raise ValueError(f"part.{key} names {names}, {self.name} has {sorted(self.parameter_names)}")
        for name, column in values.items():
            numbers = isinstance(column, Sequence | np.ndarray) and all(isinstance(x, Real) for x in column)
            if not numbers or not len(column):
                raise ValueError(f"part.{key}.{name} is {column!r}, expected a list of values in mm")
        axes = [values[name] for name in reversed(self.parameter_names)]
        return np.array([combination[::-1] for combination in product(*axes)], float) / 1000


def pose_space_of_mesh(mesh: trimesh.Trimesh, symmetry: Symmetry) -> PoseSpace:
    """Benchmark constants from a surface; see `ParametricPart.pose_space`.

    Args:
        mesh: surface in the part frame, metres; a revolution's axis is z.
        symmetry: in the part frame.
    """
    area = mesh.area_faces / mesh.area
    centre = area @ mesh.triangles_center
    corners = mesh.triangles - centre
    # second moment of a triangle: (Σ a_i a_iᵀ + s sᵀ) / 12 with s = Σ a_i
    total = corners.sum(1)
    moments = np.einsum("fki,fkj->fij", corners, corners) + np.einsum("fi,fj->fij", total, total)
    covariance = np.einsum("f,fij->ij", area, moments) / 12
    threshold = 0.2 * float(np.linalg.norm(mesh.vertices - centre, axis=1).max())
    frame = np.eye(3)
    if isinstance(symmetry, FiniteSymmetry):
        values, vectors = np.linalg.eigh(covariance)
        frame = (vectors * np.sign(np.linalg.det(vectors))).T
        scale = torch.from_numpy(np.diag(np.sqrt(values)))
        turned = torch.from_numpy(frame) @ symmetry.rotations @ torch.from_numpy(frame.T)
        symmetry = FiniteSymmetry(turned)
    else:
        scale = torch.tensor(np.sqrt(covariance[0, 0] + covariance[2, 2]))
    return PoseSpace(symmetry, scale, torch.from_numpy(frame), torch.from_numpy(-frame @ centre), threshold)
