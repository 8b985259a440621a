"""A table of the paper beside our own figures: its records, and its text for terminals, pages and programs.

Every figure in brackets is quoted from the paper. Nothing else in these tables is.
"""

import csv
import io
import re
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby

from rich.table import Table
from rich.text import Text

from pnet.reporting.tables import MISSING

PUBLISHED_NOTE = "[ ] as published in the paper; not measured here"
# Not "ours": the paper's own method is "Ours" in its tables.
_SPREAD = "mean ± sample standard deviation over seeds"
VALUES_NOTE = f"no brackets: measured here, {_SPREAD}; {MISSING} no value; signed: measured less published"
ORIGINS = ("both", "published", "ours")
RUN_HEADINGS = (
    *("cells", "training time", "scene iterations", "steps", "seed", "parameters"),
    *("device", "commit", "data", "folder"),
)
CSV_HEADINGS = (
    *("table", "protocol", "row", "column_group", "column", "metric"),
    *("ours_mean", "ours_std", "seeds", "published", "difference"),
)
_ROUNDING = 1e-6  # how far an average precision in single precision may leave [0, 1]
_LATEX = {
    **{character: f"\\{character}" for character in "{}$&#_%"},
    **{character: f"{{{character}}}" for character in "[]*"},  # after \\ or \midrule they would be arguments
    **{"\\": r"\textbackslash{}", "^": r"\textasciicircum{}", "~": r"\textasciitilde{}"},
    **{"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}"},
    **{chr(ord("₀") + digit): f"$_{digit}$" for digit in range(10)},  # "OP-Net₁"
    **{"–": "--", "±": r"$\pm$", "×": r"$\times$", "\n": " "},
}


@dataclass(frozen=True)
class Cell:
    """A figure of ours and the paper's.

    Attributes:
        values: ours, one a seed, in [0, 1]; empty where missing or not asked for.
        published: the paper's; None where it has none.
    """

    values: tuple[float, ...] = ()
    published: float | None = None

    @property
    def mean(self) -> float | None:
        """Over seeds."""
        return statistics.fmean(self.values) if self.values else None

    @property
    def deviation(self) -> float | None:
        """Sample standard deviation over seeds; None below two."""
        return statistics.stdev(self.values) if len(self.values) > 1 else None

    @property
    def difference(self) -> float | None:
        """Our mean less the paper's figure."""
        return None if self.mean is None or self.published is None else self.mean - self.published


@dataclass(frozen=True)
class Column:
    """Adjacent columns of one group share its heading, "Learn 1/3" above "PPR-Net" and "Ours"."""

    name: str
    group: str | None = None

    @property
    def title(self) -> str:
        """Group and name in one line."""
        return f"{self.group}: {self.name}" if self.group else self.name


@dataclass(frozen=True)
class Row:
    """One cell a column.

    Attributes:
        origin: "published": never trained here; "ours": the paper has no such row; "both".
    """

    name: str
    cells: tuple[Cell, ...]
    origin: str = "both"

    @property
    def title(self) -> str:
        """The name, marked where the row is not the paper's."""
        return f"{self.name} (ours, not in the paper)" if self.origin == "ours" else self.name


@dataclass(frozen=True)
class RunFacts:
    """What stands behind figures: one run.

    Attributes:
        cells: which ones it serves, readable. scene_iterations: steps times batch size.
        parameters: of the network. commit: short, with "+changes" where the tree was changed.
        data: folder and fingerprint of the data set.
    """

    cells: str
    folder: str
    seed: int
    steps: int
    scene_iterations: int
    training_seconds: float | None
    parameters: int | None
    device: str
    commit: str
    data: str


@dataclass(frozen=True)
class PaperTable:
    """A table in the paper's layout.

    Attributes:
        number: "III". metric: "mAP on the L-dataset". protocol: "smoke".
        corner: heading of the first column. warnings: what makes figures hard to compare.
        missing: cells without a run and why, readable.
    """

    number: str
    title: str
    metric: str
    protocol: str
    corner: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    warnings: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    runs: tuple[RunFacts, ...] = ()

    def __post_init__(self) -> None:
        for row in self.rows:
            place = f"table {self.number}, row {row.name!r}"
            if len(row.cells) != len(self.columns):
                raise ValueError(f"{place}: {len(row.cells)} cells; give {len(self.columns)}, one a column")
            if row.origin not in ORIGINS:
                raise ValueError(f"{place}: origin {row.origin!r}; give one of {', '.join(ORIGINS)}")
            for column, cell in zip(self.columns, row.cells, strict=True):
                _check(f"{place}, column {column.title!r}", row.origin, cell)

    @property
    def heading(self) -> str:
        """Number and title."""
        return f"Table {self.number}: {self.title}"

    @property
    def caption(self) -> tuple[str, str, str]:
        """What the figures are: a line each for metric and protocol, for the brackets, for the rest."""
        return f"{self.metric}; protocol: {self.protocol}", PUBLISHED_NOTE, VALUES_NOTE


def rich_table(table: PaperTable) -> Table:
    """For a terminal; the warnings stand above it."""
    title = Text(table.heading)
    for warning in table.warnings:
        title.append(f"\nNote: {warning}", "yellow")
    caption = Text("\n".join([*table.caption, *(f"Missing: {reason}" for reason in table.missing)]))
    grid = Table(title=title, caption=caption, show_lines=True, title_style="bold", caption_style="")
    grid.title_justify = grid.caption_justify = "left"
    grid.add_column(Text(table.corner), overflow="fold")
    grouped = any(column.group for column in table.columns)
    for column in table.columns:
        # rich has no cells over two columns, so that each column repeats its group
        heading = f"{column.group or ''}\n{column.name}" if grouped else column.name
        grid.add_column(Text(heading), justify="right", overflow="fold")
    for row in table.rows:
        grid.add_row(Text(row.title), *(_rich_cell(*cell_texts(row, cell)) for cell in row.cells))
    return grid


def runs_table(table: PaperTable) -> Table:
    """What stands behind the figures, for a terminal."""
    title = Text(f"Table {table.number}: what stands behind")
    grid = Table(title=title, title_style="bold", title_justify="left")
    for heading in RUN_HEADINGS:
        grid.add_column(heading, overflow="fold")
    for run in table.runs:
        grid.add_row(*(Text(text) for text in _run_texts(run)))
    return grid


def markdown(table: PaperTable, below: str = "") -> str:
    """For a page: the warnings, the table, its caption, what is missing, and what stands behind.

    Args:
        below: further sections, in Markdown; they follow the caption.
    """
    headings = (table.corner, *(column.title for column in table.columns))
    rows = [
        (row.title, *(" ".join(filter(None, cell_texts(row, cell))) for cell in row.cells))
        for row in table.rows
    ]
    runs = [_run_texts(run) for run in table.runs]
    parts = [
        f"## {_escaped(table.heading)}",
        _section("Note", _bullets(table.warnings)),
        pipe_table(headings, rows, "---:"),
        "\\\n".join(_escaped(line) for line in table.caption),  # the backslash breaks the line
        below,
        _section("Missing", _bullets(table.missing)),
        _section("What stands behind", pipe_table(RUN_HEADINGS, runs, "---") if runs else ""),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def csv_text(table: PaperTable) -> str:
    """For programs: one line a cell, nothing where there is none, headings `CSV_HEADINGS`."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(CSV_HEADINGS)
    for row in table.rows:
        for column, cell in zip(table.columns, row.cells, strict=True):
            place = (table.number, table.protocol, row.title, column.group, column.name, table.metric)
            ours = (_digits(cell.mean), _digits(cell.deviation), len(cell.values) or None)
            writer.writerow((*place, *ours, cell.published, _digits(cell.difference)))
    return file.getvalue()


def latex(table: PaperTable) -> str:
    """For a paper; needs the package booktabs. A cell's texts stand one below the other."""
    notes = "".join(f" Note: {warning.rstrip('.')}." for warning in table.warnings)
    caption = f"{table.heading}. {'; '.join(table.caption)}.{notes}"
    headings = " & ".join(_tex(text) for text in (table.corner, *(column.name for column in table.columns)))
    lines = [
        r"\begin{table}",
        r"\centering",
        rf"\caption{{{_tex(caption)}}}",
        rf"\begin{{tabular}}{{l{'r' * len(table.columns)}}}",
        r"\toprule",
        *_latex_groups(table.columns),
        rf"{headings} \\",
        r"\midrule",
        *(line for row in table.rows for line in _latex_row(row)),
        r"\bottomrule",
        r"\end{tabular}",
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


def cell_texts(row: Row, cell: Cell) -> tuple[str, str, str]:
    """Ours, the published figure in brackets and the signed difference; each may be empty.

    The paper prints two decimals, and a quoted figure is never rounded. Ours and the difference have a
    third: with two, a difference of half a hundredth is a matter of rounding.
    """
    published = "" if cell.published is None else f"[{_quoted(cell.published)}]"
    if cell.mean is None:
        return "" if row.origin == "published" and published else MISSING, published, ""
    spread = "" if cell.deviation is None else f" ± {cell.deviation:.3f}"
    # adding zero takes the sign from what rounds to -0
    signed = "" if cell.difference is None else f"{round(cell.difference, 3) + 0.0:+.3f}"
    return f"{cell.mean:.3f}{spread}", published, signed


def duration_text(seconds: float | None) -> str:
    """In the two largest units."""
    if seconds is None:
        return MISSING
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


def pipe_table(headings: Sequence[str], rows: Sequence[Sequence[str]], alignment: str) -> str:
    """A table in Markdown, its first column to the left. alignment: of the others, "---:" to the right."""
    rule = ["---", *([alignment] * (len(headings) - 1))]
    texts = [[_escaped(text) for text in row] for row in (headings, *rows)]
    return "\n".join(f"| {' | '.join(row)} |" for row in (texts[0], rule, *texts[1:]))


def _check(place: str, origin: str, cell: Cell) -> None:
    published = () if cell.published is None else (cell.published,)
    for value in (*cell.values, *published):
        if not -_ROUNDING <= value <= 1 + _ROUNDING:  # NaN is neither
            raise ValueError(
                f"{place}: the value {value}; give numbers in [0, 1], or none where it is missing"
            )
    if (origin == "published" and cell.values) or (origin == "ours" and published):
        raise ValueError(f"{place}: its row is only {origin}, but this is not; give the row origin 'both'")


def _quoted(published: float) -> str:
    return f"{published:.2f}" if round(published, 2) == published else f"{published:g}"


def _digits(value: float | None) -> float | None:
    return None if value is None else round(value, 6)


def _rich_cell(ours: str, published: str, signed: str) -> Text:
    colour = {"+": "green", "-": "red"}.get(signed[:1], "") if float(signed or 0) else ""
    lines = [Text(ours), Text(published, "dim"), Text(signed, colour)]
    return Text("\n").join(line for line in lines if line)


def _run_texts(run: RunFacts) -> tuple[str, ...]:
    parameters = MISSING if run.parameters is None else f"{run.parameters:,}"
    effort = (duration_text(run.training_seconds), f"{run.scene_iterations:,}", f"{run.steps:,}")
    return (run.cells, *effort, str(run.seed), parameters, run.device, run.commit, run.data, run.folder)


def _section(heading: str, content: str) -> str:
    return f"### {heading}\n\n{content}" if content else ""


def _bullets(lines: Iterable[str]) -> str:
    return "\n".join(f"- {_escaped(line)}" for line in lines)


def _escaped(text: str) -> str:
    """Without what Markdown would read as a cell's end, a tag, code, emphasis or a new line."""
    return re.sub(r"([\\|<`*])", r"\\\1", " ".join(text.split()))


def _tex(text: str) -> str:
    return "".join(_LATEX.get(character, character) for character in text)


def _latex_groups(columns: Sequence[Column]) -> list[str]:
    """The line of group headings and the rules below them; nothing without groups."""
    headings, rules, first = [""], [], 2
    for group, members in groupby(column.group for column in columns):
        count = len(list(members))
        headings.append(rf"\multicolumn{{{count}}}{{c}}{{{_tex(group or '')}}}")
        if group:
            rules.append(rf"\cmidrule(lr){{{first}-{first + count - 1}}}")
        first += count
    return [rf"{' & '.join(headings)} \\", " ".join(rules)] if rules else []


def _latex_row(row: Row) -> list[str]:
    """A line each for ours, the published figures and the differences, where there are any."""
    texts = [cell_texts(row, cell) for cell in row.cells]
    lines = [
        [_tex(ours) for ours, _, _ in texts],
        [_tex(published) for _, published, _ in texts],
        [f"${signed}$" if signed else "" for _, _, signed in texts],
    ]
    shown = [line for line in lines if any(line)]
    names = [_tex(row.title), *([""] * len(shown))]
    return [rf"{' & '.join((name, *line))} \\" for name, line in zip(names, shown, strict=False)]
