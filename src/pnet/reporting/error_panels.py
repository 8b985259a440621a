"""Panels of the figure of errors: bars of shares, boxes, lines, histograms, and the way from 1 to AP."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from pnet.metrics.outcomes import Outcome
from pnet.reporting.breakdown_bins import FEW, Bins

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

TITLE, TEXT, SMALL = 8.5, 7.0, 6.0  # points
INK, QUIET, GRID = "#1a1a1a", "#5f6670", "#c9ced4"
GOOD, BAD = "#0072b2", "#d55e00"
# Okabe and Ito: told apart by the colour-blind, and by lightness in print
OUTCOME_COLOURS = {
    Outcome.FOUND: GOOD,
    Outcome.MISSED: "#3d434b",
    Outcome.MERGED: "#e69f00",
    Outcome.SPLIT: "#cc79a7",
    Outcome.WRONG_POSE: BAD,
}
LINES = (
    *(("#0072b2", "o"), ("#d55e00", "s"), ("#009e73", "^")),
    *(("#cc79a7", "D"), ("#e69f00", "v"), ("#3d434b", "P")),
)  # colours and marks, which say the same
_PALE = 0.45  # of bars that stand for few
LOST = [outcome for outcome in Outcome if outcome is not Outcome.FOUND]


def style(axes: Axes, title: str, x: str = "", y: str = "") -> None:
    """Heading, names of the axes, and a quiet grid."""
    axes.set_title(title, size=TITLE, color=INK, loc="left", pad=12)
    axes.set_xlabel(x, size=TEXT, color=QUIET, labelpad=2)
    axes.set_ylabel(y, size=TEXT, color=QUIET, labelpad=3)
    axes.set_axisbelow(True)
    axes.grid(axis="y", color=GRID, linewidth=0.6)
    axes.tick_params(length=0, labelsize=TEXT, labelcolor=QUIET, pad=2)
    axes.spines[["left", "right", "top"]].set_visible(False)


def blank(axes: Axes, title: str, reason: str) -> None:
    """A panel with nothing to show, and why."""
    style(axes, title)
    axes.set(xticks=[], yticks=[], xlim=(0, 1), ylim=(0, 1))
    axes.text(0.5, 0.5, reason, size=TEXT, color=QUIET, ha="center", va="center", wrap=True)


def lost_shares(
    axes: Axes, places: Floats, shares: Mapping[Outcome, Floats], count: NDArray[np.int64]
) -> None:
    """Stacked shares of the outcomes other than found; the counts stand above, few ones are pale.

    Args:
        places: (b,) of the bars. shares: (b,) of each outcome. count: (b,) rows of each bin.
    """
    bottom = np.zeros(len(places))
    few = np.where(count < FEW, _PALE, 1.0)
    for outcome in LOST:
        bars = axes.bar(places, shares[outcome], 0.78, bottom, color=OUTCOME_COLOURS[outcome], zorder=3)
        for bar, alpha in zip(bars, few, strict=True):
            bar.set_alpha(float(alpha))
        bottom += shares[outcome]
    top = min(1.0, max(1.12 * float(bottom.max(initial=0)), 0.01))
    axes.set_ylim(0, top)
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.yaxis.set_major_formatter(lambda value, _: f"{100 * value:g} %")
    write_counts(axes, places, count)


def write_counts(axes: Axes, places: Floats, count: Sequence[int] | NDArray[np.int64]) -> None:
    """How many stand behind each place, above the axes."""
    for x, n in zip(places, count, strict=True):
        axes.text(
            float(x),
            1.015,
            f"{n:,}",
            size=SMALL,
            color=QUIET,
            ha="center",
            transform=axes.get_xaxis_transform(),
        )


def name_bins(axes: Axes, places: Floats, labels: Sequence[str]) -> None:
    """Labels below bars, slanted where they are long."""
    turned = max((len(label) for label in labels), default=0) * len(labels) > 36
    axes.set_xticks(places, labels)
    if turned:
        axes.tick_params(axis="x", labelrotation=35, labelsize=SMALL)
        for label in axes.get_xticklabels():
            label.set(ha="right", rotation_mode="anchor")


def boxes(axes: Axes, columns: Floats, names: Sequence[str], signed: bool = True) -> None:
    """Absolute values in boxes: median, quartiles, 5 and 95 percent; a dot for the mean, which is written.

    Args:
        columns: (n, c) some NaN. names: (c). signed: whether the mean of the signed values is written too.
    """
    absolute = [np.abs(column[np.isfinite(column)]) for column in columns.T]
    drawn = [column if len(column) else np.array([np.nan]) for column in absolute]
    line: dict[str, Any] = {"color": INK, "linewidth": 0.8}
    looks = {"boxprops": {"facecolor": "#a9cbe4", **{"edgecolor": INK, "linewidth": 0.8}}}
    axes.boxplot(
        drawn,
        widths=0.5,
        whis=(5, 95),
        showfliers=False,
        patch_artist=True,
        medianprops={"color": INK, "linewidth": 1.6},
        whiskerprops=line,
        capprops=line,
        **looks,  # type: ignore[arg-type]
    )
    for i, (column, values) in enumerate(zip(columns.T, absolute, strict=True), 1):
        if len(values):
            axes.plot(i, values.mean(), marker="D", color=BAD, markersize=3.5, zorder=4)
            bias = f"\nbias {np.nanmean(column):+.2f}" if signed else ""
            told = f"mean {values.mean():.2f}{bias}\nn {len(values):,}"
            place: dict[str, Any] = {"transform": axes.get_xaxis_transform(), "ha": "center", "va": "top"}
            axes.text(i, 0.99, told, size=SMALL, color=INK, linespacing=1.1, **place)
    axes.set_xticks(range(1, len(names) + 1), names)
    axes.set_ylim(0, 1.25 * max(axes.get_ylim()[1], 1e-6))


def median_lines(
    axes: Axes, lines: Mapping[str, tuple[Floats, Floats]], dashed: Mapping[str, Floats]
) -> None:
    """Lines with marks, and dashed ones of the same colour.

    Args:
        lines: name → x and y. dashed: name → y of a second, pale line.
    """
    for i, (name, (x, y)) in enumerate(lines.items()):
        colour, mark = LINES[i % len(LINES)]
        axes.plot(x, y, color=colour, marker=mark, markersize=3.5, linewidth=1.4, label=name, zorder=3)
        if name in dashed:
            axes.plot(x, dashed[name], color=colour, linewidth=0.8, linestyle=(0, (4, 2)), alpha=0.8)
    axes.set_ylim(bottom=0)
    if lines:
        axes.legend(fontsize=SMALL, frameon=False, loc="best", handlelength=1.8, labelspacing=0.25)


def bin_medians(bins: Bins, values: Floats) -> tuple[Floats, Floats]:
    """(b,) medians and 90 % quantiles of the finite values (n,) in each bin; NaN where there is none."""
    medians, high = np.full(len(bins.member), np.nan), np.full(len(bins.member), np.nan)
    for i, rows in enumerate(bins.member):
        own = values[rows & np.isfinite(values)]
        if len(own):
            medians[i], high[i] = np.quantile(own, [0.5, 0.9])
    return medians, high


def histogram(axes: Axes, values: Floats, beyond: Bools, most: float) -> None:
    """Counts on a logarithmic scale, of what is beyond the threshold by itself and of the rest.

    Args:
        values: (n,) some NaN. beyond: (n,) bool. most: the last bin holds everything larger.
    """
    edges = np.linspace(0, most, 41)
    known = np.isfinite(values)
    kept = np.minimum(values, edges[-1] * (1 - 1e-9))
    groups = [kept[known & ~beyond], kept[known & beyond]]
    labels = [f"within ({len(groups[0]):,})", f"beyond by it alone ({len(groups[1]):,})"]
    looks: dict[str, Any] = {"histtype": "stepfilled", "alpha": 0.65}
    for group, colour, label in zip(groups, (GOOD, BAD), labels, strict=True):
        axes.hist(group, bins=list(edges), color=colour, label=label, **looks)
    axes.set_yscale("log")
    axes.set_ylim(0.7, 3 * axes.get_ylim()[1])
    axes.set_xlim(0, most)
    axes.legend(fontsize=SMALL, frameon=False, loc="upper right", ncols=2, handlelength=1.2)


def told_bars(axes: Axes, counts: Mapping[str, int], texts: Sequence[str], colours: Sequence[str]) -> None:
    """Bars to the right, the first on top, a text in or beside each."""
    axes.grid(axis="x", color=GRID, linewidth=0.6)
    axes.grid(visible=False, axis="y")
    places, most = [-float(i) for i in range(len(counts))], max(1, *counts.values())
    axes.barh(places, list(counts.values()), 0.62, color=colours, zorder=3)
    for y, n, told in zip(places, counts.values(), texts, strict=True):
        inside = n > 0.5 * most
        x, side = (n - 0.015 * most, "right") if inside else (n + 0.015 * most, "left")
        style = {"size": SMALL + 0.5, "color": "white" if inside else INK, "zorder": 5}
        axes.text(x, y, told, ha=side, va="center", **style)  # type: ignore[arg-type]
    axes.set_yticks(places, list(counts))
    axes.set_xlim(0, 1.05 * most)
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))


def waterfall(axes: Axes, ap: float, losses: Mapping[str, float], colours: Mapping[str, str]) -> None:
    """From 1 down to AP, one step for each loss; the axis begins where it can be seen."""
    names, level = list(losses), 1.0
    floor = max(0.0, 1 - 1.25 * max(1 - ap, 0.004)) if ap > 0.5 else 0.0
    axes.bar(0, 1 - floor, 0.7, floor, color="#d9dee4", zorder=3)
    for i, (name, loss) in enumerate(losses.items(), 1):
        axes.bar(i, loss, 0.7, level - loss, color=colours[name], zorder=3)
        axes.plot([i - 1.35, i + 0.35], [level, level], color=INK, linewidth=0.6, zorder=4)
        level -= loss
        _above(axes, i, level + loss, f"−{loss:.3f}" if loss >= 0.0005 else "0")
    _above(axes, 0, 1.0, "1")
    axes.bar(len(names) + 1, ap - floor, 0.7, floor, color=GOOD, zorder=3)
    _above(axes, len(names) + 1, ap, f"{ap:.3f}")
    axes.set_ylim(floor, 1 + 0.09 * (1 - floor))
    axes.set_xticks(range(len(names) + 2), ["perfect", *(name.replace(" ", "\n") for name in names), "AP"])
    axes.tick_params(axis="x", labelsize=SMALL)


def _above(axes: Axes, x: float, y: float, told: str) -> None:
    axes.annotate(
        told,
        (x, y),
        (0, 2),
        textcoords="offset points",
        size=SMALL,
        color=INK,
        ha="center",
        va="bottom",
        zorder=5,
    )
