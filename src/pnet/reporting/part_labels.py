"""Texts in a picture: placed so that they cover neither each other nor what they name."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from pnet.reporting.picture import BACKGROUND

Points = NDArray[np.float64]

DOT = 7.0  # pixels, radius of a keypoint's dot
HALO = [withStroke(linewidth=3, foreground=(*BACKGROUND, 0.8))]
_GAPS = (6.0, 11.0, 18.0, 28.0, 40.0, 54.0, 70.0, 90.0)  # pixels between a label and what it names
_APART = np.array([9.0, 3.0])  # pixels between two labels, beside and above each other
_ROUNDS = 3
_FORBIDDEN = 1e4  # cost, in pixels of distance


def write_labels(
    axes: Axes, words: Sequence[str], colours: Points, anchors: Points, dots: Points, clear: Points
) -> None:
    """Write words in free places, with leaders to what they name where that is not beside them.

    Args:
        axes: a panel in pixels. colours: (n, 3) of the words. anchors, dots, clear: see `place_labels`.
    """
    texts = [axes.text(0, 0, word, color=colour) for word, colour in zip(words, colours, strict=True)]
    for text in texts:
        text.set(size=12.5, ha="center", va="center", path_effects=HALO, zorder=5)
    sizes = np.array([text.get_window_extent().size for text in texts])
    panel = (round(np.ptp(axes.get_xlim())), round(np.ptp(axes.get_ylim())))
    centres = place_labels(anchors, sizes, dots, clear, panel)
    for text, anchor, size, centre in zip(texts, anchors, sizes, centres, strict=True):
        text.set_position((centre[0], centre[1]))
        leader = _leaders(anchor, centre[None], size)[0]
        if np.linalg.norm(leader[-1] - anchor) > 2.2 * DOT:
            axes.plot(*leader.T, color=text.get_color(), linewidth=0.9, alpha=0.8)


def place_labels(
    anchors: Points, sizes: Points, dots: Points, clear: Points, panel: tuple[int, int]
) -> Points:
    """Where texts go so that they cover neither each other nor a dot, and stay near what they name.

    Args:
        anchors: (n, 2) what each text names. sizes: (n, 2) width and height of the texts.
        dots: (d, 2) centres of dots. clear: (p, 2) what had better not be covered either.
        panel: width and height. All in pixels.
    Returns:
        (n, 2) the texts' centres.
    """
    centres = np.full_like(anchors, np.nan)  # NaN: not placed yet, in nobody's way
    # the first texts are placed without knowing of the last: more rounds move them out of their way
    for i in [*range(len(anchors))] * _ROUNDS:
        candidates = _candidates(anchors[i], sizes[i])
        cost = _own_cost(candidates, anchors[i], sizes[i], dots, panel)
        cost += 4 * _inside(clear, candidates, sizes[i] / 2 + 3).sum(0)
        for j in range(len(anchors)):
            if j != i:
                cost += _cost_beside(candidates, anchors[i], sizes[i], centres[j], anchors[j], sizes[j])
        centres[i] = candidates[cost.argmin()]
    return centres


def _candidates(anchor: Points, size: Points) -> Points:
    """(c, 2) centres of a text about its anchor, the nearest ones first."""
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    direction = np.stack([np.cos(angle), np.sin(angle)], -1)
    return np.concatenate([anchor + direction * (size / 2 + gap) for gap in _GAPS])


def _own_cost(
    candidates: Points, anchor: Points, size: Points, dots: Points, panel: tuple[int, int]
) -> Points:
    """(c,) what speaks against each place of a text by itself."""
    outside = (np.abs(candidates - np.array(panel) / 2) > np.array(panel) / 2 - size / 2 - 3).any(-1)
    away, outward = candidates - anchor, anchor - dots.mean(0)
    length = np.linalg.norm(away, axis=-1) * np.linalg.norm(outward)
    leaders = _leaders(anchor, candidates, size)
    elsewhere = dots[np.linalg.norm(dots - anchor, axis=-1) > DOT]
    return (
        _FORBIDDEN * outside
        + _FORBIDDEN * _inside(dots, candidates, size / 2 + DOT + 3).sum(0)
        + np.linalg.norm(leaders[:, -1] - anchor, axis=-1)
        - 8 * (away @ outward) / np.maximum(length, 1.0)
        + 15 * _inside(leaders, elsewhere, np.full(2, DOT)).sum((1, 2))
    )


def _cost_beside(
    candidates: Points, anchor: Points, size: Points, centre: Points, other_anchor: Points, other_size: Points
) -> Points:
    """(c,) what speaks against each place of a text beside another text that has its centre."""
    leaders = _leaders(anchor, candidates, size)
    other = _leaders(other_anchor, centre[None], other_size)[0]
    return (
        _FORBIDDEN * _inside(centre, candidates, (size + other_size) / 2 + _APART)
        + 8 * _inside(other, candidates, size / 2).sum(0)
        + 15 * _inside(leaders, centre[None], other_size / 2).sum((1, 2))
        + 15 * _inside(leaders, other, np.full(2, 3.0)).sum((1, 2))
    )


def _leaders(anchor: Points, centres: Points, size: Points) -> Points:
    """(c, 12, 2) places along the straight lines from an anchor to texts about centres (c, 2)."""
    end = np.clip(anchor, centres - size / 2, centres + size / 2)
    return anchor + np.linspace(0, 1, 12)[:, None] * (end - anchor)[:, None]


def _inside(places: Points, centres: Points, half: Points) -> NDArray[np.bool_]:
    """Whether places (..., 2) lie in boxes about centres (c, 2): (..., c); half: (2,) of width and height."""
    return np.asarray((np.abs(places[..., None, :] - centres) < half).all(-1))
