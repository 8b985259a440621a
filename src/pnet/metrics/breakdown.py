"""An evaluated split as rows: every true pose to find, and every result, with all that is known of it."""

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pnet.geometry.pose_space import PoseSpace
from pnet.metrics.keypoint_error import keypoint_error
from pnet.metrics.matching import SceneMatch, ScoredPoses, TruePoses, match_scene
from pnet.metrics.outcomes import Fates, ResultKinds, count_points, result_kinds, true_fates
from pnet.metrics.pose_attributes import Attributes, PoseErrors, pose_errors, scene_attributes
from pnet.parts.base import ParametricPart
from pnet.parts.choice import KeypointChoice
from pnet.records import Detections, Scene

Floats = NDArray[np.float64]
Record = TypeVar("Record")


@dataclass(frozen=True, eq=False)
class TruthRows:
    """n true poses to find, scene by scene.

    Attributes:
        scene: (n,) which of the split's scenes. score: (n,) of the best result, NaN where there is none.
        fate, attributes, errors: what became of them, what they are like, how far off their best results are.
        parameter_error: (n, k) estimated minus true, metres; NaN where a method knows nothing of them.
        keypoint_error: (n, m) to the nearest equivalent of the true keypoint, metres; NaN likewise.
    """

    scene: NDArray[np.int64]
    score: Floats
    fate: Fates
    attributes: Attributes
    errors: PoseErrors
    parameter_error: Floats
    keypoint_error: Floats

    def __len__(self) -> int:
        return len(self.scene)


@dataclass(frozen=True, eq=False)
class ResultRows:
    """n results, scene by scene, best first.

    Attributes:
        scene: (n,) which of the split's scenes. result: (n,) which of the scene's.
        score: (n,). truth: (n,) the nearest true pose, −1 for none. distance: (n,) to it, metres.
        kinds: what they are.
    """

    scene: NDArray[np.int64]
    result: NDArray[np.int64]
    score: Floats
    truth: NDArray[np.int64]
    distance: Floats
    kinds: ResultKinds

    def __len__(self) -> int:
        return len(self.scene)


@dataclass(frozen=True, eq=False)
class Breakdown:
    """Everything about the errors of a split.

    Attributes:
        truths, results: the rows. matches: of every scene, as average precision takes them.
    """

    truths: TruthRows
    results: ResultRows
    matches: list[SceneMatch]


def break_down(
    part: ParametricPart,
    choice: KeypointChoice,
    scenes: Iterable[Scene],
    found: Iterable[Detections],
    max_occlusion: float = 0.5,
) -> Breakdown:
    """Rows of all scenes.

    Args:
        part: the template. choice: the rule of the label keypoints, for their margins.
        scenes: all bodies of one are of one part object. found: what was found in the first points of each.
        max_occlusion: a true pose that is more occluded need not be found.
    Raises:
        ValueError: where a scene and its detections don't belong together, or there is no scene.
    """
    spaces: dict[bytes, PoseSpace] = {}
    truths, results, matches = [], [], []
    for index, (scene, detections) in enumerate(zip(scenes, found, strict=True)):
        seen = _seen(scene, detections)
        # an empty scene has no part object; any pose distance does where there is no true pose
        sizes = scene.parameters[0] if len(scene.parameters) else part.part_object("L", 0)
        if sizes.tobytes() not in spaces:
            spaces[sizes.tobytes()] = part.pose_space(sizes)
        space = spaces[sizes.tobytes()]
        truth = TruePoses(*map(torch.from_numpy, (scene.R, scene.t, scene.occlusion)))
        scored = ScoredPoses(detections.R, detections.t, detections.score)
        match = match_scene(space, truth, scored, max_occlusion)
        numbers = detections.instance.cpu().numpy()
        counts = count_points(seen.instance, numbers, len(truth.t), len(scored.t))
        fates = true_fates(space, truth, scored, match, counts)
        truths.append(_truth_rows(index, seen, detections, part, choice, space, fates))
        results.append(_result_rows(index, match, result_kinds(match, fates, counts)))
        matches.append(match)
    if not matches:
        raise ValueError("there is no scene to look at, expected at least one (it may be empty)")
    return Breakdown(joined(truths), joined(results), matches)


def joined(records: list[Record]) -> Record:
    """One record of the rows of several of a kind; records within them too."""
    columns: dict[str, Any] = {}
    for field in fields(records[0]):  # type: ignore[arg-type]
        values = [getattr(record, field.name) for record in records]
        plain = isinstance(values[0], np.ndarray)
        columns[field.name] = np.concatenate(values) if plain else joined(values)
    return type(records[0])(**columns)


def taken(record: Record, rows: NDArray[Any]) -> Record:
    """The record with some of its rows, by index or mask."""
    columns: dict[str, Any] = {}
    for field in fields(record):  # type: ignore[arg-type]
        value = getattr(record, field.name)
        columns[field.name] = value[rows] if isinstance(value, np.ndarray) else taken(value, rows)
    return type(record)(**columns)


def _seen(scene: Scene, found: Detections) -> Scene:
    """The scene cut to the points that were clustered."""
    count = len(found.instance)
    if count > len(scene.points):
        raise ValueError(
            f"{scene.id}: has {len(scene.points)} points, the predictions were made from {count}; "
            "predict again"
        )
    return replace(scene, points=scene.points[:count], instance=scene.instance[:count])


def _truth_rows(
    index: int,
    scene: Scene,
    found: Detections,
    part: ParametricPart,
    choice: KeypointChoice,
    space: PoseSpace,
    fates: Fates,
) -> TruthRows:
    attributes = taken(scene_attributes(scene, part, choice), fates.body)
    R, t = torch.from_numpy(scene.R[fates.body]), torch.from_numpy(scene.t[fates.body])
    true = torch.from_numpy(attributes.parameters)
    best = torch.from_numpy(fates.result)
    own = [_rows(x, best) for x in (found.R, found.t, found.score, found.parameters, found.keypoints)]
    Rb, tb, score, parameters, keypoints = own
    sizes = parameters - true if parameters.shape == true.shape else torch.full_like(true, torch.nan)
    return TruthRows(
        scene=np.full(len(best), index),
        score=score.numpy(),
        fate=fates,
        attributes=attributes,
        errors=pose_errors(space, part.symmetry, R, t, Rb, tb),
        parameter_error=sizes.numpy(),
        keypoint_error=keypoint_error(part.chain, true, R, t, keypoints).numpy(),
    )


def _result_rows(index: int, match: SceneMatch, kinds: ResultKinds) -> ResultRows:
    d = len(match.score)
    columns = (match.score.numpy(), match.truth.numpy(), match.distance.numpy())
    return ResultRows(np.full(d, index), np.arange(d), *columns, kinds)


def _rows(values: Tensor, index: Tensor) -> Tensor:
    """Float64 rows of (d, …) by index (n,), NaN where that is −1."""
    values = values.detach().double().cpu()
    none = values.new_full((1, *values.shape[1:]), torch.nan)
    return torch.cat([values, none])[index]
