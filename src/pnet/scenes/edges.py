"""How far every pixel of a depth image is from the nearest depth discontinuity."""

import numpy as np
from numpy.typing import NDArray

EDGE_REACH = 10  # pixels; beyond it the distance is not told
FAR_FROM_EDGES = 255


def image_edges(depth: NDArray[np.floating], step: float) -> NDArray[np.uint8]:
    """Distance to the nearest depth discontinuity.

    A discontinuity lies between two pixels, side by side or one above the other, whose depths differ by
    more than `step`, or of which one has a depth and the other has none. Both pixels have distance 0,
    their neighbours 1: `distance < k` is a strip of k pixels on either side. The image's border is none.

    Args:
        depth: (h, w) planar depth, metres; 0 or NaN where nothing was measured.
        step: metres; larger than the step from pixel to pixel on slanted surfaces.
    Returns:
        (h, w) Euclidean distance in pixels, rounded down; 255 beyond `EDGE_REACH`.
    """
    along_row = _within_rows(_beside_discontinuities(depth, step))
    # squares fit a byte: at most (EDGE_REACH + 1)² + EDGE_REACH² = 221
    squared = along_row * along_row
    nearest = squared.copy()
    for rows in range(1, EDGE_REACH + 1):
        other = squared + np.uint8(rows * rows)
        np.minimum(nearest[rows:], other[:-rows], out=nearest[rows:])
        np.minimum(nearest[:-rows], other[rows:], out=nearest[:-rows])
    return _ROOT[nearest]


def _beside_discontinuities(depth: NDArray[np.floating], step: float) -> NDArray[np.bool_]:
    """(h, w) pixels that touch a discontinuity."""
    measured = depth > 0
    beside = np.zeros(depth.shape, bool)
    for a, b in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        broken = (np.abs(depth[a] - depth[b]) > step) | (measured[a] != measured[b])
        beside[a] |= broken
        beside[b] |= broken
    return beside


def _within_rows(marked: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """(h, w) pixels to the nearest marked pixel of the same row, `EDGE_REACH` + 1 where none is near."""
    distance = np.where(marked, np.uint8(0), np.uint8(EDGE_REACH + 1))
    for _ in range(EDGE_REACH):
        farther = distance + np.uint8(1)
        np.minimum(distance[:, 1:], farther[:, :-1], out=distance[:, 1:])
        np.minimum(distance[:, :-1], farther[:, 1:], out=distance[:, :-1])
    return distance


def _roots() -> NDArray[np.uint8]:
    """(256,) the distance of a squared distance."""
    squared = np.arange(256)
    root = np.sqrt(squared).astype(np.uint8)
    root[squared > EDGE_REACH**2] = FAR_FROM_EDGES
    return root


_ROOT = _roots()
