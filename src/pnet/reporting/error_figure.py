"""One figure of what an evaluated run gets wrong: outcomes, losses of AP, errors, and what they go with."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec
from matplotlib.patches import Patch

from pnet.metrics.breakdown import Breakdown
from pnet.metrics.outcomes import Outcome
from pnet.metrics.pose_attributes import Blame
from pnet.metrics.score_losses import calibration
from pnet.parts.base import ParametricPart
from pnet.reporting import error_panels as panels
from pnet.reporting.breakdown_bins import (
    FEW,
    Bins,
    attribute_bins,
    outcome_shares,
    quantile_bins,
    size_bins,
)
from pnet.reporting.picture import write_png

WIDTH, HEIGHT, DPI = 1500, 2080, 150  # pixels
_MARGIN_BINS = 6
_ORDER = "false before right"


def error_picture(breakdown: Breakdown, part: ParametricPart, told: Mapping[str, Any], path: Path) -> None:
    """Write a PNG; the file appears when it is whole.

    Args:
        told: of `breakdown_summary.summary`. path: where to write; the folder must exist.
    """
    write_png(error_figure(breakdown, part, told), path)


def error_figure(breakdown: Breakdown, part: ParametricPart, told: Mapping[str, Any]) -> Figure:
    """The figure that `error_picture` writes."""
    figure = Figure(figsize=(WIDTH / DPI, HEIGHT / DPI), dpi=DPI, facecolor="white")
    grid = GridSpec(5, 3, figure, left=0.055, right=0.985, top=0.925, bottom=0.03, hspace=0.52, wspace=0.24)
    _heading(figure, breakdown, part, told)
    for column, bins in enumerate(attribute_bins(breakdown.truths)):
        _outcomes(figure.add_subplot(grid[0, column]), breakdown, bins)
    _sizes(figure.add_subplot(grid[1, :2]), breakdown, part)
    draw: dict[tuple[int, int], Callable[[Axes], None]] = {
        (1, 2): lambda axes: _losses(axes, told["score"]),
        (2, 0): lambda axes: _blames(axes, told),
        (2, 1): lambda axes: _positions(axes, breakdown),
        (2, 2): lambda axes: _rotations(axes, breakdown),
        (3, 0): lambda axes: _parameters(axes, breakdown, part),
        (3, 1): lambda axes: _parameters_by_tilt(axes, breakdown, part),
        (3, 2): lambda axes: _calibration(axes, breakdown),
        (4, 0): lambda axes: _keypoints(axes, breakdown, part),
        (4, 1): lambda axes: _keypoints_by_margin(axes, breakdown, part),
        (4, 2): lambda axes: _rotation_by_tilt(axes, breakdown),
    }
    for (row, column), panel in draw.items():
        panel(figure.add_subplot(grid[row, column]))
    return figure


def _heading(figure: Figure, breakdown: Breakdown, part: ParametricPart, told: Mapping[str, Any]) -> None:
    score, outcomes = told["score"], told["outcomes"]
    head = f"{part.name.upper()}: AP {score['ap']:.3f}, {outcomes['found']['count']:,} of "
    head += f"{told['truths_to_find']:,} true poses found in {told['scenes']:,} scenes"
    figure.text(0.02, 0.985, head, size=12, color=panels.INK, va="top", parse_math=False)
    note = f"Small numbers above bars: true poses; pale bars: fewer than {FEW}. "
    note += "Errors are those of the best result of each true pose, found or not."
    figure.text(0.02, 0.969, note, size=panels.TEXT, color=panels.QUIET, va="top")
    handles = [Patch(facecolor=panels.OUTCOME_COLOURS[outcome], label=outcome.label) for outcome in Outcome]
    place: dict[str, Any] = {"loc": "upper right", "bbox_to_anchor": (0.985, 0.99), "borderaxespad": 0}
    figure.legend(handles=handles, ncols=5, frameon=False, fontsize=panels.TEXT, columnspacing=1.2, **place)


def _outcomes(axes: Axes, breakdown: Breakdown, bins: Bins) -> None:
    title = f"Not found, by {bins.name.split(',')[0]}"
    if not len(bins.labels):
        panels.blank(axes, title, "no true pose has one")
        return
    places = np.arange(float(len(bins.labels)))
    panels.style(axes, title, bins.name, "share of true poses")
    panels.lost_shares(axes, places, outcome_shares(bins, breakdown.truths), bins.count)
    panels.name_bins(axes, places, bins.labels)


def _sizes(axes: Axes, breakdown: Breakdown, part: ParametricPart) -> None:
    """One group of bars for each parameter."""
    title, groups = "Not found, by the part object's sizes", size_bins(breakdown.truths, part)
    if not len(breakdown.truths):
        panels.blank(axes, title, "there is no true pose")
        return
    first = np.cumsum([0.0, *(len(bins.labels) + 1 for bins in groups)])
    places = np.concatenate(
        [start + np.arange(len(g.labels)) for start, g in zip(first, groups, strict=False)]
    )
    each = [outcome_shares(bins, breakdown.truths) for bins in groups]
    shares = {outcome: np.concatenate([of[outcome] for of in each]) for outcome in Outcome}
    panels.style(axes, title, y="share of true poses")
    panels.lost_shares(axes, places, shares, np.concatenate([bins.count for bins in groups]))
    axes.set_xticks(places, [label for bins in groups for label in bins.labels])
    for start, bins in zip(first, groups, strict=False):
        middle = start + (len(bins.labels) - 1) / 2
        place: Any = {"transform": axes.get_xaxis_transform(), "ha": "center", "va": "top"}
        axes.text(middle, -0.12, bins.name, size=panels.TEXT, color=panels.QUIET, parse_math=False, **place)


def _losses(axes: Axes, score: Mapping[str, Any]) -> None:
    floor = " (axis cut)" if score["ap"] > 0.5 else ""
    panels.style(axes, f"From 1 to AP{floor}")
    losses = {**score["by_outcome"], _ORDER: score["by_order"]}
    colours = {o.label: colour for o, colour in panels.OUTCOME_COLOURS.items()} | {_ORDER: panels.QUIET}
    panels.waterfall(axes, score["ap"], losses, colours)


def _blames(axes: Axes, told: Mapping[str, Any]) -> None:
    """Wrong poses by what is to blame, with the AP that mending them alone would bring."""
    mended, poses = told["score"]["if_mended"], told["wrong_poses"]
    counts = {name: n for name, n in poses["blame"].items() if name != Blame.NONE.label}
    texts = [f"{n:,} · AP {mended[f'wrong {name}']:.3f} if mended" for name, n in counts.items()]
    colours = [panels.BAD] * len(counts) + [panels.OUTCOME_COLOURS[Outcome.SPLIT]]
    counts["(split)"] = told["outcomes"]["split"]["count"]
    texts.append(f"{counts['(split)']:,} · AP {mended['split']:.3f} if mended")
    note = "both: each alone is beyond; sum: only together"
    panels.style(axes, "Wrong poses, by what is beyond the threshold", f"{note}\n{_turn_text(poses)}")
    shown = [text if n else "0" for text, n in zip(texts, counts.values(), strict=True)]
    panels.told_bars(axes, counts, shown, colours)


def _turn_text(poses: Mapping[str, Any]) -> str:
    about = ", ".join(f"{name} {n:,}" for name, n in poses["turned_about"].items() if n)
    about = f"turned about the part's {about}; " if about else ""
    return f"{about}by more than 60°: {poses['flips']:,}"


def _positions(axes: Axes, breakdown: Breakdown) -> None:
    errors = breakdown.truths.errors
    values, beyond = 1000 * errors.position, errors.position > errors.threshold
    _histogram(axes, "Position error", "between surface centroids, mm", values, beyond, errors.distance)


def _rotations(axes: Axes, breakdown: Breakdown) -> None:
    errors = breakdown.truths.errors
    beyond = errors.rotation_distance > errors.threshold
    values = np.degrees(errors.rotation)
    _histogram(axes, "Rotation error", "angle modulo symmetry, °", values, beyond, errors.distance)


def _histogram(axes: Axes, title: str, x: str, values: Any, beyond: Any, known: Any) -> None:
    finite = values[np.isfinite(known)]
    if not len(finite) or not finite.max() > 0:
        panels.blank(
            axes, title, "there is no result to compare" if not len(finite) else "no error can be told"
        )
        return
    share = 100 * float(beyond[np.isfinite(known)].mean())
    panels.style(axes, f"{title}: {share:.1f} % beyond", f"{x} (last bar: and more)", "true poses")
    panels.histogram(axes, values, beyond, float(np.quantile(finite, 0.998)))


def _parameters(axes: Axes, breakdown: Breakdown, part: ParametricPart) -> None:
    values = 1000 * breakdown.truths.parameter_error
    if _unknown(axes, "Parameter error", values, part):
        return
    panels.style(axes, "Parameter error", "box: quartiles; whiskers: 5 and 95 %; dot: mean", "absolute, mm")
    panels.boxes(axes, values, part.parameter_names)


def _parameters_by_tilt(axes: Axes, breakdown: Breakdown, part: ParametricPart) -> None:
    values, bins = np.abs(1000 * breakdown.truths.parameter_error), attribute_bins(breakdown.truths)[1]
    if _unknown(axes, "Parameter error, by tilt", values, part):
        return
    _lines(
        axes, "Parameter error, by tilt", bins, dict(zip(part.parameter_names, values.T, strict=True)), "mm"
    )


def _rotation_by_tilt(axes: Axes, breakdown: Breakdown) -> None:
    bins, rotation = attribute_bins(breakdown.truths)[1], np.degrees(breakdown.truths.errors.rotation)
    _lines(axes, "Rotation error, by tilt", bins, {"rotation": rotation}, "°")


def _lines(axes: Axes, title: str, bins: Bins, values: Mapping[str, Any], unit: str) -> None:
    if not len(bins.labels):
        panels.blank(axes, title, "no true pose has one")
        return
    middle = (bins.low + bins.high) / 2
    each = {name: panels.bin_medians(bins, column) for name, column in values.items()}
    panels.style(axes, title, f"{bins.name} (solid: median, dashed: 90 %)", unit)
    medians = {name: (middle, median) for name, (median, _) in each.items()}
    panels.median_lines(axes, medians, {name: high for name, (_, high) in each.items()})
    panels.write_counts(axes, middle, bins.count)


def _keypoints(axes: Axes, breakdown: Breakdown, part: ParametricPart) -> None:
    values = 1000 * breakdown.truths.keypoint_error
    if not np.isfinite(values).any():
        panels.blank(axes, "Keypoint error", "the method estimates no keypoints")
        return
    x = "to the nearest equivalent; box as above"
    panels.style(axes, "Keypoint error", x, "mm")
    panels.boxes(axes, values, part.chain.names, signed=False)


def _keypoints_by_margin(axes: Axes, breakdown: Breakdown, part: ParametricPart) -> None:
    title, truths = "Keypoint error, by ambiguity margin", breakdown.truths
    lines: dict[str, tuple[Any, Any]] = {}
    for i, name in enumerate(part.chain.names):
        margin, error = 1000 * truths.attributes.margin[:, i], 1000 * truths.keypoint_error[:, i]
        bins = quantile_bins(name, np.where(np.isfinite(error), margin, np.nan), _MARGIN_BINS)
        if len(bins.labels):
            middle = np.array([np.median(margin[rows]) for rows in bins.member])
            lines[f"{name}, {_range(bins.count)} a bin"] = (middle, panels.bin_medians(bins, error)[0])
    if not lines:
        panels.blank(axes, title, "no keypoint has an equivalent elsewhere, or none is estimated")
        return
    panels.style(axes, title, "by how much the runner-up is worse, mm", "median, mm")
    panels.median_lines(axes, lines, {})


def _range(counts: Any) -> str:
    low, high = int(counts.min()), int(counts.max())
    return f"{low:,}" if low == high else f"{low:,}–{high:,}"


def _calibration(axes: Axes, breakdown: Breakdown) -> None:
    bins = calibration(breakdown)
    if not len(bins.low):
        panels.blank(axes, "Precision, by score", "there is no result")
        return
    places = np.arange(float(len(bins.low)))
    panels.style(axes, "Precision, by score", "score, in bins of as many results", "right / counted results")
    axes.bar(places, bins.precision, 0.78, color=panels.GOOD, zorder=3)
    axes.set_ylim(0, 1)
    panels.write_counts(axes, places, bins.counted)
    labels = [f"{a:.2f}–{b:.2f}" for a, b in zip(bins.low, bins.high, strict=True)]
    panels.name_bins(axes, places, labels)


def _unknown(axes: Axes, title: str, values: Any, part: ParametricPart) -> bool:
    """Whether there is nothing to say of parameters, and says so."""
    if part.is_fixed or not np.isfinite(values).any():
        reason = "all bodies have the same, known sizes" if part.is_fixed else "no sizes are estimated"
        panels.blank(axes, title, reason)
        return True
    return False
