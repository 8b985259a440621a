"""Poses and sizes of a scene fitted to its cloud, together.

Votes say where keypoints are, not what was seen. Here the surface of the template itself is laid onto each
instance's points, in the pose that was voted and in those that look much like it; and as all instances of a
scene are one part object, the size under which all of them together explain the cloud best is theirs.

Parts that look alike from most sides differ by fractions of a millimetre: so distances are from the
triangles themselves, and every ray counts that a pose stands in the way of.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import permutations, product

import numpy as np
import torch
from torch import Tensor

from pnet.geometry.rigid import rotation_angle
from pnet.geometry.symmetry import nearest_equivalent
from pnet.parts.base import ParametricPart
from pnet.postprocess.grouping import clusters_of
from pnet.postprocess.surface import Surface, sample_surface
from pnet.postprocess.surface_registration import OwnPoints, Sight, misfit, register
from pnet.records import Detections

COARSE = 0.001  # metres: distances that count in full while a pose may still be far off
ROUNDS = 3  # each parameter is tried up and down at most so often with one step
FEW = 2  # steps of a registration for another size
WIDE = 0.001  # metres: after sizes have changed in steps of this, other poses are tried again
SAME = 0.1  # radians between rotations that count as one
WIDER = 1.4  # reach of rays that are looked at, as a share of the part's radius of which it was voted
OTHER = 0.35  # radians between poses that cannot both be right
Size = tuple[float, ...]


@dataclass(frozen=True)
class SurfaceFit:
    """Registers each instance onto the template's surface and finds the size that fits all of them.

    Nothing is asked of the network but instances near their place: the sizes may be some millimetres off,
    and the pose one of those that are hard to tell apart. Where a method says no size the search starts in
    the middle of the part's learning grid.

    Attributes:
        samples: of the part's surface, where its mesh is too fine. points: the most points of an instance
            that are laid onto it. steps: of a registration.
        reach: what is farther off the surface counts as so far, metres.
        slack: distances along the surface and the rays that noise leaves open, metres.
        free: weight of a ray that a pose stands in the way of, to a point's.
        alike: turns by quarters about the part's axes are tried too where the surface comes to lie on itself
            to within this share of its radius; 0: none.
        sizes: steps by which parameters are changed, metres, in turn, multiples of the last; none: they stay.
        shared: whether the instances of a scene are one part object; false: each has its own size.
        hold: misfit that a change of the sizes must save, a metre of change.
        larger: misfit that a larger size must save besides, a metre: an end that nobody sees may be
            anywhere behind what is seen, and is likely not far. Below the grids' smallest nothing is saved.
        doubtful: misfit by which the score falls by a factor of e, metres; None: it stays.
        ambiguous: where another of the turned poses explains an instance nearly as well the score falls too:
            a pose counts less by a factor of e for so much misfit more, metres; None: it does not fall.
    """

    samples: int
    points: int
    steps: int
    reach: float
    slack: float
    free: float
    alike: float
    sizes: Sequence[float]
    shared: bool
    hold: float
    larger: float
    doubtful: float | None
    ambiguous: float | None

    def __post_init__(self) -> None:
        for name in ("samples", "points", "steps", "reach", "slack", "doubtful", "ambiguous"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"postprocess.refine.{name} is {value}, expected a positive number")
        for name in ("free", "alike", "hold", "larger"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"postprocess.refine.{name} is {getattr(self, name)}, expected 0 or more")
        steps = list(self.sizes or ())
        if any(not step > 0 for step in steps) or steps != sorted(steps, reverse=True):
            raise ValueError(
                f"postprocess.refine.sizes is {steps}, expected positive steps in metres, the finest last, "
                "or []"
            )

    def refined(
        self, part: ParametricPart, found: Detections, points: Tensor, scenes: Sequence[int]
    ) -> Detections:
        """See `Refinement`; poses, sizes and scores are new. Instances of negative score stay."""
        if not len(found.R):
            return found
        clusters = clusters_of(found.instance)
        cloud = points.detach().cpu().double()
        member, valid = clusters.groups.first(self.points)
        own_points = clusters.of(cloud)[member]
        valid = valid & own_points.isfinite().all(-1)
        own_points, counted = own_points.nan_to_num(0, 0, 0), valid.double()
        given = found.R, found.t, found.parameters, found.score
        R, t, sizes, score = (x.detach().double().clone() for x in given)
        end = torch.tensor([0, *scenes]).cumsum(0).tolist()
        for i, seen in enumerate(cloud):
            these = torch.arange(end[i], end[i + 1])
            these = these[score[these] >= 0]
            if not len(these):
                continue
            sight = Sight(seen)
            said = sizes[these][sizes[these].isfinite().all(1)]
            together = self.shared and (bool(self.sizes) or bool((said == said[:1]).all()))
            for some in (these,) if together else these.split(1):
                mine = found.instance[i].cpu() == some[:, None]
                own = OwnPoints(own_points[some], counted[some], own_points[some, :0], mine.sum(1).double())
                fit = _Fit(self, part, own, score[some], partial(sight.around, t[some], mine))
                R[some], t[some], sizes[some], score[some] = fit(R[some], t[some], sizes[some])
        return replace(found, R=R, t=t, parameters=sizes, score=score)


@dataclass(frozen=True, eq=False)
class _Poses:
    """R (d, 3, 3), t (d, 3) part → camera, and how badly each explains the cloud, off (d,); metres."""

    R: Tensor
    t: Tensor
    off: Tensor


class _Fit:
    """Some instances of one part object.

    Args:
        own: their d points each. score: (d,) how much each of them counts for the size.
        rays: the others (d, r, 3) that pass them at most so far away, metres.
    """

    def __init__(
        self,
        settings: SurfaceFit,
        part: ParametricPart,
        own: OwnPoints,
        score: Tensor,
        rays: Callable[[float], Tensor],
    ) -> None:
        self._set, self._part, self._own, self._score, self._rays = settings, part, own, score, rays
        trust = score + 1e-6
        self._weight = trust / trust.sum()
        only = part.only_size
        self._only: Size | None = None if only is None else tuple(only.tolist())
        self._smallest = np.min([grid.min(0) for grid in part.grids.values()], axis=0)
        self._steps = () if self._only or part.is_fixed else tuple(settings.sizes)
        self._reach = self._far = max(settings.reach, self._allowed(self._steps[:1]))

    def __call__(self, R: Tensor, t: Tensor, sizes: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Poses R (d, 3, 3), t (d, 3), sizes (d, k) and score (d,); as they were where they make no part."""
        size = self._said = self._start(sizes)
        surface = self._surface(size)
        if surface is None:
            return R, t, sizes, self._fallen(torch.tensor(self._set.reach, dtype=torch.float64))
        radius = WIDER * float(np.linalg.norm(surface.points, axis=1).max())
        self._own = replace(self._own, others=self._rays(radius))
        turns = similar_turns(self._part, self._set.alike)
        best = self._best_of(turns, surface, R, t)
        usual = float(best.off.median())
        for step in self._steps:
            self._reach = max(self._set.reach, self._allowed([step]))
            self._far = max(self._reach, usual)
            best = self._judged(self._known(size), best.R, best.t)
            size, best = self._search(size, best, step)
            if step >= WIDE:
                again = self._best_of(turns, self._known(size), best.R, best.t)
                best = min(best, again, key=lambda poses: self._total(size, poses))
        size = self._between(size, best)
        self._reach = self._set.reach
        every = self._turned(turns, self._known(size), best.R, best.t)
        best = self._least(every)
        score = self._fallen(best.off)
        if self._set.ambiguous is not None:
            score = score * self._share(every, best, self._set.ambiguous)
        said = sizes.isfinite().all(1, keepdim=True)
        found = torch.tensor(size, dtype=torch.float64)
        if self._steps or self._only:
            sizes = found.expand_as(sizes)
        elif bool(said.any()):  # else nobody has said or sought a size
            sizes = torch.where(said, sizes, found)
        return best.R, best.t, sizes, score

    @staticmethod
    def _allowed(steps: Sequence[float]) -> float:
        """Distance up to which it counts how far off a point is: what sizes that are off by a step can do."""
        return 2 * max(steps, default=0.0)

    def _fallen(self, off: Tensor) -> Tensor:
        """(d,) the score under so much misfit (d,) or ()."""
        doubtful = self._set.doubtful
        return self._score if doubtful is None else self._score * torch.exp(-off / doubtful)

    def _start(self, sizes: Tensor) -> Size:
        """The median of what was said (d, k), on a lattice, so that scenes share their surfaces."""
        if self._only:
            return self._only
        known, middle = sizes[sizes.isfinite().all(1)], tuple(self._part.grids["L"].mean(0).tolist())
        exact: Size = tuple(known.median(0).values.tolist()) if len(known) else middle
        for said in (exact, middle):
            near = _rounded(np.array(said), self._steps[-1]) if self._steps else said
            for size in (near, said):
                if self._surface(size) is not None:
                    return size
        return exact

    def _search(self, size: Size, best: _Poses, step: float) -> tuple[Size, _Poses]:
        """One parameter after the other up or down by a step, as long as that explains the cloud better."""
        for _ in range(ROUNDS):
            before = size
            for i, sign in product(range(self._part.k), (1, -1)):
                tried = self._changed(size, i, sign * step)
                poses = self._moved(tried, best)
                if poses is not None and self._total(tried, poses) < self._total(size, best):
                    size, best = tried, poses
            if size == before:
                break
        return size, best

    def _between(self, size: Size, best: _Poses) -> Size:
        """The lowest point of a parabola through each parameter's neighbours on the lattice."""
        if not self._steps:
            return size
        step, exact = self._steps[-1], list(size)
        middle = self._total(size, best)
        for i in range(len(size)):
            sides = [self._changed(size, i, sign * step) for sign in (1, -1)]
            poses = [self._moved(tried, best) for tried in sides]
            up, down = (
                math.inf if one is None else self._total(tried, one)
                for tried, one in zip(sides, poses, strict=True)
            )
            bend = up + down - 2 * middle
            if 0 < bend < math.inf:  # beside a size that makes no part there is no parabola
                exact[i] += float(np.clip(step * (down - up) / (2 * bend), -step / 2, step / 2))
        return tuple(exact) if self._surface(tuple(exact)) is not None else size

    def _changed(self, size: Size, parameter: int, by: float) -> Size:
        changed = np.array(size)
        changed[parameter] += by
        return _rounded(changed, self._steps[-1])

    def _total(self, size: Size, poses: _Poses) -> float:
        """What all instances together make of a size, metres."""
        change = float(np.abs(np.subtract(size, self._said)).mean())
        # one that is farther off than most were is somewhere else: it says nothing of the size
        off = float((self._weight * poses.off.clamp(max=self._far)).sum())
        # what no instance shows would else shrink to nothing
        extent = float(np.maximum(size, self._smallest).mean())
        return off + self._set.hold * change + self._set.larger * extent

    def _moved(self, size: Size, poses: _Poses) -> _Poses | None:
        """The poses registered again under another size; None where that makes no part."""
        surface = self._surface(size)
        return None if surface is None else self._registered(surface, poses.R, poses.t, FEW)

    def _best_of(self, turns: Tensor, surface: Surface, R: Tensor, t: Tensor) -> _Poses:
        return self._least(self._turned(turns, surface, R, t))

    def _turned(self, turns: Tensor, surface: Surface, R: Tensor, t: Tensor) -> _Poses:
        """(d · q) poses: each instance's, turned by every one of (q, 3, 3) and registered."""
        d, q = len(R), len(turns)
        turned = (R[:, None] @ turns).flatten(0, 1)
        own = self._own.of(torch.arange(d).repeat_interleave(q))
        return self._registered(surface, turned, t.repeat_interleave(q, 0), self._set.steps, own)

    def _least(self, every: _Poses) -> _Poses:
        """Of each instance's poses that which explains the cloud best."""
        d = len(self._score)
        best = every.off.view(d, -1).argmin(1) + torch.arange(0, len(every.off), len(every.off) // d)
        return _Poses(every.R[best], every.t[best], every.off[best])

    def _share(self, every: _Poses, best: _Poses, scale: float) -> Tensor:
        """(d,) the best pose's part of a whole that it shares with those that differ from it.

        A pose counts less by a factor of e for every `scale` of misfit more.
        """
        d = len(self._score)
        R = best.R.repeat_interleave(len(every.off) // d, 0)
        others = rotation_angle(nearest_equivalent(every.R, R, self._part.symmetry), R) > OTHER
        more = every.off.view(d, -1) - best.off[:, None]
        return 1 / (1 + (torch.exp(-more / scale) * others.view(d, -1)).sum(1))

    def _registered(
        self, surface: Surface, R: Tensor, t: Tensor, steps: int, own: OwnPoints | None = None
    ) -> _Poses:
        own, slack = self._own if own is None else own, self._set.slack
        far = steps // 2 if steps > FEW else 0
        R, t = register(surface, own, R, t, max(slack, COARSE), far)
        R, t = register(surface, own, R, t, slack, steps - far)
        return self._judged(surface, R, t, own)

    def _judged(self, surface: Surface, R: Tensor, t: Tensor, own: OwnPoints | None = None) -> _Poses:
        own, settings = self._own if own is None else own, self._set
        return _Poses(R, t, misfit(surface, own, R, t, settings.slack, settings.free, self._reach))

    def _surface(self, size: Size) -> Surface | None:
        return sample_surface(self._part, size, self._set.samples)

    def _known(self, size: Size) -> Surface:
        surface = self._surface(size)
        assert surface is not None
        return surface


@lru_cache(maxsize=64)
def similar_turns(part: ParametricPart, alike: float) -> Tensor:
    """Turns by quarters after which a part looks much as before, none of them twice for its symmetry.

    Args:
        alike: largest mean distance of the turned surface from itself, as a share of its radius about the
            centroid, for a part object of middle size.
    Returns:
        (q, 3, 3) rotations of the part frame, float64; the first turns nothing.
    """
    kept = [torch.eye(3, dtype=torch.float64)]
    surface = sample_surface(part, tuple(part.grids["L"].mean(0).tolist()), 500)
    if surface is None or alike <= 0:
        return torch.stack(kept)
    points = torch.from_numpy(surface.points)
    radius = float(torch.linalg.vector_norm(points, dim=-1).max())
    for turn in _quarter_turns():
        distance = float(torch.cdist(points @ turn.mT, points).amin(1).mean())
        known = [rotation_angle(nearest_equivalent(turn, other, part.symmetry), other) for other in kept]
        if distance <= alike * radius and min(map(float, known)) > SAME:
            kept.append(turn)
    return torch.stack(kept)


def _quarter_turns() -> list[Tensor]:
    """The 24 rotations that carry a cube onto itself."""
    signed = [
        torch.eye(3, dtype=torch.float64)[list(order)] * torch.tensor(signs, dtype=torch.float64)[:, None]
        for order, signs in product(permutations(range(3)), product((1, -1), repeat=3))
    ]
    return [matrix for matrix in signed if float(torch.linalg.det(matrix)) > 0]


def _rounded(size: np.ndarray, step: float) -> Size:
    """To multiples of the step; twelve digits, so that equal sizes are equal numbers."""
    return tuple(round(round(x / step) * step, 12) for x in size.tolist())
