"""How fast trainings learn: the validation score over scenes and over time, a panel for each part."""

import math
import re
import textwrap
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator
from numpy.typing import NDArray

from pnet.reporting.picture import write_png
from pnet.reporting.training_curves import read_scalars

DPI = 150
# Lengths below are pixels, sizes of texts are points.
_LEFT, _EDGE, _GAP, _PLOT, _LINE = 84, 20, 24, 230, 20
_AXIS = 62  # below a panel: its ticks and what they count
_PANELS = 4  # beside each other at most
_TITLE, _TEXT, _SMALL = 11.0, 8.0, 7.0
_LETTER = 7.6  # of a small text, on average
_INK, _QUIET = "#1a1a1a", "#5f6670"
# Okabe and Ito's for the colour-blind, with marks that say the same; after those the lines are dashed.
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#1a1a1a", "#e69f00", "#56b4e9")
_MARKS = "os^DvPX"
_ROWS = {"scenes": "scene iterations", "minutes": "minutes of training"}  # fields of a curve that lie on x
_DASHES = ("-", "--", ":")


@dataclass(frozen=True)
class CurveRun:
    """A training to draw.

    Attributes:
        folder: of the run. part: the template, which names the panel.
        name: words by which the run is told from others; runs of one part and name are seeds of the same.
        scenes_a_step: batch size times devices. steps: of the whole training.
        training_seconds: that these steps took, validations and interruptions left out; None where unknown.
        metric: of the validation, "mAP".
    """

    folder: Path
    part: str
    name: tuple[str, ...]
    scenes_a_step: int
    steps: int
    training_seconds: float | None
    metric: str = "mAP"


@dataclass(frozen=True, eq=False)
class Curve:
    """The validations of a run.

    Attributes:
        values: (n) scores. scenes: (n) scene iterations before each. minutes: (n) of training before each,
            NaN where unknown.
    """

    values: NDArray[np.float64]
    scenes: NDArray[np.float64]
    minutes: NDArray[np.float64]


def learning_curves(runs: Sequence[CurveRun], path: Path, title: str = "Learning curves") -> list[str]:
    """Write a PNG; the file appears when it is whole, and not at all where no run has a curve.

    Args:
        runs: in the order of the legends. path: where to write; the folder must exist.
    Returns:
        A line for each run that was left out.
    """
    curves, left_out = [], []
    for run in runs:
        curve = read_curve(run)
        if curve is None:
            left_out.append(f"{run.folder}: no val/{run.metric} in TensorBoard files, so no learning curve")
        else:
            curves.append((run, curve))
    if curves:
        write_png(curves_figure(curves, title), path)
    return left_out


def read_curve(run: CurveRun) -> Curve | None:
    """The validations that a run's TensorBoard files hold; None without any.

    The time is the step's share of the training time, which is the one that tables print. The wall times
    in the files also count validations, pauses and the days between an interruption and its end.
    """
    steps, values = read_scalars(run.folder).get(f"val/{run.metric}", ([], []))
    if not steps:
        return None
    done = np.array(steps, dtype=np.float64) + 1  # Lightning counts from 0: step 999 is after 1,000 steps
    seconds = math.nan if run.training_seconds is None or not run.steps else run.training_seconds / run.steps
    return Curve(np.array(values), done * run.scenes_a_step, done * seconds / 60)


def curves_figure(curves: Sequence[tuple[CurveRun, Curve]], title: str = "Learning curves") -> Figure:
    """The figure that `learning_curves` writes: over scene iterations above, over minutes below."""
    parts: dict[str, list[tuple[CurveRun, Curve]]] = {}
    for run, curve in curves:
        parts.setdefault(run.part, []).append((run, curve))
    layout = _layout(parts, _heading(curves, title))
    figure = Figure(figsize=(layout.width / DPI, layout.height / DPI), dpi=DPI, facecolor="white")
    _write_heading(figure, layout)
    styles = _styles(run.name for run, _ in curves)
    for i, (part, own) in enumerate(parts.items()):
        for row, (field, what) in enumerate(_ROWS.items()):
            axes = _axes(figure, layout.place(i, row), what)
            axes.tick_params(labelleft=i % layout.columns == 0)
            _draw(axes, own, field, styles)
            if i % layout.columns == 0:
                metrics = dict.fromkeys(run.metric for run, _ in own)
                axes.set_ylabel(f"validation {' or '.join(metrics)}", size=_SMALL, color=_INK)
            if row == 0:
                axes.set_title(part, size=_TEXT, color=_INK, parse_math=False)
        left, low, *_ = layout.place(i, len(_ROWS) - 1)
        _draw_legend(figure, layout.legends[i], styles, (left, low - _AXIS / layout.height))
    return figure


@dataclass(frozen=True)
class _Layout:
    """Where panels are.

    Attributes:
        lines: above them, with size and colour. columns: panels beside each other.
        legends: of each part, labels by name. head, band: heights above the panels, of a row of parts.
    """

    lines: list[tuple[str, float, str]]
    columns: int
    legends: list[dict[tuple[str, ...], str]]
    head: float
    band: float

    @property
    def width(self) -> float:
        return _width(self.columns)

    @property
    def height(self) -> float:
        return self.head + self.band * math.ceil(len(self.legends) / self.columns)

    def place(self, part: int, row: int) -> tuple[float, float, float, float]:
        """Left, bottom, width and height of a panel, as shares of the figure."""
        panel = _panel(self.columns)
        left = _LEFT + part % self.columns * (panel + _GAP)
        bottom = self.head + part // self.columns * self.band + (row + 1) * _PLOT + row * _AXIS
        return left / self.width, 1 - bottom / self.height, panel / self.width, _PLOT / self.height


def _layout(
    parts: dict[str, list[tuple[CurveRun, Curve]]], texts: Sequence[tuple[str, float, str]]
) -> _Layout:
    columns = min(len(parts), _PANELS)
    legends = [_legend([run for run, _ in own], columns) for own in parts.values()]
    tallest = max(sum(text.count("\n") + 1 for text in legend.values()) for legend in legends)
    room = _width(columns) - 2 * _EDGE
    lines = [
        (line, size, colour)
        for text, size, colour in texts
        for line in textwrap.wrap(text, int(room / (_LETTER * size / _SMALL)))
    ]
    head = 3.5 * _EDGE + sum(1.35 * size * DPI / 72 for _, size, _ in lines)
    return _Layout(lines, columns, legends, head, 2 * (_PLOT + _AXIS) + tallest * _LINE + 2.5 * _EDGE)


def _width(columns: int) -> float:
    return max(600.0, 200.0 + 250.0 * columns)


def _panel(columns: int) -> float:
    return (_width(columns) - _LEFT - _EDGE - (columns - 1) * _GAP) / columns


def short_labels(names: Iterable[tuple[str, ...]]) -> dict[tuple[str, ...], str]:
    """What tells each name from the others, in one text; all of it where there is one name.

    What all have at a place is left out, and what all begin with there ("Learn" of "Learn all" and "Learn
    1/3"). What stands in brackets stands for the whole where that tells enough.
    """
    names = list(dict.fromkeys(names))
    if len({len(name) for name in names}) != 1:
        return {name: ", ".join(filter(None, name)) for name in names}
    places = [dict.fromkeys(name[i] for name in names) for i in range(len(names[0]))]
    short = [_short(list(words)) for words in places]
    told = [i for i, words in enumerate(places) if len(words) > 1] or range(len(places))
    return {name: ", ".join(filter(None, (short[i][name[i]] for i in told))) for name in names}


def _short(words: Sequence[str]) -> dict[str, str]:
    """Words of one place, each without what it shares with all others."""
    bracketed = [re.sub(r"^.+ \((.+)\)$", r"\1", word) for word in words]
    shown = bracketed if len(set(bracketed)) == len(words) else list(words)
    while len(shown) > 1 and all(" " in word for word in shown):
        if len({word.split(" ")[0] for word in shown}) > 1:
            break
        shown = [word.split(" ", 1)[1] for word in shown]
    return dict(zip(words, shown, strict=True))


def _legend(runs: Sequence[CurveRun], columns: int) -> dict[tuple[str, ...], str]:
    """By name, in lines that fit below a panel."""
    seeds = Counter(run.name for run in runs)
    characters = max(8, int((_panel(columns) - 60) / _LETTER))
    return {
        name: "\n".join(
            textwrap.wrap(f"{label} ({seeds[name]} seeds)" if seeds[name] > 1 else label, characters)
        )
        for name, label in short_labels(seeds).items()
    }


def _heading(curves: Sequence[tuple[CurveRun, Curve]], title: str) -> list[tuple[str, float, str]]:
    """Texts above the panels, with size and colour."""
    text = "Measured here: validation scenes, scored while a run trained."
    if len({(run.part, run.name) for run, _ in curves}) < len(curves):
        text += " Thin lines are seeds, thick ones their means."
    return [(title, _TITLE, _INK), (text, _TEXT, _QUIET)]


def _write_heading(figure: Figure, layout: _Layout) -> None:
    y = float(_EDGE)
    for text, size, colour in layout.lines:
        place = (_EDGE / layout.width, 1 - y / layout.height)
        figure.text(*place, text, size=size, color=colour, va="top", parse_math=False)
        y += 1.35 * size * DPI / 72


def _styles(names: Iterable[tuple[str, ...]]) -> dict[tuple[str, ...], dict[str, Any]]:
    """Colour, mark and dashes of each name, the same in all panels."""
    count = len(_COLOURS)
    return {
        name: {
            "color": _COLOURS[i % count],
            "marker": _MARKS[i % count],
            "linestyle": _DASHES[i // count % 3],
        }
        for i, name in enumerate(dict.fromkeys(names))
    }


def _axes(figure: Figure, place: tuple[float, float, float, float], what: str) -> Axes:
    axes = figure.add_axes(place)
    axes.set(ylim=(0, 1.03), yticks=[i / 5 for i in range(6)])
    axes.set_axisbelow(True)
    axes.grid(color="#c9ced4", linewidth=0.6)
    axes.tick_params(length=0, labelsize=_SMALL, labelcolor=_QUIET)
    axes.spines[["left", "right", "top"]].set_visible(False)
    axes.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _count(value)))
    axes.set_xlabel(what, size=_SMALL, color=_INK)
    return axes


def _draw(
    axes: Axes,
    own: Sequence[tuple[CurveRun, Curve]],
    over: str,
    styles: dict[tuple[str, ...], dict[str, Any]],
) -> None:
    """The lines of a panel. over: the field of a curve that lies on x."""
    for name in dict.fromkeys(run.name for run, _ in own):
        seeds = [curve for run, curve in own if run.name == name]
        seeds = [curve for curve in seeds if np.isfinite(getattr(curve, over)).all()]
        if len(seeds) > 1:
            thin = {**styles[name], "marker": None, "linewidth": 0.8, "alpha": 0.5}
            for curve in seeds:
                axes.plot(getattr(curve, over), curve.values, **thin)
        if seeds:
            mean = mean_curve(seeds)
            axes.plot(getattr(mean, over), mean.values, linewidth=2.0, markersize=3.5, **styles[name])
    if axes.lines:
        axes.set_xlim(left=0)
    else:
        axes.set_xticks([])
        axes.text(0.5, 0.5, "not known", transform=axes.transAxes, ha="center", size=_SMALL, color=_QUIET)


def mean_curve(curves: Sequence[Curve]) -> Curve:
    """Of seeds, where all have a validation after as many scenes; one curve is its own mean."""
    shared = [scenes for scenes in curves[0].scenes if all(scenes in curve.scenes for curve in curves)]
    picked = [np.searchsorted(curve.scenes, shared) for curve in curves]
    mean = {
        field: np.mean([getattr(c, field)[at] for c, at in zip(curves, picked, strict=True)], axis=0)
        for field in ("values", "scenes", "minutes")
    }
    return Curve(**mean)


def _draw_legend(
    figure: Figure,
    texts: dict[tuple[str, ...], str],
    styles: dict[tuple[str, ...], dict[str, Any]],
    corner: tuple[float, float],
) -> None:
    handles = [
        Line2D([], [], linewidth=2.0, markersize=3.5, label=text.replace("$", r"\$"), **styles[name])
        for name, text in texts.items()
    ]
    place: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": corner, "borderaxespad": 0.0}
    figure.legend(handles=handles, frameon=False, fontsize=_SMALL, labelspacing=0.3, **place)


def _count(value: float) -> str:
    """A tick: 20k for 20,000."""
    return f"{value / 1000:g}k" if value >= 1000 else f"{value:g}"
