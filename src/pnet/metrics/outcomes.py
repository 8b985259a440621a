"""What became of every true pose of a scene, and what every result is: first by poses, then by points.

A true pose to find (occlusion at most the largest asked for) has exactly one outcome. The first rule that
holds decides:

1. found: some result is matched with it, as `match_scene` ties them.
2. missed: more than half of its points belong to no detection, or it has no points.
3. merged: the detection with most of its points (its home) has strictly more points of some other body. Of
   two detections with as many of its points the surer one is its home.
4. split: at least two detections are its pieces. A piece has at least a fifth of its points, and of no other
   body more than of it.
5. wrong pose: its home is its own, and the pose is beyond the threshold (or nearer to another true pose).

Of a merger the body with fewer points is merged; the other one is found, or its pose is wrong.
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import torch
from numpy.typing import NDArray

from pnet.geometry.pose_space import PoseSpace
from pnet.metrics.matching import SceneMatch, ScoredPoses, TruePoses, nearest_matches

Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
PIECE = 5  # a piece has at least one in so many of its body's points


class _Named(IntEnum):
    @property
    def label(self) -> str:
        """Its name for people."""
        return self.name.lower().replace("_", " ")


class Outcome(_Named):
    """What became of a true pose, see the module."""

    FOUND = 0
    MISSED = 1
    MERGED = 2
    SPLIT = 3
    WRONG_POSE = 4


class Kind(_Named):
    """What a result is, as average precision counts it.

    RIGHT: the surest of those matched with a true pose to find. DUPLICATE: matched with a true pose that a
    surer result is matched with; counts as false. HIDDEN: the surest matched with a true pose that need not
    be found; counts neither way. FALSE: every other.
    """

    RIGHT = 0
    DUPLICATE = 1
    HIDDEN = 2
    FALSE = 3


class Reason(_Named):
    """Why a false result is there: what became of its owner, the body that most of its points lie on.

    HIDDEN_BODY: the owner need not be found. PIECE_OF_FOUND: the owner is found by another result. NO_POINTS:
    it has no points on a body. NONE: it is not false.
    """

    NONE = 0
    DUPLICATE = 1
    MISSED = 2
    MERGED = 3
    SPLIT = 4
    WRONG_POSE = 5
    PIECE_OF_FOUND = 6
    HIDDEN_BODY = 7
    NO_POINTS = 8


_REASONS = {
    Outcome.FOUND: Reason.PIECE_OF_FOUND,
    Outcome.MISSED: Reason.MISSED,
    Outcome.MERGED: Reason.MERGED,
    Outcome.SPLIT: Reason.SPLIT,
    Outcome.WRONG_POSE: Reason.WRONG_POSE,
}


@dataclass(frozen=True, eq=False)
class Fates:
    """What became of n true poses to find.

    Attributes:
        body: (n,) index in the scene. outcome: (n,) of `Outcome`.
        result: (n,) the best result: the one matched with it, else of its home (if that is its own) and its
            pieces the nearest one by pose distance; −1 where there is none.
        home: (n,) the detection with most of its points, −1 for none. pieces: (n,) how many.
        points: (n,) its own. unclustered: (n,) those of them in no detection. at_home: (n,) those in its
            home. home_size: (n,) points of all bodies there.
    """

    body: Ints
    outcome: Ints
    result: Ints
    home: Ints
    pieces: Ints
    points: Ints
    unclustered: Ints
    at_home: Ints
    home_size: Ints


@dataclass(frozen=True, eq=False)
class ResultKinds:
    """What d results are.

    Attributes:
        kind: (d,) of `Kind`. reason: (d,) of `Reason`.
        owner: (d,) the body that most of its points lie on (the first of several), −1 for none.
        points: (d,) on bodies. owned: (d,) those of them on the owner.
    """

    kind: Ints
    reason: Ints
    owner: Ints
    points: Ints
    owned: Ints


def count_points(body: Ints, detection: Ints, bodies: int, detections: int) -> Ints:
    """Points by body and detection.

    Args:
        body: (N,) that each point lies on, −1 for none. detection: (N,) it was clustered to, −1 for none.
    Returns:
        (bodies, detections + 1); the last column is of the points in no detection.
    """
    known = body >= 0
    column = np.where(detection >= 0, detection, detections)[known]
    cell = body[known] * (detections + 1) + column
    return np.bincount(cell, minlength=bodies * (detections + 1)).reshape(bodies, detections + 1)


def true_fates(
    space: PoseSpace, truth: TruePoses, results: ScoredPoses, match: SceneMatch, counts: Ints
) -> Fates:
    """The fates of the true poses to find, in their order.

    Args:
        results: best first. match: of both. counts: of `count_points`.
    """
    found, by = (index.numpy() for index in nearest_matches(match))
    clustered, total = counts[:, :-1], counts.sum(1)
    own = (clustered > 0) & (clustered >= clustered.max(0, initial=0))
    piece = own & (PIECE * clustered >= total[:, None])
    ranked = np.concatenate([np.zeros((len(counts), 1), np.int64), clustered], 1)  # column 0: no detection
    home = ranked.argmax(1) - 1
    rows = np.arange(len(counts))
    at_home = ranked[rows, home + 1]
    its_own = np.concatenate([np.zeros((len(counts), 1), bool), own], 1)[rows, home + 1]
    missed = (total == 0) | (2 * counts[:, -1] > total)
    outcome = np.select(
        [np.isin(rows, found), missed, ~its_own],
        [Outcome.FOUND, Outcome.MISSED, Outcome.MERGED],
        np.where(piece.sum(1) >= 2, Outcome.SPLIT, Outcome.WRONG_POSE),
    )
    candidate = piece.copy()
    candidate[rows[its_own], home[its_own]] = True
    result = _nearest(space, truth, results, candidate)
    result[found] = by
    sizes = np.append(0, clustered.sum(0))[home + 1]
    every = (rows, outcome, result, home, piece.sum(1), total, counts[:, -1], at_home, sizes)
    return Fates(*(np.asarray(column, np.int64)[match.relevant.numpy()] for column in every))


def result_kinds(match: SceneMatch, fates: Fates, counts: Ints) -> ResultKinds:
    """What every result of a scene is.

    Args:
        match: of d results. fates: of the scene's true poses. counts: of `count_points`.
    """
    clustered, d = counts[:, :-1], len(match.score)
    owned = clustered.max(0, initial=0)
    owner = np.where(owned > 0, clustered.argmax(0) if len(clustered) else -1, -1).astype(np.int64)
    kind = _kinds(match)
    told = np.full(len(counts) + 1, Reason.HIDDEN_BODY, np.int64)  # the last entry serves owner −1
    told[-1] = Reason.NO_POINTS
    told[fates.body] = [_REASONS[Outcome(outcome)] for outcome in fates.outcome]
    reason = np.select([kind == Kind.FALSE, kind == Kind.DUPLICATE], [told[owner], Reason.DUPLICATE], 0)
    return ResultKinds(kind, reason.astype(np.int64), owner, clustered.sum(0).reshape(d), owned)


def _kinds(match: SceneMatch) -> Ints:
    """(d,) as average precision counts them: by falling score, of equal ones the first."""
    kind, taken = np.full(len(match.score), Kind.FALSE, np.int64), set()
    for j in np.argsort(-match.score.numpy(), kind="stable"):
        i = int(match.truth[j])
        if not bool(match.matched[j]):
            continue
        if i in taken:
            kind[j] = Kind.DUPLICATE
        else:
            kind[j] = Kind.RIGHT if bool(match.relevant[i]) else Kind.HIDDEN
        taken.add(i)
    return kind


def _nearest(space: PoseSpace, truth: TruePoses, results: ScoredPoses, candidate: Bools) -> Ints:
    """(m,) of the candidates (m, d) of each true pose the nearest by pose distance, −1 for none."""
    i, j = np.nonzero(candidate)
    a, b = torch.from_numpy(i), torch.from_numpy(j)
    distance = space.distance(truth.R[a], truth.t[a], results.R[b], results.t[b]).numpy()
    nearest = np.full(len(candidate), -1, np.int64)
    order = np.lexsort((distance, i))[::-1]  # the nearest is written last
    nearest[i[order]] = j[order]
    return nearest
