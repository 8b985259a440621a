"""pnet-table: the paper's tables, our figures beside the published ones."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from pnet.cli.app import key_of, run_app, short_name
from pnet.cli.jobs import cell_evaluation, composed, restricted
from pnet.cli.runs import RunIndex, read_metrics
from pnet.cli.sweep_file import CellPlan, TablePlan, read_sweep
from pnet.cli.table_runs import Collected, Served, curve_runs, error_rows, mixtures, run_facts

if TYPE_CHECKING:
    from rich.console import Console

    from pnet.reporting.paper_table import PaperTable

OWN = ("table", "runs", "output")  # the command's own keys; all others are those of the sweep


def main() -> None:
    """Entry point."""
    run_app(table, "table")


def table(cfg: DictConfig) -> None:
    """Collect, print and write each table."""
    from rich.console import Console

    words = [word for word in HydraConfig.get().overrides.task if key_of(word) not in OWN]
    out, folder = Console(soft_wrap=True), Path(cfg.output)
    index = RunIndex(Path(cfg.runs))
    for plan in read_sweep(sweep_name(str(cfg.table))):
        collected = Collected(plan)
        found = collect(plan, words, index, " ".join([cfg.protocol.name, *further(words)]), collected)
        stem = folder / short_name(
            "_".join([f"table_{plan.number}", cfg.protocol.name, *further(words)]).replace("=", "-")
        )
        present(found, collected, index, stem, out)


def present(found: "PaperTable", collected: Collected, index: RunIndex, stem: Path, out: "Console") -> None:
    """Print a table and write its files.

    Args:
        collected: what it was made of. stem: where its files go, without their endings.
    """
    from pnet.reporting.error_table import errors_csv, errors_markdown, errors_rich
    from pnet.reporting.learning_curves import learning_curves
    from pnet.reporting.paper_chart import chart
    from pnet.reporting.paper_table import csv_text, latex, markdown, rich_table
    from pnet.scenes.record_file import write_atomically

    errors = error_rows(collected, index)
    texts = {".md": markdown(found, errors_markdown(errors)), ".csv": csv_text(found), ".tex": latex(found)}
    out.print(rich_table(found))
    if errors:
        texts["_errors.csv"] = errors_csv(found, errors)
        out.print(errors_rich(found, errors))
    stem.parent.mkdir(parents=True, exist_ok=True)
    for ending, text in texts.items():
        write_atomically(stem.with_name(stem.name + ending), text.encode())
    chart(found, stem.with_name(f"{stem.name}.png"))
    runs = curve_runs(collected, index)
    title = f"{found.heading}. Learning curves; protocol: {found.protocol}"
    left_out = learning_curves(runs, stem.with_name(f"{stem.name}_curves.png"), title)
    for line in (*found.missing, *left_out):
        out.print(f"· {line}", markup=False)
    out.print(standing(found))
    curves = ["_curves.png"] if len(left_out) < len(runs) else []
    out.print(f"written to {stem}{', '.join([*texts, '.png', *curves])}\n", markup=False)


def further(words: Sequence[str]) -> list[str]:
    """The overrides that tell this table from the plain one of its protocol."""
    return [word for word in words if key_of(word) != "protocol"]


def standing(table: "PaperTable") -> str:
    """How much training a table stands on, in a line; the Markdown file has it for each run."""
    from pnet.reporting.paper_table import duration_text

    if not table.runs:
        return f"no run yet: pnet-train --multirun sweep=table… protocol={table.protocol} makes them"
    seconds = sum(run.training_seconds or 0.0 for run in table.runs)
    scenes = sorted(run.scene_iterations for run in table.runs)
    each = f"{scenes[0]:,}" if scenes[0] == scenes[-1] else f"{scenes[0]:,} to {scenes[-1]:,}"
    return (
        f"{len(table.runs)} runs stand behind it, {duration_text(seconds)} of training in all, "
        f"{each} scene iterations each; {len(table.missing)} cells are missing"
    )


def sweep_name(name: str) -> str:
    """Table 5 is declared in the sweep table5."""
    return ",".join(f"table{word}" if word.isdigit() else word for word in name.split(","))


def collect(
    plan: TablePlan,
    words: Sequence[str],
    index: RunIndex,
    protocol: str,
    collected: Collected | None = None,
) -> "PaperTable":
    """A table with the figures of the runs that are there.

    Args:
        plan: rows, columns and published figures. words: further overrides of the sweep.
        index: of the runs. protocol: the name to print.
        collected: is given what was found, for what stands beside the table.
    """
    from pnet.reporting.paper_table import Cell, Column, PaperTable, Row

    collected = Collected(plan) if collected is None else collected
    ours = {
        (cell.row, cell.column): values_of(cell, overrides, words, index, collected)
        for cell, overrides in restricted(plan, words)
    }
    rows = []
    for i, row in enumerate(plan.rows):
        published = row.published or (None,) * len(plan.columns)
        cells = [Cell(ours.get((i, j), ()), figure) for j, figure in enumerate(published)]
        rows.append(Row(row.name, tuple(cells), row.origin))
    runs = tuple(run_facts(run, collected.of(run), index) for run in collected.runs)
    notes = [plan.note] if plan.note else []
    seeds = sorted({len(values) for values in ours.values() if values})
    if len(seeds) > 1:
        notes.append(f"cells are means of {seeds[0]} to {seeds[-1]} seeds")
    return PaperTable(
        number=plan.number,
        title=plan.title,
        metric=plan.caption or plan.metric,
        protocol=protocol,
        corner=plan.corner,
        columns=tuple(Column(column.name, column.group) for column in plan.columns),
        rows=tuple(rows),
        warnings=(*notes, *mixtures(runs, collected, index)),
        missing=tuple(collected.missing),
        runs=runs,
    )


def values_of(
    cell: CellPlan, overrides: tuple[str, ...], words: Sequence[str], index: RunIndex, collected: Collected
) -> tuple[float, ...]:
    """A cell's figures, one a seed; what is missing is noted."""
    wanted = composed(overrides)
    any_seed = not any(key_of(word) == "seed" for word in words)
    found: list[float] = []
    reason = "no run"
    for run in index.matching(wanted.settings, any_seed):
        evaluation = cell_evaluation(index.postprocess[run], cell, wanted.postprocess)
        metrics = read_metrics(run)
        if metrics is None:
            reason = f"{run} has not ended"
            continue
        scores = metrics["evaluations"].get(evaluation.name)
        if scores is None:
            reason = f"{run} was not evaluated: {evaluation.name}"
            continue
        value = scores.get(cell.table.metric)
        if value is None:
            reason = f"{run} has no {cell.table.metric} of {evaluation.name}"
            continue
        found.append(float(value))
        collected.served.append(Served(run, cell, evaluation, scores))
    if not found:
        collected.missing.append(f"{cell.name}: {reason}")
    return tuple(found)


if __name__ == "__main__":
    main()
