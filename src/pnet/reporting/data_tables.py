"""A data set's numbers as tables, for the terminal and for a page."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from typing import Any, Literal

from rich.markup import escape as plain
from rich.table import Table

from pnet.reporting.tables import MISSING
from pnet.scenes.coverage import Coverage
from pnet.scenes.inspection import PileSummary, SplitSummary, Summary

_EIGHTHS = " ▏▎▍▌▋▊▉█"
_BAR = 5  # characters
_SHOWN = (
    "converted",
    "part",
    "protocol",
    "bin",
    "physics",
    "clutter",
    "camera",
    "view",
    "noise",
    "noise_in",
    "seed",
)
_UNTOLD = ("_target_", "splits", "by_part")  # the class is told first, the plan in the table of splits
_QUANTITIES: dict[str, Callable[[SplitSummary], str]] = {
    "part objects": lambda s: f"{s.part_objects:,}",
    "cycles planned": lambda s: f"{s.planned:,}",
    "whole": lambda s: f"{s.whole:,}",
    "missing": lambda s: f"{s.missing:,}",
    "damaged": lambda s: f"{s.damaged:,}",
    "extra files": lambda s: f"{s.extra:,}",
    "scenes": lambda s: f"{s.scenes:,}",
    "points a scene": lambda s: _range_text(s.points),
    "instances": lambda s: f"{s.instances:,}",
    "at most half occluded": lambda s: percent(s.to_find, s.instances),
    "size": lambda s: size_text(s.size),
    "bodies escaped": lambda s: f"{s.escaped:,}",
    "scenes unsettled": lambda s: f"{s.unsettled:,}",
    "scenes empty": lambda s: f"{s.empty:,}",
}


@dataclass(frozen=True)
class Sheet:
    """A table of plain text.

    Attributes:
        title: its heading. columns: their headings; the first is that of the rows' names.
        rows: of one text for each column. note: a sentence below, or "".
        kind: of the columns after the first: "text"; "numbers", set flush right; or "bars", numbers and
            bars of fixed width, which keep their blanks.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""
    kind: str = "numbers"


def rich_table(sheet: Sheet) -> Table:
    """For the terminal."""
    table = Table(
        title=sheet.title,
        title_justify="left",
        caption=sheet.note or None,
        caption_justify="left",
    )
    for i, column in enumerate(sheet.columns):
        is_number = sheet.kind == "numbers" and i > 0
        flush: Literal["left", "right"] = "right" if is_number else "left"
        table.add_column(plain(column), justify=flush, no_wrap=sheet.kind != "text" and i > 0)
    for row in sheet.rows:
        table.add_row(*map(plain, row))
    return table


def html_table(sheet: Sheet) -> str:
    """For a page; the text is escaped."""
    head = "".join(f"<th>{escape(column)}</th>" for column in sheet.columns)
    rows = (
        f"<tr><th>{escape(name)}</th>{''.join(f'<td>{escape(cell)}</td>' for cell in cells)}</tr>"
        for name, *cells in sheet.rows
    )
    note = f'<p class="quiet">{escape(sheet.note)}</p>' if sheet.note else ""
    return "\n".join(
        (
            f'<h2>{escape(sheet.title)}</h2>\n<table class="sheet {sheet.kind}"><tr>{head}</tr>',
            *rows,
            f"</table>{note}",
        )
    )


def summary_sheets(settings: Mapping[str, Any], summary: Summary) -> list[Sheet]:
    """Everything that a summary tells, settings first."""
    sheets = [settings_sheet(settings), split_sheet(summary.splits), visibility_sheet(summary.splits)]
    sheets.append(coverage_sheet(summary.coverage))
    return [*sheets, pile_sheet(summary.piles)] if summary.piles.planned else sheets


def settings_sheet(settings: Mapping[str, Any]) -> Sheet:
    """What made the data set. settings: the manifest's."""
    rows = [(key, _setting_text(settings[key])) for key in _SHOWN if key in settings]
    return Sheet("Settings", ("setting", "value"), rows, kind="text")


def split_sheet(splits: Mapping[str, SplitSummary]) -> Sheet:
    """Quantities of each split."""
    rows = [(name, *map(text, splits.values())) for name, text in _QUANTITIES.items()]
    return Sheet("Splits", ("", *splits), rows)


def visibility_sheet(splits: Mapping[str, SplitSummary]) -> Sheet:
    """Instances by visibility."""
    bins = len(next(iter(splits.values())).visibility)
    rows = [
        (f"{i / bins:.1f} to {(i + 1) / bins:.1f}", *(_bar_cell(s.visibility, i) for s in splits.values()))
        for i in range(bins)
    ]
    return Sheet("Instances by visibility", ("visibility", *splits), rows, kind="bars")


def coverage_sheet(coverage: Mapping[str, Coverage]) -> Sheet:
    """How evenly each kind of scene shows the part from all sides."""
    rows = [
        (kind, f"{c.instances:,}", f"{c.cells:,}", _share_text(c.share), _share_text(c.rare))
        for kind, c in coverage.items()
    ]
    columns = ("scenes of", "instances", "directions", "coverage", "rare directions")
    note = (
        "Of the instances that are at most half occluded. Coverage 100% is uniform; rare directions hold "
        "less than a quarter of the uniform share."
    )
    return Sheet("Orientations", columns, rows, note)


def pile_sheet(piles: PileSummary) -> Sheet:
    """The files of the first stage."""
    counts = (f"{n:,}" for n in (piles.planned, piles.whole, piles.missing, piles.damaged))
    columns = ("", "planned", "whole", "missing", "damaged", "size")
    return Sheet("Piles", columns, [("cycles", *counts, size_text(piles.size))])


def summary_values(settings: Mapping[str, Any], summary: Summary) -> dict[str, Any]:
    """The same as plain values: bytes, counts, shares in [0, 1]."""
    return {"settings": dict(settings), **asdict(summary)}


def size_text(size: int) -> str:
    """Bytes for people, in powers of 1000."""
    value, units = float(size), ["B", "kB", "MB", "GB", "TB"]
    while value >= 999.5 and len(units) > 1:
        value, units = value / 1000, units[1:]
    return f"{value:.0f} {units[0]}" if value >= 100 or units[0] == "B" else f"{value:.1f} {units[0]}"


def percent(part: int, whole: int) -> str:
    """A share; a dash of nothing."""
    return _share_text(part / whole if whole else math.nan)


def bar(share: float, width: int = _BAR) -> str:
    """A bar of `width` characters, in eighths of one; something can be seen of anything above 0."""
    eighths = max(round(8 * width * share), 1 if share > 0 else 0)
    full, rest = divmod(eighths, 8)
    return ("█" * full + _EIGHTHS[rest] * (rest > 0)).ljust(width)


def _bar_cell(counts: Sequence[int], i: int) -> str:
    most = max(*counts, 1)
    return f"{counts[i]:>{len(f'{most:,}')},} {bar(counts[i] / most)}"


def _share_text(share: float) -> str:
    return MISSING if math.isnan(share) else f"{100 * share:.1f}%"


def _range_text(ends: tuple[int, int]) -> str:
    low, high = ends
    if not high:
        return MISSING
    return f"{low:,}" if low == high else f"{low:,} to {high:,}"


def _setting_text(value: Any) -> str:
    """A setting on one line: the class that it builds, then its own values."""
    if isinstance(value, Mapping):
        name = str(value.get("_target_", "")).rsplit(".", 1)[-1]
        pairs = (f"{key} {_setting_text(item)}" for key, item in value.items() if key not in _UNTOLD)
        return ": ".join(filter(None, (name, ", ".join(pairs))))
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_setting_text, value)) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value)
