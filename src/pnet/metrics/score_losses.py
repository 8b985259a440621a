"""Where average precision is lost: to true poses not found, and to false results before right ones."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from pnet.metrics.average_precision import average_precision, precision_recall_curve
from pnet.metrics.breakdown import Breakdown
from pnet.metrics.matching import SceneMatch
from pnet.metrics.outcomes import Kind, Outcome, Reason
from pnet.metrics.pose_attributes import Blame

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
BINS = 10  # of scores


@dataclass(frozen=True)
class ScoreLosses:
    """1 is AP, what false results cost, and what true poses cost that were not found.

    Attributes:
        ap: as it is. oracle_ap: with every right result scored above every other. recall: with all results.
        by_order: oracle_ap − ap, lost because false results stand before right ones.
        by_outcome: outcome → share of recall lost to it, each scene weighing the same; together 1 − recall.
        if_mended: what → AP if it were mended and nothing else: for each blame the wrong poses with it, for
            `split` the best piece of each; their best results count as matched with them, whatever they were.
        without: reason → AP if the false results with it were not there.
    """

    ap: float
    oracle_ap: float
    recall: float
    by_order: float
    by_outcome: dict[str, float]
    if_mended: dict[str, float]
    without: dict[str, float]


@dataclass(frozen=True, eq=False)
class Calibration:
    """Precision in bins of the score, as many results in each as equal scores allow.

    Attributes:
        low, high: (b,) lowest and highest score. right, counted: (b,) results; those of hidden bodies count
            neither way. precision: (b,) right / counted, NaN where nothing is counted.
    """

    low: Floats
    high: Floats
    right: NDArray[np.int64]
    counted: NDArray[np.int64]

    @property
    def precision(self) -> Floats:
        """(b,) right / counted."""
        shares = self.right / np.maximum(self.counted, 1)
        return np.where(self.counted > 0, shares, np.nan)


def score_losses(breakdown: Breakdown) -> ScoreLosses:
    """All of `ScoreLosses`."""
    ap = _ap(breakdown.matches)
    right = breakdown.results.kinds.kind == Kind.RIGHT
    oracle = [
        replace(match, score=torch.from_numpy(flag.astype(float)))
        for match, flag in zip(breakdown.matches, _by_scene(breakdown, right), strict=True)
    ]
    by_outcome = outcome_losses(breakdown)
    recall = 1 - sum(by_outcome.values())
    best = _ap(oracle)
    mended, without = _if_mended(breakdown), _without(breakdown)
    return ScoreLosses(ap, best, recall, best - ap, by_outcome, mended, without)


def outcome_losses(breakdown: Breakdown) -> dict[str, float]:
    """Outcome → what it takes from the recall, which is a mean over scenes."""
    truths, scenes = breakdown.truths, len(breakdown.matches)
    to_find = np.bincount(truths.scene, minlength=scenes)
    share = 1 / (scenes * to_find[truths.scene])
    lost = [outcome for outcome in Outcome if outcome is not Outcome.FOUND]
    return {outcome.label: float(share[truths.fate.outcome == outcome].sum()) for outcome in lost}


def calibration(breakdown: Breakdown, bins: int = BINS) -> Calibration:
    """Precision over the score; equal scores are never divided among bins."""
    results = breakdown.results
    counted = results.kinds.kind != Kind.HIDDEN
    score = results.score[counted]
    right = results.kinds.kind[counted] == Kind.RIGHT
    if not len(score):
        return Calibration(*(np.zeros(0, kind) for kind in (float, float, np.int64, np.int64)))
    edges = np.unique(np.quantile(score, np.linspace(0, 1, bins + 1)[1:-1], method="lower"))
    of = np.searchsorted(edges, score, side="left")  # a score on an edge belongs below it
    groups = [of == i for i in np.unique(of)]
    return Calibration(
        np.array([score[group].min() for group in groups]),
        np.array([score[group].max() for group in groups]),
        np.array([right[group].sum() for group in groups], np.int64),
        np.array([group.sum() for group in groups], np.int64),
    )


def sure_and_false(breakdown: Breakdown) -> Bools:
    """(n,) which results count as false and have a higher score than half of the right ones."""
    results = breakdown.results
    right = results.score[results.kinds.kind == Kind.RIGHT]
    level = float(np.median(right)) if len(right) else np.inf
    return (results.kinds.reason != Reason.NONE) & (results.score > level)


def _if_mended(breakdown: Breakdown) -> dict[str, float]:
    fate, blame = breakdown.truths.fate, breakdown.truths.errors.blame
    wrong = fate.outcome == Outcome.WRONG_POSE
    causes = {f"wrong {b.label}": wrong & (blame == b) for b in Blame if b is not Blame.NONE}
    causes["split"] = fate.outcome == Outcome.SPLIT
    return {name: _ap(_mended(breakdown, rows)) for name, rows in causes.items()}


def _mended(breakdown: Breakdown, rows: Bools) -> list[SceneMatch]:
    """The matches with the best results of some true poses matched with them."""
    truths, matches = breakdown.truths, list(breakdown.matches)
    rows = rows & (truths.fate.result >= 0)
    for scene in np.unique(truths.scene[rows]):
        own = rows & (truths.scene == scene)
        result, match = torch.from_numpy(truths.fate.result[own]), matches[scene]
        truth, matched = match.truth.clone(), match.matched.clone()
        truth[result], matched[result] = torch.from_numpy(truths.fate.body[own]), True
        matches[scene] = replace(match, truth=truth, matched=matched)
    return matches


def _without(breakdown: Breakdown) -> dict[str, float]:
    given = [reason for reason in Reason if reason is not Reason.NONE]
    return {reason.label: _ap(_kept(breakdown, breakdown.results.kinds.reason != reason)) for reason in given}


def _kept(breakdown: Breakdown, keep: Bools) -> list[SceneMatch]:
    names = ("score", "truth", "distance", "matched")
    return [
        replace(match, **{name: getattr(match, name)[torch.from_numpy(own)] for name in names})
        for match, own in zip(breakdown.matches, _by_scene(breakdown, keep), strict=True)
    ]


def _by_scene(breakdown: Breakdown, values: Bools) -> list[Bools]:
    return np.split(values, np.cumsum([len(match.score) for match in breakdown.matches])[:-1])


def _ap(matches: list[SceneMatch]) -> float:
    return average_precision(precision_recall_curve(matches))
