"""Many poses of one part at once, registered onto points of its surface and judged by the whole cloud.

A pose is wrong not only where its points lie off the surface: also where it puts surface in front of what
the camera saw farther away. Points alone cannot tell that a face is too large.
"""

from dataclasses import dataclass

import roma
import torch
from torch import Tensor
from torch.nn import functional as F

from pnet.postprocess.kernels import Kernels, step
from pnet.postprocess.surface import Surface

TURN = 0.3  # radians, the largest of a step
MOST_CELLS = 2000  # a side of the table of depths
STIFFNESS = (1e-7, 1e-2)  # share of a step's normal equations that holds turn (metres²) and shift back


@dataclass(frozen=True, eq=False)
class OwnPoints:
    """Some points of every instance.

    Attributes:
        points: (d, n, 3) camera frame, metres. counted: (d, n) 1, or 0 where an instance has fewer.
    """

    points: Tensor
    counted: Tensor

    def of(self, index: Tensor) -> "OwnPoints":
        """Those of some instances, of any of them several times."""
        return OwnPoints(self.points[index], self.counted[index])


class FreeSpace:
    """How far the camera saw, in every direction.

    Args:
        cloud: (N, 3) camera frame, metres. slack: of the depth, metres.
    """

    def __init__(self, cloud: Tensor, slack: float) -> None:
        cloud = cloud[cloud.isfinite().all(1) & (cloud[:, 2] > 0)]
        direction = cloud[:, :2] / cloud[:, 2:]
        self._slack = slack
        self._low, extent = torch.zeros(2, dtype=cloud.dtype), torch.zeros(2, dtype=cloud.dtype)
        if len(cloud):
            self._low = direction.amin(0)
            extent = direction.amax(0) - self._low
        # a stray point far outside makes the cells coarse, not the table large
        self._cell = max(_spacing(direction), float(extent.max()) / MOST_CELLS)
        place = self._place(direction)
        columns, rows = ((extent / self._cell).floor().long() + 3).tolist()
        self._size = torch.tensor([columns, rows])
        nearest = torch.full((rows * columns,), torch.inf, dtype=cloud.dtype)
        nearest.scatter_reduce_(0, place[:, 1] * columns + place[:, 0], cloud[:, 2], "amin")
        # the nearest of all around: what lies beside an edge must not count as seen through
        around = F.max_pool2d(-nearest.view(1, rows, columns), 3, 1, 1)
        self._depth = -around.flatten()

    def through(self, places: Tensor) -> Tensor:
        """By how much the camera saw past places (..., 3), metres; 0 where it saw nothing."""
        place = self._place(places[..., :2] / places[..., 2:])
        inside = ((place >= 0) & (place < self._size)).all(-1)
        column, row = torch.where(inside[..., None], place, 0).unbind(-1)
        depth = self._depth[row * self._size[0] + column]
        seen = inside & depth.isfinite() & (places[..., 2] > 0)
        return torch.where(seen, depth - places[..., 2] - self._slack, 0.0).clamp(min=0)

    def _place(self, direction: Tensor) -> Tensor:
        """Column and row of directions (..., 2); a border of one cell is left free."""
        return ((direction - self._low) / self._cell).floor().long() + 1


def register(
    surface: Surface, own: OwnPoints, R: Tensor, t: Tensor, slack: float, steps: int
) -> tuple[Tensor, Tensor]:
    """Gauss–Newton steps towards the least distances of own points from the surface that a pose shows.

    The distance from the tangent plane of the nearest sample counts, and beyond `slack` that along the plane:
    it holds points that lie past an edge.

    Args:
        surface: n samples. own: of q poses. R: (q, 3, 3), t: (q, 3) part → camera, metres.
        slack: distance along the surface that samples and points leave open, metres; a point twice as far
            off counts half.
    Returns:
        R (q, 3, 3), t (q, 3).
    """
    hold = R.new_tensor([STIFFNESS[0]] * 3 + [STIFFNESS[1]] * 3)
    for _ in range(steps):
        local, off, normal, _ = _nearest(surface, own, R, t)
        weight = own.counted / (1 + off.square().sum(-1) / (2 * slack) ** 2)
        height, past, towards = _split(off, normal, slack)
        A, b = _normal_equations(local, normal, height, weight)
        A_past, b_past = _normal_equations(local, towards, past, 0.5 * weight * (past > 0))
        total = weight.sum(-1)[:, None] + 1
        move = torch.linalg.solve(A + A_past + torch.diag_embed(total * hold), -(b + b_past))
        angle = torch.linalg.vector_norm(move[:, :3], dim=-1, keepdim=True)
        move = move * (TURN / angle.clamp(min=TURN))
        # x in the part frame goes to dR x + dt, so the pose to (R dRᵀ, t − R dRᵀ dt)
        R = R @ roma.rotvec_to_rotmat(move[:, :3]).mT
        t = t - (R @ move[:, 3:, None])[..., 0]
    return roma.special_procrustes(R), t


def misfit(
    surface: Surface,
    own: OwnPoints,
    R: Tensor,
    t: Tensor,
    slack: float,
    free: FreeSpace,
    share: float,
    most: float,
) -> Tensor:
    """How badly poses explain what was seen.

    Args:
        surface, own, R, t, slack: as for `register`. share: weight of surface in free space.
        most: what lies farther off counts as so far, metres.
    Returns:
        (q,) metres: mean distance of own points from the surface that the pose shows, plus `share` times the
        mean depth by which the camera saw through that surface.
    """
    _, off, normal, facing = _nearest(surface, own, R, t)
    height, past, _ = _split(off, normal, slack)
    distance = torch.hypot(height, past).clamp(max=most)
    points = (distance * own.counted).sum(-1) / own.counted.sum(-1).clamp(min=1)
    places = torch.from_numpy(surface.points) @ R.mT + t[:, None]
    through = free.through(places).clamp(max=most)
    return points + share * (through * facing).sum(-1) / facing.sum(-1).clamp(min=1)


def _nearest(surface: Surface, own: OwnPoints, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Own points (q, n, 3) in the part frame, their offsets from the nearest sample that the pose shows,
    the normals there, and which samples it shows (q, s)."""
    samples, normals = torch.from_numpy(surface.points), torch.from_numpy(surface.normals)
    local = (own.points - t[:, None]) @ R
    camera = -(t[:, None] @ R)
    facing = ((camera - samples) * normals).sum(-1) > 0
    nearest = nearest_samples(local, samples, facing)
    return local, local - samples[nearest], normals[nearest], facing


@step("samples", Kernels.NUMBA)
def nearest_samples(local: Tensor, samples: Tensor, facing: Tensor) -> Tensor:
    """Of the samples that each pose shows the one nearest to each point.

    Args:
        local: (q, n, 3) points in the part frame of q poses. samples: (s, 3), metres. facing: (q, s) bool.
    Returns:
        (q, n) int64; 0 where a pose shows none.
    """
    # ‖x − s‖² less ‖x‖², which is the same for all
    square = samples.square().sum(-1) - 2 * local @ samples.mT
    return square.masked_fill(~facing[:, None], torch.inf).argmin(-1)


def _split(off: Tensor, normal: Tensor, slack: float) -> tuple[Tensor, Tensor, Tensor]:
    """Offsets (..., 3) from a sample: height over its plane, length along it beyond the slack, and the unit
    vectors of the latter."""
    height = (off * normal).sum(-1)
    along = off - height[..., None] * normal
    length = torch.linalg.vector_norm(along, dim=-1)
    return height, (length - slack).clamp(min=0), along / length.clamp(min=1e-9)[..., None]


def _normal_equations(
    local: Tensor, direction: Tensor, length: Tensor, weight: Tensor
) -> tuple[Tensor, Tensor]:
    """JᵀWJ (q, 6, 6) and JᵀWr (q, 6) of lengths r (q, n) along directions (q, n, 3) at places (q, n, 3)."""
    J = torch.cat([torch.linalg.cross(local, direction), direction], -1)
    weighted = (J * weight[..., None]).mT
    return weighted @ J, (weighted @ length[..., None])[..., 0]


def _spacing(direction: Tensor) -> float:
    """A little more than the distance of neighbouring directions (N, 2)."""
    if not len(direction):
        return 1.0
    some = direction[:: max(len(direction) // 256, 1)]
    between = torch.cdist(some, direction, compute_mode="donot_use_mm_for_euclid_dist")
    own = between.masked_fill(between <= 0, torch.inf).amin(1)
    own = own[own.isfinite()]
    return max(1.25 * float(own.median()), 1e-6) if len(own) else 1.0
