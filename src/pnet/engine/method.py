"""What evaluation, prediction and tables know of a method: clouds in, detections out."""

from dataclasses import dataclass, field
from time import perf_counter
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from pnet.backbones.base import Backbone
from pnet.engine.precision import Precision
from pnet.parts.base import ParametricPart
from pnet.postprocess.detections import no_detections
from pnet.records import Detections


@dataclass
class Timing:
    """Seconds spent on scenes so far."""

    scenes: int = 0
    network: float = 0.0
    postprocess: float = 0.0


class Method(Protocol):
    """Finds the instances of a part in point clouds; learned or classical."""

    part: ParametricPart
    timing: Timing

    def estimate(self, points: Tensor) -> list[Detections]:
        """Detections of each cloud. points: (B, N, 3) camera frame, metres."""
        ...


class Recovery(Protocol):
    """A learned method's post-processing: what its network says of points → instances."""

    def __call__(
        self, part: ParametricPart, prediction: Any, points: Tensor | None = None
    ) -> list[Detections]:
        """Of every scene of a batch; points: (B, N, 3) their clouds, camera frame, metres."""
        ...


@dataclass
class NetworkMethod:
    """A trained network and the recovery of poses from its predictions.

    Attributes:
        network: (B, N, 3) points to the prediction that `recovery` understands.
    """

    part: ParametricPart
    network: nn.Module
    recovery: Recovery
    precision: Precision = Precision.FLOAT32
    timing: Timing = field(default_factory=Timing)

    @torch.no_grad()
    def estimate(self, points: Tensor) -> list[Detections]:
        """Detections of each cloud; none where a cloud has no point."""
        if points.shape[1] == 0:
            return [no_detections(self.part, 0) for _ in points]
        check_points(points)
        device = next(self.network.parameters()).device
        training = self.network.training
        self.network.eval()
        # one by one, where a batch saves no time or its clouds would change each other's results
        backbones = [module for module in self.network.modules() if isinstance(module, Backbone)]
        alone = device.type == "cpu" or not all(backbone.batches_agree for backbone in backbones)
        found: list[Detections] = []
        for batch in points.split(1 if alone else len(points)):
            found += self._estimate(batch, device)
        self.timing.scenes += len(points)
        self.network.train(training)
        return found

    def _estimate(self, points: Tensor, device: torch.device) -> list[Detections]:
        start = perf_counter()
        with self.precision.numbers(device.type):
            prediction = self.network(points.to(device))
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        middle = perf_counter()
        found = self.recovery(self.part, prediction, points)
        self.timing.network += middle - start
        self.timing.postprocess += perf_counter() - middle
        return found


def check_points(points: Tensor) -> None:
    """Raise ValueError where points (..., 3) are not in front of a camera; says what to do."""
    if not bool(torch.isfinite(points).all()):
        raise ValueError("the cloud has NaN or infinite coordinates; remove those points first")
    if bool((points[..., 2] <= 0).any()):
        raise ValueError(
            "the cloud has points at or behind the camera (z <= 0); remove them, or turn the cloud into "
            "the camera frame: x right, y down, z forward, metres"
        )
