"""A table of the paper as bars: ours filled, the published ones hollow, a cluster of them for each column."""

import math
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.textpath import text_to_path

from pnet.reporting.paper_table import PUBLISHED_NOTE, Cell, Column, PaperTable, Row, cell_texts
from pnet.reporting.picture import write_png

WIDTH, DPI = 1200, 150
# Lengths below are pixels, sizes of texts are points.
_PLOT = 340  # height of the axes
_LEFT, _RIGHT, _EDGE = 108, 16, 20
_SLOTS = 54  # bars and gaps beside each other at most: the name below a bar must stay legible
_BAR = 46  # width at most
_LINE = 19
_NAME = 210  # a turned name is longer only where it needs to be
_TITLE, _TEXT, _SMALL = 11.0, 8.0, 7.0
# The colour-blind can tell blue from vermilion (Okabe and Ito), and fill and outline say the same.
_OURS, _PUBLISHED, _INK, _QUIET, _SHADE = "#0072b2", "#b84700", "#1a1a1a", "#5f6670", "#f1f3f6"
_COLOURS = (_OURS, _PUBLISHED)
_MISSING_STYLE: dict[str, Any] = {"color": _INK, "linewidth": 2.0, "solid_capstyle": "butt", "zorder": 3}


@dataclass(frozen=True)
class Layout:
    """What all bands of clusters share.

    Attributes:
        rows, columns: bars of a cluster, clusters of a band. top: value at the upper border of the axes.
        groups, headings, numbers, names: heights, pixels.
    """

    rows: int
    columns: int
    top: float = 1.0
    groups: float = 0.0
    headings: float = 0.0
    numbers: float = 0.0
    names: float = 0.0

    @property
    def slot(self) -> float:
        """Pixels from a bar to the next; a gap between clusters is as wide."""
        return (WIDTH - _LEFT - _RIGHT) / (self.columns * (self.rows + 1) - 0.4)

    @property
    def above(self) -> float:
        """Pixels from the upper border of a band to its axes."""
        return self.groups + self.headings + 2 * self.numbers

    @property
    def band(self) -> float:
        """Pixels from a band to the next."""
        return self.above + _PLOT + self.names + 1.4 * _EDGE

    def heading(self, text: str, columns: int = 1) -> str:
        """The lines of a text above so many columns."""
        return "\n".join(_wrapped(text, _TEXT, (columns * (self.rows + 1) - 0.3) * self.slot))

    def height(self, texts: Iterable[str]) -> float:
        """Of texts at a bar, which are turned where one is wider than a bar and its gap."""
        texts = list(texts)
        # as drawn a text is up to some percent wider: each letter begins on a pixel
        if 1.04 * max(_width(text, _SMALL) for text in texts) + 5 <= self.slot:
            return _LINE
        return 12 + max(_width(line, _SMALL) for text in texts for line in self.turned(text).split("\n"))

    def turned(self, text: str) -> str:
        """A long text in as many lines as stand beside each other at a bar."""
        fitting = max(1, int(self.slot // _LINE))
        room = max(_NAME, _width(text, _SMALL) / fitting)
        while len(lines := _wrapped(text, _SMALL, room)) > fitting:
            room *= 1.1
        return "\n".join(lines)


def chart(table: PaperTable, path: Path) -> None:
    """Write a PNG; the file appears when it is whole.

    Args:
        table: with rows and columns. path: where to write; the folder must exist.
    """
    write_png(chart_figure(table), path)


def chart_figure(table: PaperTable) -> Figure:
    """The figure that `chart` writes; many columns are spread over bands one below the other."""
    if not table.rows or not table.columns:
        raise ValueError(f"table {table.number}: nothing to draw; give at least one row and one column")
    lines, layout = _heading(table), _layout(table)
    bands = range(0, len(table.columns), layout.columns)
    top = 1.5 * _EDGE + sum(_line_height(size) for _, size, _ in lines)
    height = math.ceil(top + len(bands) * layout.band + _LINE + _EDGE)
    figure = Figure(figsize=(WIDTH / DPI, height / DPI), dpi=DPI, facecolor="white")
    _write_heading(figure, lines)
    for i, first in enumerate(bands):
        axes = _axes(figure, top + i * layout.band + layout.above, layout)
        _draw_clusters(axes, table, first, layout)
        _draw_groups(axes, table.columns[first : first + layout.columns], layout)
    _draw_legend(figure)
    return figure


def _heading(table: PaperTable) -> list[tuple[str, float, str]]:
    """Lines above the bars, with size and colour; among them what makes the figures hard to compare."""
    texts = [(table.heading, _TITLE, _INK), (table.caption[0], _TEXT, _QUIET)]
    texts += [(f"Note: {warning}", _TEXT, _INK) for warning in table.warnings]
    room = WIDTH - 3 * _EDGE
    return [(line, size, colour) for text, size, colour in texts for line in _wrapped(text, size, room)]


def _write_heading(figure: Figure, lines: Iterable[tuple[str, float, str]]) -> None:
    height, y = figure.bbox.height, float(_EDGE)
    for text, size, colour in lines:
        figure.text(_EDGE / WIDTH, 1 - y / height, text, size=size, color=colour, va="top", parse_math=False)
        y += _line_height(size)


def _layout(table: PaperTable) -> Layout:
    rows, columns = len(table.rows), table.columns
    bands = math.ceil(len(columns) / max(1, _SLOTS // (rows + 1)))
    plain = Layout(rows, math.ceil(len(columns) / bands))
    cells = [(row, cell) for row in table.rows for cell in row.cells]
    ends = [(cell.mean or 0) + (cell.deviation or 0) for _, cell in cells]
    spans = [
        plain.heading(group, last - first + 1)
        for i in range(0, len(columns), plain.columns)
        for group, first, last in _spans(columns[i : i + plain.columns])
    ]
    return replace(
        plain,
        top=max(1.03, max(ends) + 0.02),
        groups=_lines(spans) * _LINE + 14 if spans else 0,
        headings=_lines(plain.heading(column.name) for column in columns) * _LINE + 8,
        numbers=plain.height(text for row, cell in cells for text in _numbers(row, cell)),
        names=plain.height(row.title for row in table.rows),
    )


def _axes(figure: Figure, top: float, layout: Layout) -> Axes:
    """Axes of one band: x counts bars and gaps, y is the value."""
    height, width = figure.bbox.height, WIDTH - _LEFT - _RIGHT
    axes = figure.add_axes((_LEFT / WIDTH, 1 - (top + _PLOT) / height, width / WIDTH, _PLOT / height))
    right = layout.columns * (layout.rows + 1) - 1.2
    axes.set(xlim=(-0.8, right), ylim=(0, layout.top), xticks=[], yticks=[i / 5 for i in range(6)])
    axes.set_axisbelow(True)
    axes.grid(axis="y", color="#c9ced4", linewidth=0.6)
    axes.tick_params(length=0, labelsize=_TEXT, labelcolor=_QUIET)
    axes.spines[["left", "right", "top"]].set_visible(False)
    return axes


def _draw_clusters(axes: Axes, table: PaperTable, first: int, layout: Layout) -> None:
    """The columns of a band, from one on."""
    for i, column in enumerate(table.columns[first : first + layout.columns]):
        start, end = _ends(i, i, layout)
        axes.axvspan(start, end, color=_SHADE, linewidth=0, zorder=0)
        y = 2 * layout.numbers + 4
        _write(axes, (start + end) / 2, y, layout.heading(column.name), size=_TEXT)
        for j, row in enumerate(table.rows):
            _draw_cell(axes, i * (layout.rows + 1) + j, row, row.cells[first + i], layout)
    for line, text in enumerate(("here", "[published]")):
        y = (line + 0.5) * layout.numbers
        _write(axes, -0.8 - 6 / layout.slot, y, text, ha="right", va="center", color=_COLOURS[line])


def _draw_groups(axes: Axes, columns: Sequence[Column], layout: Layout) -> None:
    """Headings above adjacent columns, underlined as far as they go."""
    y = layout.above - layout.groups + 4
    for group, first, last in _spans(columns):
        start, end = _ends(first, last, layout)
        height = [1 + y / _PLOT] * 2
        place = axes.get_xaxis_transform()
        axes.plot([start, end], height, color=_INK, linewidth=0.8, clip_on=False, transform=place)
        _write(axes, (start + end) / 2, y + 4, layout.heading(group, last - first + 1), size=_TEXT)


def _draw_cell(axes: Axes, x: float, row: Row, cell: Cell, layout: Layout) -> None:
    """Ours within the outline of the published one; the numbers above, the row's name below."""
    width = min(0.8, _BAR / layout.slot)
    if cell.published is not None:
        axes.bar(x, cell.published, width, fill=False, edgecolor=_PUBLISHED, linewidth=1.3, zorder=2)
    if cell.mean is not None:
        ticks = {"ecolor": _INK, "elinewidth": 1.0, "capsize": 2.0, "capthick": 1.0, "zorder": 4}
        axes.bar(x, cell.mean, 0.6 * width, color=_OURS, yerr=cell.deviation, error_kw=ticks, zorder=3)
    elif row.origin != "published":
        axes.plot([x - 0.3 * width, x + 0.3 * width], [0.015, 0.015], **_MISSING_STYLE)
    turned = layout.numbers > _LINE
    for line, text in enumerate(_numbers(row, cell)):
        y = (line + 0.5) * layout.numbers
        _write(axes, x, y, text, color=_COLOURS[line], va="center", rotation=90 * turned)
    turned = layout.names > _LINE
    name = layout.turned(row.title) if turned else row.title
    _write(axes, x, -_PLOT - 8, name, va="top", rotation=90 * turned, multialignment="right")


def _draw_legend(figure: Figure) -> None:
    handles = [
        Patch(facecolor=_OURS, label="measured here: mean ± deviation over seeds"),
        Patch(facecolor="none", edgecolor=_PUBLISHED, linewidth=1.3, label=PUBLISHED_NOTE),
        Line2D([], [], label="missing: no value measured here", **_MISSING_STYLE),
    ]
    place: dict[str, Any] = {"loc": "lower center", "bbox_to_anchor": (0.5, 0.0), "borderaxespad": 0.6}
    figure.legend(handles=handles, ncols=3, frameon=False, fontsize=_SMALL, **place)


def _ends(first: int, last: int, layout: Layout) -> tuple[float, float]:
    """Left and right border of adjacent clusters, in bars."""
    return first * (layout.rows + 1) - 0.7, last * (layout.rows + 1) + layout.rows - 0.3


def _spans(columns: Sequence[Column]) -> Iterator[tuple[str, int, int]]:
    """Groups of adjacent columns with the places of the first and the last."""
    for group, members in groupby(range(len(columns)), lambda i: columns[i].group):
        places = list(members)
        if group:
            yield group, places[0], places[-1]


def _numbers(row: Row, cell: Cell) -> tuple[str, str]:
    """Ours and the published one as the table has them; the spread is drawn."""
    ours, published, _ = cell_texts(row, cell)
    return ours.split(" ")[0], published


def _write(axes: Axes, x: float, y: float, text: str, **style: Any) -> None:
    """Text at a bar, pixels above the axes; its lower end is there unless the style says otherwise."""
    style = {"size": _SMALL, "color": _INK, "ha": "center", "va": "bottom", **style}
    place = axes.get_xaxis_transform()
    axes.text(x, 1 + y / _PLOT, text, transform=place, parse_math=False, linespacing=1.0, **style)


def _wrapped(text: str, size: float, room: float) -> list[str]:
    """Lines that are no wider than there is room."""
    lines, characters = [text], len(text)
    while characters > 1 and max(_width(line, size) for line in lines) > room:
        # by the width of the average letter at first, then one by one
        characters = min(characters - 1, int(len(text) * room / _width(text, size)) + 1)
        lines = textwrap.wrap(text, max(1, characters))
    return lines


def _lines(texts: Iterable[str]) -> int:
    return max(text.count("\n") + 1 for text in texts)


def _width(text: str, size: float) -> float:
    """Pixels."""
    width, _, _ = text_to_path.get_text_width_height_descent(text, FontProperties(size=size), ismath=False)
    return width * DPI / 72


def _line_height(size: float) -> float:
    return 1.35 * size * DPI / 72
