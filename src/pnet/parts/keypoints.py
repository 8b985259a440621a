"""Keypoints from parameters and back, from one declaration (Section II.A of the paper)."""

from collections.abc import Callable, Sequence
from copy import copy
from functools import partial
from itertools import chain, product

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pnet.geometry.constants import converted
from pnet.geometry.symmetry import Symmetry, full_group
from pnet.parts.choice import (
    Judge,
    KeypointChoice,
    KeypointRule,
    NearestToCamera,
    NearestToPoint,
    first_by,
)
from pnet.parts.declaration import check_circles, check_declaration
from pnet.parts.equivalents import allowed, along_and_radial, distinct_images, images_of
from pnet.parts.expressions import Expression, length
from pnet.parts.primitives import Corner, Freedom, Plane
from pnet.parts.selection import CENTROID, Keypoint, select_keypoints

Points = NDArray[np.float64]


Exchange = tuple[tuple[str, str], ...]  # pairs of keypoints that change places


class KeypointChain:
    """A part's keypoints, each hanging on the centroid or on an earlier one.

    For finitely many equivalents, the label keypoints of an instance are one symmetry element's image of the
    template's, so a choice made for one keypoint binds those that hang beside it; a keypoint that is free on
    a circle or sphere is chosen by itself.

    Args:
        keypoints: the declaration. parameters: the part's parameter names.
        symmetry, mirror: the part's; see `full_group`.
        centroid: parameters (n, k) → (n, 3) the centroid in the frame of construction, metres; None: its
            origin.
        typical: (n, k) parameters of part objects, metres; they tell which symmetry elements move a
            keypoint, and stand in where estimated sizes make no solid.
        lookalikes: exchanges of keypoints, for a part that looks much the same in several poses that no
            symmetry relates, as a slightly tapered bar does end for end. A network can hardly tell which
            end is which, but it can tell where the nearer one is: under the rule `point` every point is
            taught the exchanged keypoints of which the first lies nearest to it, and what was exchanged
            follows from the distances between the voted keypoints. Any two of them, one after the other,
            make a third.

    Attributes:
        reference: (m) place of each keypoint's reference among centroid, keypoint 0, keypoint 1, …
        group: (g, 3, 3) the part's symmetry elements, reflections too.
        is_finite: (m) whether each keypoint and its references have finitely many equivalents.
        chiralities: one or two (3, 3) matrices: the finite label keypoints are always a rotated image of the
            template's seen through one of them ("two chirality structures at most", Section II.B).
        lookalikes: (q, m) int64, for every exchange which keypoint stands at each place; the first exchanges
            nothing.
    """

    def __init__(
        self,
        keypoints: Sequence[Keypoint],
        parameters: Sequence[str],
        symmetry: Symmetry,
        mirror: Tensor | None = None,
        centroid: Callable[[Points], Points] | None = None,
        typical: Points | None = None,
        lookalikes: Sequence[Exchange] = (),
    ) -> None:
        self.parameters = tuple(parameters)
        self.keypoints = select_keypoints(keypoints, self.parameters)
        self.group = full_group(symmetry, mirror)
        self._centroid = centroid
        known = [CENTROID, *self.names]
        self.reference = [known.index(keypoint.reference) for keypoint in self.keypoints]
        sizes = np.linspace(1.0, 1.3, len(self.parameters)) if typical is None else typical
        self._typical = np.atleast_2d(sizes)
        self.is_finite = self._find_finite()
        some = self._typical[[0, len(self._typical) // 2, -1]]  # a place may be special for one size
        templates = self.keypoints_from_parameters(torch.from_numpy(some))
        check_declaration(self, symmetry, templates[0])
        self._equivalents = [
            distinct_images(keypoint.primitive, steps, self.group)
            for keypoint, steps in zip(self.keypoints, self.steps(templates).unbind(-2), strict=True)
        ]
        self.chiralities = self._find_chiralities(templates[0], mirror)
        check_circles(self)
        self.lookalikes = self._permutations(lookalikes)

    def __len__(self) -> int:
        """m, the number of keypoints."""
        return len(self.keypoints)

    @property
    def names(self) -> list[str]:
        """The keypoints' names in order."""
        return [keypoint.name for keypoint in self.keypoints]

    def moves(self, element: int, keypoint: int) -> bool:
        """Whether a symmetry element moves a keypoint, or its circle, as seen from its reference."""
        return int(self._equivalents[keypoint][1][element]) != int(self._equivalents[keypoint][1][0])

    def equivalents(self, keypoint: int) -> int:
        """How many places symmetry elements that keep the reference in place carry a keypoint to."""
        images, member = self._equivalents[keypoint]
        kept = torch.ones(len(self.group), dtype=torch.bool)
        reference = self.reference[keypoint]
        while reference:
            kept &= self._equivalents[reference - 1][1] == 0
            reference = self.reference[reference - 1]
        return len(torch.unique(member[kept])) if len(images) > 1 else 1

    def keypoints_from_parameters(self, parameters: Tensor) -> Tensor:
        """The template's keypoints, in the part frame with the centroid at the origin.

        Args:
            parameters: (..., k) metres.
        Returns:
            (..., m, 3) metres.
        """
        places = [torch.zeros_like(parameters[..., :1]).expand(*parameters.shape[:-1], 3)]
        for keypoint, reference in zip(self.keypoints, self.reference, strict=True):
            start, direction = places[reference], converted(keypoint.primitive.direction, parameters)
            match keypoint:
                case Keypoint(parameter=str() as name, factor=factor):
                    distance = factor * parameters[..., self.parameters.index(name)]
                    places.append(start + distance[..., None] * direction)
                case Keypoint(primitive=Plane(at=at)) if at is not None:
                    distance = self._length(at, parameters) - (start + self._origin(parameters)) @ direction
                    places.append(start + distance[..., None] * direction)
                case Keypoint(primitive=Corner(at=at)):
                    corner = torch.stack([self._length(x, parameters) for x in at], -1)
                    places.append(corner - self._origin(parameters))
        return torch.stack(places[1:], -2)

    def select(self, choice: KeypointChoice, parameters: Tensor, R: Tensor) -> tuple[Tensor, Tensor]:
        """The label keypoints of instances under the camera or the canonical rule.

        Args:
            choice: the rule. parameters: (..., k) metres. R: (..., 3, 3) part → camera.
        Returns:
            keypoints (..., m, 3) part frame, and margin (..., m), metres; see `choose`.
        """
        template = self.keypoints_from_parameters(parameters)
        match choice.rule:
            case KeypointRule.CAMERA:
                return self.choose(NearestToCamera(choice.frame.to(R) @ R), template)
            case KeypointRule.CANONICAL:
                return template, torch.full_like(template[..., 0], torch.inf)
        raise ValueError(
            "the rule 'point' needs surface points: use choose(NearestToPoint(points), template)"
        )

    def choose(self, judge: Judge, template: Tensor) -> tuple[Tensor, Tensor]:
        """Of all equivalents those that a rule prefers, keypoint by keypoint along the chain.

        Args:
            judge: the rule, with what it compares by; leading dimensions (...).
            template: (..., m, 3) canonical keypoints, part frame, metres.
        Returns:
            keypoints (..., m, 3) metres, part frame; margin (..., m) metres: how much worse the runner-up is,
            for this keypoint, one that it hangs on, or one whose choice binds it. On a circle or sphere
            runners-up are arbitrarily near: half the cost's range over it stands for the margin.
        """
        zero = torch.zeros_like(template[..., 0, :])
        chosen, margins = [zero], [torch.full_like(zero[..., 0], torch.inf)]
        alive: Tensor | None = None  # (..., g) the symmetry elements that agree with the choices so far
        narrowed = margins[0]  # (...) the smallest lead of the choices that left only those
        for i, step in enumerate(self.steps(template).unbind(-2)):
            images, member = self._equivalents[i]
            places, margin = self._candidates(i, judge, chosen[self.reference[i]], step)
            if len(images) == 1:
                place, margin = places[..., 0, :], margin[..., 0]
            else:
                member = member.to(places.device)
                may = allowed(alive, member, places[..., 0])
                index, lead = first_by(judge.keys(places), may)
                agree = member == index[..., None]
                alive = agree if alive is None else alive & agree
                place = places.gather(-2, index[..., None, None].expand(*index.shape, 1, 3))[..., 0, :]
                margin = torch.minimum(lead, margin.gather(-1, index[..., None])[..., 0])
                # what an earlier choice has ruled out would come back if that choice had been another
                margin = torch.where(may.all(-1), margin, torch.minimum(margin, narrowed))
                narrowed = torch.minimum(narrowed, lead)
            chosen.append(place)
            margins.append(torch.minimum(margin, margins[self.reference[i]]))
        return torch.stack(chosen[1:], -2), torch.stack(margins[1:], -1)

    def nearest(self, points: Tensor, template: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The label keypoints of surface points under the rule `point`.

        Args:
            points: (..., 3), template: (..., m, 3) canonical keypoints, part frame, metres.
        Returns:
            keypoints (..., m, 3) and margin (..., m) as `choose` has them, then exchanged; and which of the
            `lookalikes` (...) int64.
        """
        keypoints, margin = self.choose(NearestToPoint(points), template)
        if len(self.lookalikes) == 1:
            return keypoints, margin, torch.zeros_like(margin[..., 0], dtype=torch.int64)
        first = self.lookalikes[:, 0].to(points.device)
        distance = torch.linalg.vector_norm(keypoints[..., first, :] - points[..., None, :], dim=-1)
        which, lead = first_by([distance], torch.ones_like(distance, dtype=torch.bool))
        order = self.lookalikes.to(points.device)
        moved = (order != order[0]).any(0)
        margin = margin.gather(-1, order[which])
        margin = torch.where(moved, torch.minimum(margin, lead[..., None]), margin)
        return self.exchanged(keypoints, which), margin, which

    def without_lookalikes(self) -> "KeypointChain":
        """The same keypoints, of which none are exchanged."""
        plain = copy(self)
        plain.lookalikes = self.lookalikes[:1]
        return plain

    def exchanged(self, values: Tensor, which: Tensor) -> Tensor:
        """What is said of the keypoints (..., m, c), exchanged by one of the lookalikes (...); twice is
        undone."""
        if len(self.lookalikes) == 1:
            return values
        order = converted(self.lookalikes, which)[which]
        return values.gather(-2, order[..., None].expand(*order.shape, values.shape[-1]))

    def parameters_from_keypoints(self, centroid: Tensor, keypoints: Tensor) -> Tensor:
        """Parameters measured between keypoints (the module M_P).

        Args:
            centroid: (..., 3), keypoints: (..., m, 3) metres, any common frame.
        Returns:
            (..., k) metres; a parameter that several keypoints measure is their mean.
        """
        lengths = torch.linalg.vector_norm(self.steps(keypoints, centroid), dim=-1).unbind(-1)
        columns = []
        for name in self.parameters:
            measured = [
                length / keypoint.factor
                for length, keypoint in zip(lengths, self.keypoints, strict=True)
                if keypoint.parameter == name
            ]
            columns.append(torch.stack(measured, -1).mean(-1))
        return torch.stack(columns, -1)

    def steps(self, keypoints: Tensor, centroid: Tensor | None = None) -> Tensor:
        """From each keypoint's reference to it, (..., m, 3); centroid (..., 3), None: the origin."""
        places = [torch.zeros_like(keypoints[..., 0, :]) if centroid is None else centroid]
        places += keypoints.unbind(-2)  # not by a list of indices: that would wait for the device
        return keypoints - torch.stack([places[i] for i in self.reference], -2)

    def place_like(self, template: Tensor, observed: Tensor) -> Tensor:
        """Template keypoints with the free ones (on circles and spheres) where an observation has them.

        A finite choice is undone by the part's symmetry, so the template's own stands for it; a free
        keypoint's place on its circle is known only from the observation.

        Args:
            template: (..., m, 3) canonical keypoints, part frame, metres; broadcast against the observed.
            observed: (..., m, 3) observed keypoints carried into the part frame, metres.
        Returns:
            (..., m, 3) metres, part frame.
        """
        places = [torch.zeros_like(template[..., 0, :])]
        seen = self.steps(observed).unbind(-2)
        for i, (keypoint, step) in enumerate(
            zip(self.keypoints, self.steps(template).unbind(-2), strict=True)
        ):
            if keypoint.primitive.freedom is not Freedom.NONE:
                along, radial = along_and_radial(keypoint.primitive, step)
                towards = along_and_radial(keypoint.primitive, seen[i])[1]
                length = torch.linalg.vector_norm(towards, dim=-1, keepdim=True)
                radius = torch.linalg.vector_norm(radial, dim=-1, keepdim=True)
                turned = radius * towards / length.clamp(min=1e-12)
                step = along + torch.where(length > 1e-9, turned, radial)
            places.append(places[self.reference[i]] + step)
        return torch.stack(torch.broadcast_tensors(*places[1:], observed[..., 0, :])[:-1], -2)

    def turn_back(self, keypoints: Tensor) -> Tensor:
        """Keypoints with the free ones turned to the template's place on their circle or sphere.

        What is left after it differs between votes by their errors only.

        Args:
            keypoints: (..., m, 3) part frame, metres, any distances.
        Returns:
            (..., m, 3).
        """
        places = [torch.zeros_like(keypoints[..., 0, :])]
        for i, (keypoint, step) in enumerate(
            zip(self.keypoints, self.steps(keypoints).unbind(-2), strict=True)
        ):
            along, radial = along_and_radial(keypoint.primitive, step)
            if keypoint.primitive.freedom is not Freedom.NONE:
                direction = converted(keypoint.primitive.direction, step)
                template = along_and_radial(keypoint.primitive, direction)[1]
                length = torch.linalg.vector_norm(radial, dim=-1, keepdim=True)
                radial = length * torch.nn.functional.normalize(template, dim=-1)
            places.append(places[self.reference[i]] + along + radial)
        return torch.stack(places[1:], -2)

    def _candidates(self, i: int, judge: Judge, start: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
        """Equivalents of keypoint i from its chosen reference: places (..., q, 3), and margins (..., q)."""
        primitive, images = self.keypoints[i].primitive, self._equivalents[i][0].to(step)
        along, radial = along_and_radial(primitive, step)
        radius = torch.linalg.vector_norm(radial, dim=-1)[..., None]
        centre = start[..., None, :] + images_of(along, images)
        match primitive.freedom:
            case Freedom.NONE:
                return centre, torch.full_like(centre[..., 0], torch.inf)
            case Freedom.TURN:
                normal = images @ primitive.axis.to(step)
                template = along_and_radial(primitive, primitive.direction.to(step))[1]
                towards = images @ torch.nn.functional.normalize(template, dim=-1)
                direction = judge.on_circle(centre, normal, towards)
            case Freedom.SPHERE:
                direction = judge.on_sphere(start)[..., None, :].expand_as(centre)
        near, far = (centre + sign * radius[..., None] * direction for sign in (1, -1))
        return near, (judge.keys(far)[0] - judge.keys(near)[0]).clamp(min=0) / 2

    def _permutations(self, exchanges: Sequence[Exchange]) -> Tensor:
        """(q, m) int64; the first exchanges nothing."""
        orders = [list(range(len(self))), *(self._order(exchange) for exchange in exchanges)]
        if len({order[0] for order in orders}) < len(orders):
            raise ValueError(
                f"lookalikes: every exchange must bring another keypoint to the place of {self.names[0]!r}, "
                "which tells them apart; leave out what does not, or declare another keypoint first"
            )
        for one, other in product(orders, repeat=2):
            if [one[i] for i in other] not in orders:
                names = ", ".join(self.names[one[i]] for i in other)
                raise ValueError(
                    f"lookalikes: two exchanges after one another bring ({names}) to the places of "
                    f"({', '.join(self.names)}), which is no exchange of the list; add it"
                )
        return torch.tensor(orders)

    def _order(self, exchange: Exchange) -> list[int]:
        """Which keypoint stands at each place."""
        finite = [name for name, is_finite in zip(self.names, self.is_finite, strict=True) if is_finite]
        for name in chain.from_iterable(exchange):
            if name not in finite:
                raise ValueError(
                    f"lookalikes exchange {name!r}, which is none of the keypoints that have finitely many "
                    f"equivalents: {', '.join(finite) or 'there are none'}"
                )
        order = list(range(len(self)))
        for one, other in exchange:
            i, j = self.names.index(one), self.names.index(other)
            order[i], order[j] = j, i
        if [order[i] for i in order] != list(range(len(self))):
            raise ValueError(f"lookalikes: {exchange} exchanges a keypoint twice; name it in one pair")
        return order

    def _find_finite(self) -> list[bool]:
        finite = [True]
        for keypoint, reference in zip(self.keypoints, self.reference, strict=True):
            finite.append(finite[reference] and keypoint.primitive.freedom is Freedom.NONE)
        return finite[1:]

    def _find_chiralities(self, template: Tensor, mirror: Tensor | None) -> list[Tensor]:
        """The mirror makes a second structure unless some reflection leaves every finite keypoint in
        place."""
        eye = torch.eye(3, dtype=torch.float64)
        if mirror is None:
            return [eye]
        finite = template[self.is_finite]
        improper = self.group[torch.linalg.det(self.group) < 0]
        moved = (finite @ improper.mT - finite).abs().amax((-1, -2))
        return [eye] if bool((moved < 1e-6 * finite.abs().max()).any()) else [eye, mirror.double()]

    def _length(self, expression: Expression, parameters: Tensor) -> Tensor:
        value = self._forgiving(partial(length, expression, self.parameters), parameters)
        return torch.from_numpy(np.array(value)).to(parameters).reshape(parameters.shape[:-1])

    def _origin(self, parameters: Tensor) -> Tensor:
        """(..., 3) the centroid in the frame of construction, metres."""
        if self._centroid is None:
            return torch.zeros_like(parameters[..., :1]).expand(*parameters.shape[:-1], 3)
        place = torch.from_numpy(np.array(self._forgiving(self._centroid, parameters))).to(parameters)
        return place.reshape(*parameters.shape[:-1], 3)

    def _forgiving(self, value: Callable[[Points], Points], parameters: Tensor) -> Points:
        """A value of (n, k) sizes; where estimated ones make no solid, of the nearest among typical sizes."""
        sizes = parameters.detach().cpu().double().reshape(-1, len(self.parameters)).numpy()
        try:
            return value(sizes)
        except ValueError:  # of some row: the others are none the worse for it
            if len(sizes) > 1:
                return np.concatenate([self._forgiving(value, torch.from_numpy(row)) for row in sizes])
            return value(np.clip(sizes, self._typical.min(0), self._typical.max(0)))
