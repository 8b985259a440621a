"""pnet-table: the paper's tables, our figures beside the published ones."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from pnet.cli.app import key_of, run_app
from pnet.cli.jobs import RunIndex, cell_evaluation, composed, read_metrics, restricted
from pnet.cli.sweep_file import CellPlan, TablePlan, read_sweep

if TYPE_CHECKING:
    from pnet.reporting.paper_table import PaperTable, RunFacts

OWN = ("table", "runs", "output")  # the command's own keys; all others are those of the sweep


def main() -> None:
    """Entry point."""
    run_app(table, "table")


def table(cfg: DictConfig) -> None:
    """Collect, print and write each table."""
    from rich.console import Console

    from pnet.reporting.paper_chart import chart
    from pnet.reporting.paper_table import csv_text, latex, markdown, rich_table
    from pnet.scenes.store import write_atomically

    words = [word for word in HydraConfig.get().overrides.task if key_of(word) not in OWN]
    out, folder = Console(soft_wrap=True), Path(cfg.output)
    index = RunIndex(Path(cfg.runs))
    for plan in read_sweep(sweep_name(str(cfg.table))):
        found = collect(plan, words, index, cfg.protocol.name)
        out.print(rich_table(found))
        folder.mkdir(parents=True, exist_ok=True)
        stem = folder / f"table_{plan.number}_{cfg.protocol.name}"
        for ending, text in (("md", markdown(found)), ("csv", csv_text(found)), ("tex", latex(found))):
            write_atomically(stem.with_suffix(f".{ending}"), text.encode())
        chart(found, stem.with_suffix(".png"))
        for line in found.missing:
            out.print(f"· {line}", markup=False)
        out.print(standing(found))
        out.print(f"written to {stem}.md, .csv, .tex, .png\n")


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


@dataclass
class Collected:
    """What was found for a table so far.

    Attributes:
        missing: a line for each cell without a figure. serves: run → cells. data: part → fingerprint → runs.
    """

    missing: list[str] = field(default_factory=list)
    serves: dict[Path, list[str]] = field(default_factory=lambda: defaultdict(list))
    data: dict[str, dict[str, set[Path]]] = field(
        default_factory=lambda: defaultdict(lambda: defaultdict(set))
    )


def collect(plan: TablePlan, words: Sequence[str], index: RunIndex, protocol: str) -> "PaperTable":
    """A table with the figures of the runs that are there.

    Args:
        plan: rows, columns and published figures. words: further overrides of the sweep.
        index: of the runs. protocol: the name to print.
    """
    from pnet.reporting.paper_table import Cell, Column, PaperTable, Row

    collected = Collected()
    ours = {
        (cell.row, cell.column): values_of(cell, overrides, words, index, collected)
        for cell, overrides in restricted(plan, words)
    }
    rows = []
    for i, row in enumerate(plan.rows):
        published = row.published or (None,) * len(plan.columns)
        cells = [Cell(ours.get((i, j), ()), figure) for j, figure in enumerate(published)]
        rows.append(Row(row.name, tuple(cells), row.origin))
    runs = tuple(run_facts(run, cells, index) for run, cells in collected.serves.items())
    notes = [plan.note] if plan.note else []
    return PaperTable(
        number=plan.number,
        title=plan.title,
        metric=plan.caption or plan.metric,
        protocol=protocol,
        corner=plan.corner,
        columns=tuple(Column(column.name, column.group) for column in plan.columns),
        rows=tuple(rows),
        warnings=(*notes, *mixtures(runs, collected)),
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
        scores = metrics.get("evaluations", {}).get(evaluation.name)
        value = None if scores is None else scores.get(cell.table.metric)
        if value is None:
            reason = f"{run} was not evaluated: {evaluation.name}"
            continue
        found.append(float(value))
        collected.serves[run].append(cell.name)
        collected.data[str(index.settings[run]["part"]["_target_"])][str(scores.get("data"))].add(run)
    if not found:
        collected.missing.append(f"{cell.name}: {reason}")
    return tuple(found)


def run_facts(run: Path, cells: Sequence[str], index: RunIndex) -> "RunFacts":
    """What stands behind a run's figures."""
    from pnet.reporting.paper_table import RunFacts

    metrics, settings, state = read_metrics(run) or {}, index.settings[run], provenance_of(run)
    git = state.get("git", {})
    evaluations = metrics.get("evaluations", {}).values()
    fingerprints = sorted({str(scores.get("data")) for scores in evaluations})
    steps = int(metrics.get("steps") or 0)
    return RunFacts(
        cells="; ".join(name.split(": ", 1)[1] for name in cells),
        folder=str(run),
        seed=int(settings["seed"]),
        steps=steps,
        scene_iterations=steps * int(settings["data"]["batch_size"]),
        training_seconds=metrics.get("training_seconds"),
        parameters=(metrics.get("network") or {}).get("parameters"),
        device=f"{state.get('device', 'unknown')}, {state.get('threads', '?')} threads",
        commit=str(git.get("commit", "unknown"))[:7] + ("+changes" if git.get("changed") else ""),
        data=f"{settings['data']['root']} ({', '.join(fingerprints)})",
    )


def provenance_of(run: Path) -> dict[str, Any]:
    """A run's provenance.json; empty where it is not readable."""
    import json

    try:
        content = json.loads((run / "provenance.json").read_text())
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def mixtures(runs: Sequence["RunFacts"], collected: Collected) -> list[str]:
    """What the runs of a table do not have in common, though they should: code, libraries, data of a part."""
    found = []
    commits = Counter(run.commit for run in runs)
    if len(commits) > 1:
        each = ", ".join(f"{commit} ({count} runs)" for commit, count in commits.most_common())
        found.append(f"the runs are of different code versions: {each}")
    if any(commit.endswith("+changes") for commit in commits):
        found.append("some runs are of code with changes that are in no commit")
    for package in ("torch", "numpy", "lightning", "pnet"):
        versions = {
            provenance_of(Path(run.folder)).get("packages", {}).get(package, "unknown") for run in runs
        }
        if len(versions) > 1:
            found.append(f"the runs are of different versions of {package}: {', '.join(sorted(versions))}")
    for part, data in collected.data.items():
        if len(data) > 1:
            name = part.rsplit(".", 1)[-1]
            found.append(f"the runs of {name} were scored on different data: {', '.join(sorted(data))}")
    return found


if __name__ == "__main__":
    main()
