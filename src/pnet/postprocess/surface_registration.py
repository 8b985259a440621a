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
STIFFNESS = (1e-7, 1e-2)  # share of a step's normal equations that holds turn (metres²) and shift back


@dataclass(frozen=True, eq=False)
class OwnPoints:
    """Some points of every instance.

    Attributes:
        points: (d, n, 3) camera frame, metres. counted: (d, n) 1, or 0 where an instance has fewer.
        others: (d, r, 3) places where rays past the instance end; zeros where there are fewer.
        number: (d,) of the instance's points, those not counted too.
    """

    points: Tensor
    counted: Tensor
    others: Tensor
    number: Tensor

    def of(self, index: Tensor) -> "OwnPoints":
        """Those of some instances, of any of them several times."""
        return OwnPoints(self.points[index], self.counted[index], self.others[index], self.number[index])


class Sight:
    """What the camera saw around instances: rays that a wrong pose or size stands in the way of.

    Args:
        cloud: (N, 3) a scene, camera frame, metres.
    """

    def __init__(self, cloud: Tensor) -> None:
        self._cloud = torch.where(cloud.isfinite().all(1, keepdim=True), cloud, 0)

    def around(self, t: Tensor, own: Tensor, radius: float) -> Tensor:
        """Places where rays past instances end, behind or beside them.

        Args:
            t: (d, 3) places, metres. own: (d, N) points to leave out. radius: how near rays pass, metres.
        Returns:
            (d, r, 3); zeros where an instance has fewer.
        """
        ray = F.normalize(self._cloud, dim=-1)
        along = t @ ray.mT  # (d, N)
        across = t.square().sum(-1)[:, None] - along.square()
        depth = torch.linalg.vector_norm(self._cloud, dim=-1)
        near = (across < radius**2) & (depth > along - radius) & ~own
        count = near.sum(1)
        most = int(count.max()) if len(count) else 0
        order = near.int().argsort(dim=1, descending=True, stable=True)[:, :most]
        return torch.where(near.gather(1, order)[..., None], self._cloud[order], 0)


def register(
    surface: Surface, own: OwnPoints, R: Tensor, t: Tensor, slack: float, steps: int
) -> tuple[Tensor, Tensor]:
    """Gauss–Newton steps towards the least distances of own points from the surface that a pose shows.

    The distance from the plane of the nearest triangle counts, and beyond `slack` that along the plane:
    it holds points that lie past an edge.

    Args:
        surface: the part's. own: of q poses. R: (q, 3, 3), t: (q, 3) part → camera, metres.
        slack: distance along the surface that noise leaves open, metres; a point twice as far off counts
            half.
    Returns:
        R (q, 3, 3), t (q, 3).
    """
    if not steps:
        return R, t
    hold = R.new_tensor([STIFFNESS[0]] * 3 + [STIFFNESS[1]] * 3)
    for _ in range(steps):
        local, off, normal = _nearest(surface, own, R, t)
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
    share: float,
    most: float,
) -> Tensor:
    """How badly poses explain what was seen.

    Args:
        surface, own, R, t, slack: as for `register`.
        share: weight of rays that the surface stands in the way of.
        most: what lies farther off counts as so far, metres.
    Returns:
        (q,) metres: mean distance of own points from the surface that the pose shows, plus `share` times the
        depths by which the camera saw through that surface, over the number of the instance's points.
    """
    _, off, normal = _nearest(surface, own, R, t)
    height, past, _ = _split(off, normal, slack)
    distance = torch.hypot(height, past).clamp(max=most)
    points = (distance * own.counted).sum(-1) / own.counted.sum(-1).clamp(min=1)
    if share == 0:
        return points
    through = seen_through(surface, own.others, R, t, slack).clamp(max=most)
    return points + share * through.sum(-1) / own.number.clamp(min=1)


def seen_through(surface: Surface, others: Tensor, R: Tensor, t: Tensor, slack: float) -> Tensor:
    """(q, r) by how much rays to places (q, r, 3) would have gone on beyond the surface, metres."""
    corners, _, facing = _shown(surface, R, t)
    hit = first_hit((others - t[:, None]) @ R, -(t[:, None] @ R)[:, 0], corners, facing)
    length = torch.linalg.vector_norm(others, dim=-1)
    return torch.where(hit.isfinite(), (1 - hit) * length - slack, 0).clamp(min=0)


@step("rays", Kernels.NUMBA)
def first_hit(seen: Tensor, camera: Tensor, corners: Tensor, facing: Tensor) -> Tensor:
    """Where rays from the camera first meet a triangle that faces it.

    Args:
        seen: (q, r, 3) places on the rays, part frame of q poses. camera: (q, 3). corners: (f, 3, 3).
        facing: (q, f) bool.
    Returns:
        (q, r) float64 share of the way from the camera to the place, above 1 behind it; infinite where a ray
        meets none.
    """
    side, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    found = torch.full(seen.shape[:2], torch.inf, dtype=torch.float64, device=seen.device)
    for i in range(len(seen)):  # pose by pose, for memory's sake
        ray, start = (seen[i] - camera[i])[:, None], camera[i] - corners[:, 0]  # (r, 1, 3), (f, 3)
        across = torch.linalg.cross(ray.expand(-1, len(side), -1), other.expand(len(ray), -1, -1))
        det = (across * side).sum(-1)
        u = (across * start).sum(-1) / det
        turned = torch.linalg.cross(start, side)
        v = (ray * turned).sum(-1) / det
        hits = facing[i] & (det > 0) & (u >= 0) & (v >= 0) & (u + v <= 1)
        share = (turned * other).sum(-1) / det
        if len(side) and len(ray):
            found[i] = share.masked_fill(~hits, torch.inf).amin(-1)
    return found


def _nearest(surface: Surface, own: OwnPoints, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Own points (q, n, 3) in the part frame, their offsets from the nearest place of the surface that the
    pose shows, and the normals there."""
    corners, normals, facing = _shown(surface, R, t)
    local = (own.points - t[:, None]) @ R
    place, which = nearest_on_triangles(local, corners, normals, facing)
    return local, local - place, normals[which]


def _shown(surface: Surface, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Corners (f, 3, 3) and normals (f, 3) of the triangles, and which of them poses show (q, f)."""
    triangles = surface.triangles
    corners, normals = torch.from_numpy(triangles.corners), torch.from_numpy(triangles.normals)
    camera = -(t[:, None] @ R)
    return corners, normals, ((camera - corners[:, 0]) * normals).sum(-1) > 0


@step("triangles", Kernels.NUMBA)
def nearest_on_triangles(
    local: Tensor, corners: Tensor, normals: Tensor, facing: Tensor
) -> tuple[Tensor, Tensor]:
    """Of the triangles that each pose shows the place nearest to each point.

    Args:
        local: (q, n, 3) points in the part frame of q poses. corners: (f, 3, 3) metres; a triangle may have
            no area. normals: (f, 3) unit vectors, any where it has none. facing: (q, f) bool.
    Returns:
        Places (q, n, 3) and their triangles (q, n) int64; the first corner of all where a pose shows none.
    """
    place = torch.empty_like(local)
    which = torch.empty(local.shape[:2], dtype=torch.int64, device=local.device)
    for i, (points, shown) in enumerate(zip(local, facing, strict=True)):  # pose by pose, for memory's sake
        places = _on_triangles(points, corners, normals)
        square = (points[:, None] - places).square().sum(-1).masked_fill(~shown, torch.inf)
        which[i] = square.argmin(-1)
        place[i] = places[torch.arange(len(points), device=local.device), which[i]]
        if not bool(shown.any()):
            place[i] = corners[0, 0]
    return place, which


def _on_triangles(points: Tensor, corners: Tensor, normals: Tensor) -> Tensor:
    """(n, f, 3) of each triangle the place nearest to points (n, 3)."""
    start, along = corners, corners.roll(-1, 1) - corners  # the three sides
    length = along.square().sum(-1).clamp(min=1e-30)
    share = ((points[:, None, None] - start) * along).sum(-1) / length
    on_side = start + share.clamp(0, 1)[..., None] * along  # (n, f, 3 sides, 3)
    nearest = (points[:, None, None] - on_side).square().sum(-1).argmin(-1)
    on_side = on_side.gather(2, nearest[..., None, None].expand(-1, -1, 1, 3))[:, :, 0]
    height = ((points[:, None] - corners[:, 0]) * normals).sum(-1, keepdim=True)
    foot = points[:, None] - height * normals
    inward = torch.linalg.cross(normals[:, None].expand_as(along), along)
    inside = (((foot[:, :, None] - start) * inward).sum(-1) > 0).all(-1)
    return torch.where(inside[..., None], foot, on_side)


def _split(off: Tensor, normal: Tensor, slack: float) -> tuple[Tensor, Tensor, Tensor]:
    """Offsets (..., 3) from the nearest place: height over its plane, length along it beyond the slack, and
    the unit vectors of the latter."""
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
