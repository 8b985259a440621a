"""Evaluation in two steps: predict, then score what was predicted."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import groupby, islice

import torch
from torch import Tensor

from pnet.engine.method import Method
from pnet.geometry.pose_space import PoseSpace
from pnet.metrics.matching import ScoredPoses, TruePoses
from pnet.metrics.pose_metric import PoseMetrics
from pnet.parts.base import ParametricPart
from pnet.records import Detections, Scene

AT_ONCE = 8  # scenes that a method is given


def predict_scenes(
    method: Method,
    scenes: Sequence[Scene],
    points: int | None,
    advance: Callable[[int], None] = lambda scenes: None,
) -> list[Detections]:
    """Detections of every scene.

    Args:
        method: any; is given some scenes at once, which a network on a GPU takes together.
        scenes: in order. points: N, the first so many of a scene's; None: all.
        advance: called with the number of scenes done, after each of those calls.
    """
    found: list[Detections] = []
    clouds = (torch.from_numpy(scenes[i].points[:points]) for i in range(len(scenes)))
    for _, alike in groupby(clouds, len):  # a converted data set's scenes may differ
        for batch in batched(alike, AT_ONCE):
            found += method.estimate(torch.stack(batch))
            advance(len(batch))
    return found


def batched(clouds: Iterable[Tensor], size: int) -> Iterator[list[Tensor]]:
    """So many at a time, the rest at the end."""
    clouds = iter(clouds)
    while batch := list(islice(clouds, size)):
        yield batch


class SceneScorer:
    """Scores detections against truth, over all scenes and for each part object (the paper's mAP).

    Args:
        part: the template; its pose distance depends on a scene's parameters.
    """

    def __init__(self, part: ParametricPart) -> None:
        self._part = part
        self._spaces: dict[bytes, PoseSpace] = {}
        self.metrics = PoseMetrics(parameter_names=part.parameter_names)
        self._by_object: dict[bytes, PoseMetrics] = defaultdict(PoseMetrics)

    def add(self, scene: Scene, found: Detections) -> None:
        """Count one scene; all its bodies are of one part object."""
        key = scene.parameters[:1].tobytes()
        truth = TruePoses(
            torch.from_numpy(scene.R), torch.from_numpy(scene.t), torch.from_numpy(scene.occlusion)
        )
        results = ScoredPoses(found.R, found.t, found.score)
        parameters = torch.from_numpy(scene.parameters)
        for metrics in (self.metrics, self._by_object[key]):
            metrics.update(self._space(scene), truth, results, parameters, found.parameters)

    def add_all(self, scenes: Iterable[Scene], found: Iterable[Detections]) -> "SceneScorer":
        """Count many scenes."""
        for scene, detections in zip(scenes, found, strict=True):
            self.add(scene, detections)
        return self

    def compute(self) -> dict[str, float]:
        """All metrics, and mAP, the mean of the part objects' AP."""
        values: dict[str, float] = self.metrics.compute()
        each = [float(metrics.compute()["AP"]) for metrics in self._by_object.values()]
        return {**values, "mAP": sum(each) / len(each) if each else float("nan")}

    def _space(self, scene: Scene) -> PoseSpace:
        key = scene.parameters[:1].tobytes()
        if key not in self._spaces:
            # an empty scene has no part object; any pose distance does where there is no true pose
            sizes = scene.parameters[0] if len(scene.parameters) else self._part.part_object("L", 0)
            self._spaces[key] = self._part.pose_space(sizes)
        return self._spaces[key]
