"""Precision and recall averaged over scenes, and the numbers drawn from them (Brégier et al. 2017).

At a score threshold the results at or above it are the positives. In each scene, the first positive
tied within the distance threshold to a relevant true pose is a true positive; the first one tied to
a true pose that is too occluded counts neither way; every other is a false positive. Precision
without counted positives is 1, recall with nothing to find is 1.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pnet.metrics.matching import SceneMatch

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PrecisionRecallCurve:
    """Precision and recall at falling score thresholds, each the mean over scenes.

    Attributes:
        precision, recall: (k + 1,); the first point is precision 1 and recall 0.
        threshold: (k + 1,) the distinct scores; +inf for the first point, −inf for the only further
            point where there is no result at all.
    """

    precision: Floats
    recall: Floats
    threshold: Floats


@dataclass(frozen=True, eq=False)
class _Ranking:
    """The n results of all scenes, scene by scene, best score first.

    Attributes:
        scene: (n,) index of the scene. score: (n,).
        true, false: (n,) positives of the scene, counted down to and with this result.
        to_find: (scenes,) relevant true poses.
    """

    scene: NDArray[np.int64]
    score: Floats
    true: NDArray[np.int64]
    false: NDArray[np.int64]
    to_find: NDArray[np.int64]


def precision_recall_curve(matches: Sequence[SceneMatch]) -> PrecisionRecallCurve:
    """Precisions and recalls of one or more scenes, averaged over them at each distinct score.

    Note:
        Scenes weigh the same, whatever their number of true poses. Only the order by score matters,
        and equal scores enter together.
    """
    ranking = _rank_results(matches)
    scenes, empty = len(matches), float(np.mean(ranking.to_find == 0))
    if len(ranking.score) == 0:
        return PrecisionRecallCurve(np.ones(2), np.array([0.0, empty]), np.array([np.inf, -np.inf]))
    precision, recall = _scene_precision(ranking), _scene_recall(ranking)
    order = np.argsort(-ranking.score, kind="stable")
    threshold = ranking.score[order]
    last = np.append(threshold[1:] != threshold[:-1], True)
    # a mean over scenes changes at a result by what that result changes in its own scene
    step_p = _change_in_scene(precision, ranking.scene, before=np.ones(scenes))[order]
    step_r = _change_in_scene(recall, ranking.scene, before=(ranking.to_find == 0) * 1.0)[order]
    return PrecisionRecallCurve(
        np.append(1.0, _unit(1.0 + np.cumsum(step_p) / scenes)[last]),
        np.append(0.0, _unit(empty + np.cumsum(step_r) / scenes)[last]),
        np.append(np.inf, threshold[last]),
    )


def average_precision(curve: PrecisionRecallCurve) -> float:
    """AP = Σ_k (r_k − r_{k−1}) p_k, the area under the curve drawn as steps."""
    return float(np.sum(np.diff(curve.recall) * curve.precision[1:]))


def mean_average_precision(matches: Sequence[SceneMatch]) -> float:
    """MAP: the mean of the scenes' own APs, each on its own results alone."""
    _check_scenes(matches)
    return float(np.mean([average_precision(precision_recall_curve([m])) for m in matches]))


def best_f1(curve: PrecisionRecallCurve) -> float:
    """Largest F1 = 2 P R / (P + R) on the curve, 0 where both are 0."""
    total = curve.precision + curve.recall
    product = 2 * curve.precision * curve.recall
    return float(np.divide(product, total, out=np.zeros_like(total), where=total > 0).max())


def recall_at_precision(curve: PrecisionRecallCurve, precision: float = 0.99) -> float:
    """Largest recall among the points of the curve that reach a precision, 0 if none does."""
    # the running sums behind the curve are exact to some 1e-13 only
    return float(curve.recall[curve.precision >= precision - 1e-9].max(initial=0.0))


def count_positives(matches: Sequence[SceneMatch]) -> tuple[int, int]:
    """True and false positives of all scenes when every result is a positive."""
    ranking = _rank_results(matches)
    last = np.append(ranking.scene[1:] != ranking.scene[:-1], True)[: len(ranking.scene)]
    return int(ranking.true[last].sum()), int(ranking.false[last].sum())


def _rank_results(matches: Sequence[SceneMatch]) -> _Ranking:
    _check_scenes(matches)
    scene = np.repeat(np.arange(len(matches)), [len(m.score) for m in matches])
    score = np.concatenate([m.score.numpy() for m in matches])
    matched = np.concatenate([m.matched.numpy() for m in matches])
    relevant = np.concatenate([m.relevant.numpy() for m in matches])
    # true poses are numbered through all scenes
    offset = np.cumsum([0] + [len(m.relevant) for m in matches[:-1]])
    truth = np.concatenate([m.truth.numpy() for m in matches]) + offset[scene]
    order = np.lexsort((-score, scene))
    first = _first_matches(truth[order], matched[order])
    found = np.zeros(len(score), bool)
    found[first] = relevant[truth[order][first]]
    return _Ranking(
        scene,
        score[order],
        _count_in_scene(found, scene),
        _count_in_scene(~first, scene),
        np.array([int(m.relevant.sum()) for m in matches]),
    )


def _first_matches(truth: NDArray[np.int64], matched: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark, of the results (n,) that are matched with the same true pose, the first."""
    candidate = np.flatnonzero(matched)
    first = np.zeros(len(truth), bool)
    first[candidate[np.unique(truth[candidate], return_index=True)[1]]] = True
    return first


def _count_in_scene(flag: NDArray[np.bool_], scene: NDArray[np.int64]) -> NDArray[np.int64]:
    """Running count of a flag that starts anew in each scene; both (n,), scenes ascending."""
    running = np.append(0, np.cumsum(flag))
    return running[1:] - running[np.searchsorted(scene, scene)]


def _change_in_scene(value: Floats, scene: NDArray[np.int64], before: Floats) -> Floats:
    """Change (n,) since the scene's previous result; `before` (scenes,) precedes its first."""
    previous = np.append(0.0, value[:-1])
    starts = np.append(True, scene[1:] != scene[:-1])
    return value - np.where(starts, before[scene], previous)


def _scene_precision(ranking: _Ranking) -> Floats:
    counted = ranking.true + ranking.false
    return np.where(counted > 0, ranking.true / np.maximum(counted, 1), 1.0)


def _scene_recall(ranking: _Ranking) -> Floats:
    to_find = ranking.to_find[ranking.scene]
    return np.where(to_find > 0, ranking.true / np.maximum(to_find, 1), 1.0)


def _unit(value: Floats) -> Floats:
    """Rounding may carry a mean of shares past 0 or 1."""
    return np.clip(value, 0.0, 1.0)


def _check_scenes(matches: Sequence[SceneMatch]) -> None:
    if len(matches) == 0:
        raise ValueError("there is no scene to score, expected at least one (it may be empty)")
