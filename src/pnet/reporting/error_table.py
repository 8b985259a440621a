"""The errors beside a table of the paper: each parameter, position and axis of what was found.

No paper of this line reports parameter errors, so there is nothing published to stand beside them.
"""

import csv
import io
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rich.table import Table
from rich.text import Text

from pnet.reporting.paper_table import Column, PaperTable, Row, pipe_table
from pnet.reporting.tables import MISSING

TITLE = "Parameter errors, mm"
CAPTION = "mean absolute errors of the bodies that were found, means over seeds; measured here"
PARAMETERS, POSITION, AXIS = "parameter_error_mm", "position_error_mm", "axis_error_deg"


@dataclass(frozen=True)
class CellErrors:
    """What a cell's evaluations say of errors, means over seeds.

    Attributes:
        row, column: of the cell. metric: of the table, "mAP". seeds: how many.
        parameters: names of those that have an error of their own, in the part's order.
        means: by key of an evaluation's metrics; None where an evaluation lacks it.
    """

    row: Row
    column: Column
    metric: str
    seeds: int
    parameters: tuple[str, ...]
    means: Mapping[str, float | None]

    @property
    def name(self) -> str:
        """Row and column in one line."""
        return f"{self.row.name} / {self.column.title}"


def cell_errors(
    row: Row, column: Column, metric: str, scores: Sequence[Mapping[str, Any]], order: Sequence[str] = ()
) -> CellErrors | None:
    """The errors of a cell; None where no evaluation has parameter errors.

    Args:
        scores: an evaluation's metrics for each seed, as metrics.json has them: NaN is None there.
        order: names of the part's parameters; the file has its keys in alphabetical order.
    """
    if not any(_is_number(each.get(PARAMETERS)) for each in scores):
        return None
    first = f"{PARAMETERS}/"
    named = {key.removeprefix(first) for each in scores for key in each if key.startswith(first)}
    found = [*(name for name in order if name in named), *sorted(named - {*order})]
    keys = (metric, PARAMETERS, *(first + name for name in found), POSITION, AXIS)
    means = {key: _mean([each.get(key) for each in scores]) for key in keys}
    return CellErrors(row, column, metric, len(scores), tuple(found), means)


def errors_rich(table: PaperTable, cells: Sequence[CellErrors]) -> Table:
    """For a terminal. cells: at least one."""
    title = Text(f"Table {table.number}: {TITLE}", "bold")
    grid = Table(title=title, caption=Text(CAPTION), caption_style="")
    grid.title_justify = grid.caption_justify = "left"
    first, *others = _headings(cells)
    longest = max(len(word) for cell in cells for word in cell.name.split())
    grid.add_column(first, overflow="fold", min_width=longest)
    for heading in others:
        grid.add_column(Text(heading), justify="right", overflow="fold")
    for cell in cells:
        grid.add_row(*(Text(text) for text in _texts(cell)))
    return grid


def errors_markdown(cells: Sequence[CellErrors]) -> str:
    """A section of a page; nothing without cells."""
    if not cells:
        return ""
    rows = [_texts(cell) for cell in cells]
    return f"### {TITLE}\n\n{pipe_table(_headings(cells), rows, '---:')}\n\n{CAPTION}"


def errors_csv(table: PaperTable, cells: Sequence[CellErrors]) -> str:
    """For programs: one line a cell, a column for each parameter of any part, nothing where it has none."""
    names = dict.fromkeys(name for cell in cells for name in cell.parameters)
    keys = (PARAMETERS, *(f"{PARAMETERS}/{name}" for name in names), POSITION, AXIS)
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(
        ("table", "protocol", "row", "column_group", "column", "metric", "ours_mean", "seeds", *keys)
    )
    for cell in cells:
        column = cell.column
        place = (table.number, table.protocol, cell.row.title, column.group, column.name, table.metric)
        values = [_digits(cell.means.get(key)) for key in (cell.metric, *keys)]
        writer.writerow((*place, values[0], cell.seeds, *values[1:]))
    return file.getvalue()


def _headings(cells: Sequence[CellErrors]) -> tuple[str, ...]:
    return "cell", cells[0].metric, "mean", "each", "position, mm", "axis, °"


def _texts(cell: CellErrors) -> tuple[str, ...]:
    def text(key: str, decimals: int = 2) -> str:
        value = cell.means[key]
        return MISSING if value is None else f"{value:.{decimals}f}"

    each = ", ".join(f"{name} {text(f'{PARAMETERS}/{name}')}" for name in cell.parameters)
    return cell.name, text(cell.metric, 3), text(PARAMETERS), each or MISSING, text(POSITION), text(AXIS)


def _mean(values: Sequence[Any]) -> float | None:
    """None where one is missing: a mean over some seeds would pass for one over all."""
    return statistics.fmean(values) if all(map(_is_number, values)) else None


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def _digits(value: float | None) -> float | None:
    return None if value is None else round(value, 6)
