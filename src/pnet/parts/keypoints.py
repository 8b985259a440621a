"""Keypoints from parameters and back, from one declaration (Section II.A of the paper).

The selection loop: the centroid is the first reference; each rule measures one distance from its
reference to a primitive, where the next keypoint lies; a found keypoint may be a later reference.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import isfinite

import torch
from torch import Tensor

from pnet.parts.orbits import FiniteOrbit, Orbit

CENTROID = "centroid"


class KeypointRule(StrEnum):
    """Which of the equivalent keypoints is the label."""

    CAMERA = "camera"  # equation 1: the geometrically unique one, nearest to the camera
    CANONICAL = "canonical"  # the template's own, the ablation "w/o GU"


@dataclass(frozen=True)
class KeypointChoice:
    """A rule, and the direction along which the camera rule compares.

    Attributes:
        rule: which equivalent is the label.
        direction: camera-frame vector; the label is the equivalent that lies least far along it. The
            paper's equation 1 has (0, 0, 1). Seen along its axis a ring has no nearest point under that,
            and most flat parts lie so: an oblique or upright direction moves the ambiguity to rare views.
    """

    rule: KeypointRule = KeypointRule.CAMERA
    direction: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        if len(self.direction) != 3 or not any(self.direction) or not all(map(isfinite, self.direction)):
            raise ValueError(f"targets.direction is {self.direction}, expected three numbers, not all zero")

    @property
    def frame(self) -> Tensor:
        """(3, 3) float64 rotation whose rows are the x, y and z of equation 1 and its tie-breaks."""
        z = torch.nn.functional.normalize(torch.tensor(self.direction, dtype=torch.float64), dim=0)
        x = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
        if abs(float(z[0])) > 0.9:  # x would be nearly along z: start from another axis
            x = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
        x = torch.nn.functional.normalize(x - (x @ z) * z, dim=0)
        return torch.stack([x, torch.linalg.cross(z, x), z])


@dataclass(frozen=True)
class Keypoint:
    """One keypoint: `reference + factor · parameter · direction`.

    Attributes:
        name: what it is, for pictures and logs.
        reference: an earlier keypoint's name, or "centroid".
        orbit: the equivalent directions, the template's first.
        parameter: the parameter that the distance measures.
        factor: distance / parameter.
    """

    name: str
    reference: str
    orbit: Orbit
    parameter: str
    factor: float = 1.0


class KeypointChain:
    """A part's keypoints, each hanging on the centroid or on an earlier one.

    Args:
        keypoints: in order of selection.
        parameters: the part's parameter names; each must be measured by at least one keypoint.
    """

    def __init__(self, keypoints: Sequence[Keypoint], parameters: Sequence[str]) -> None:
        self.keypoints = tuple(keypoints)
        self.parameters = tuple(parameters)
        known = [CENTROID]
        for keypoint in self.keypoints:
            if keypoint.reference not in known:
                raise ValueError(
                    f"keypoint {keypoint.name!r} refers to {keypoint.reference!r}, which is not one of "
                    f"{known}; name the centroid or an earlier keypoint"
                )
            if keypoint.parameter not in self.parameters:
                raise ValueError(
                    f"keypoint {keypoint.name!r} measures {keypoint.parameter!r}, "
                    f"which is not one of the parameters {list(self.parameters)}"
                )
            known.append(keypoint.name)
        for parameter in self.parameters:
            if not any(keypoint.parameter == parameter for keypoint in self.keypoints):
                raise ValueError(f"no keypoint determines the parameter {parameter!r}")
        self._reference = [known.index(keypoint.reference) for keypoint in self.keypoints]
        self._column = [self.parameters.index(keypoint.parameter) for keypoint in self.keypoints]

    def __len__(self) -> int:
        """m, the number of keypoints."""
        return len(self.keypoints)

    @property
    def names(self) -> list[str]:
        """The keypoints' names in order."""
        return [keypoint.name for keypoint in self.keypoints]

    def canonical(self, parameters: Tensor) -> Tensor:
        """The template's keypoints, in the part frame with the centroid at the origin.

        Args:
            parameters: (..., k) metres.
        Returns:
            (..., m, 3) metres.
        """
        return self._hang(parameters, [keypoint.orbit.canonical for keypoint in self.keypoints])

    def nearest_to_camera(self, parameters: Tensor, R: Tensor) -> Tensor:
        """The geometrically unique keypoints of instances (equation 1), in the part frame.

        Args:
            parameters: (..., k) metres.
            R: (..., 3, 3) part → camera.
        Returns:
            (..., m, 3) metres. A keypoint stays on the side that its reference has chosen.
        """
        directions = [keypoint.orbit.nearest_to_camera(R) for keypoint in self.keypoints]
        return self._hang(parameters, directions)

    def select(self, choice: KeypointChoice, parameters: Tensor, R: Tensor) -> Tensor:
        """The label keypoints under a choice; shapes as in `nearest_to_camera`."""
        if choice.rule is KeypointRule.CAMERA:
            return self.nearest_to_camera(parameters, choice.frame.to(R) @ R)
        return self.canonical(parameters)

    def parameters_from_keypoints(self, centroid: Tensor, keypoints: Tensor) -> Tensor:
        """Parameters as the distances that define the keypoints, in any frame (the module M_P).

        Args:
            centroid: (..., 3), keypoints: (..., m, 3) metres.
        Returns:
            (..., k) metres; the mean where several keypoints measure one parameter.
        """
        points = torch.cat([centroid[..., None, :], keypoints], -2)
        distance = torch.linalg.vector_norm(points[..., 1:, :] - points[..., self._reference, :], dim=-1)
        factor = distance.new_tensor([keypoint.factor for keypoint in self.keypoints])
        measured = distance / factor
        columns = [
            measured[..., [i for i, c in enumerate(self._column) if c == column]].mean(-1)
            for column in range(len(self.parameters))
        ]
        return torch.stack(columns, -1)

    def place_like(self, parameters: Tensor, observed: Tensor) -> Tensor:
        """Template keypoints with the free ones (on rings and spheres) where an observation has them.

        A finite choice is undone by the part's symmetry, so the template's own stands for it; a free
        keypoint's place on its circle is known only from the observation.

        Args:
            parameters: (..., k) metres.
            observed: (..., m, 3) observed keypoints carried into the part frame, metres.
        Returns:
            (..., m, 3) metres, part frame.
        """
        points = torch.cat([torch.zeros_like(observed[..., :1, :]), observed], -2)
        directions = []
        for i, keypoint in enumerate(self.keypoints):
            seen = points[..., i + 1, :] - points[..., self._reference[i], :]
            finite = isinstance(keypoint.orbit, FiniteOrbit)
            directions.append(keypoint.orbit.canonical.to(seen) if finite else keypoint.orbit.project(seen))
        return self._hang(parameters, directions)

    @property
    def is_finite(self) -> list[bool]:
        """(m,) whether each keypoint and all its references have finitely many equivalents."""
        finite = [True]
        for keypoint, reference in zip(self.keypoints, self._reference, strict=True):
            finite.append(finite[reference] and isinstance(keypoint.orbit, FiniteOrbit))
        return finite[1:]

    def _hang(self, parameters: Tensor, directions: list[Tensor]) -> Tensor:
        points = [torch.zeros_like(parameters[..., :1]).expand(*parameters.shape[:-1], 3)]
        for i, keypoint in enumerate(self.keypoints):
            distance = keypoint.factor * parameters[..., self._column[i], None]
            points.append(points[self._reference[i]] + distance * directions[i].to(parameters))
        return torch.stack(points[1:], -2)
