"""pnet-table: the paper's tables, our figures beside the published ones."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from pnet.cli.app import key_of, run_app, short_name
from pnet.cli.jobs import cell_evaluation, composed, restricted
from pnet.cli.runs import RunIndex, read_json_object, read_metrics
from pnet.cli.sweep_file import CellPlan, TablePlan, read_sweep
from pnet.scenes.manifest import MANIFEST, settings_fingerprint

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
    from pnet.scenes.record_file import write_atomically

    words = [word for word in HydraConfig.get().overrides.task if key_of(word) not in OWN]
    out, folder = Console(soft_wrap=True), Path(cfg.output)
    index = RunIndex(Path(cfg.runs))
    for plan in read_sweep(sweep_name(str(cfg.table))):
        found = collect(plan, words, index, " ".join([cfg.protocol.name, *further(words)]))
        out.print(rich_table(found))
        folder.mkdir(parents=True, exist_ok=True)
        stem = folder / short_name(
            "_".join([f"table_{plan.number}", cfg.protocol.name, *further(words)]).replace("=", "-")
        )
        for ending, text in (("md", markdown(found)), ("csv", csv_text(found)), ("tex", latex(found))):
            write_atomically(stem.with_name(f"{stem.name}.{ending}"), text.encode())
        chart(found, stem.with_name(f"{stem.name}.png"))
        for line in found.missing:
            out.print(f"· {line}", markup=False)
        out.print(standing(found))
        out.print(f"written to {stem}.md, .csv, .tex, .png\n")


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


def _nested() -> dict[str, dict[str, set[Path]]]:
    return defaultdict(lambda: defaultdict(set))


@dataclass
class Collected:
    """What was found for a table so far.

    Attributes:
        missing: a line for each cell without a figure. serves: run → cells.
        data, trained: part → fingerprint of the data scored or trained on → runs.
    """

    missing: list[str] = field(default_factory=list)
    serves: dict[Path, list[str]] = field(default_factory=lambda: defaultdict(list))
    data: dict[str, dict[str, set[Path]]] = field(default_factory=_nested)
    trained: dict[str, dict[str, set[Path]]] = field(default_factory=_nested)


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
        scores = metrics["evaluations"].get(evaluation.name)
        if scores is None:
            reason = f"{run} was not evaluated: {evaluation.name}"
            continue
        value = scores.get(cell.table.metric)
        if value is None:
            reason = f"{run} has no {cell.table.metric} of {evaluation.name}"
            continue
        found.append(float(value))
        collected.serves[run].append(cell.name)
        part = str(index.settings[run]["part"]["_target_"])
        collected.data[part][str(scores.get("data"))].add(run)
        made = read_json_object(run / MANIFEST)
        if made is not None:
            collected.trained[part][settings_fingerprint(made)].add(run)
    if not found:
        collected.missing.append(f"{cell.name}: {reason}")
    return tuple(found)


def run_facts(run: Path, cells: Sequence[str], index: RunIndex) -> "RunFacts":
    """What stands behind a run's figures."""
    from pnet.reporting.paper_table import RunFacts

    metrics, settings, state = read_metrics(run) or {}, index.settings[run], provenance_of(run)
    evaluations = metrics.get("evaluations", {}).values()
    fingerprints = sorted({str(scores.get("data")) for scores in evaluations})
    steps = int(metrics.get("steps") or 0)
    return RunFacts(
        cells="; ".join(name.split(": ", 1)[1] for name in cells),
        folder=str(run),
        seed=int(settings["seed"]),
        steps=steps,
        scene_iterations=steps * int(settings["data"]["batch_size"]) * int(settings["trainer"]["devices"]),
        training_seconds=metrics.get("training_seconds"),
        parameters=(metrics.get("network") or {}).get("parameters"),
        device=f"{state.get('device', 'unknown')}, {state.get('threads', '?')} threads",
        commit=", ".join(commits_of(state, list(evaluations))),
        data=f"{settings['data']['root']} ({', '.join(fingerprints)})",
    )


def commits_of(state: dict[str, Any], evaluations: Sequence[dict[str, Any]]) -> list[str]:
    """The code versions that trained and evaluated a run."""
    git = state.get("git", {})
    last = str(git.get("commit", "unknown"))[:7] + ("+changes" if git.get("changed") else "")
    evaluated = [str(scores["commit"]) for scores in evaluations if "commit" in scores]
    return list(dict.fromkeys([*state.get("commits", [last]), *evaluated]))


def provenance_of(run: Path) -> dict[str, Any]:
    """A run's provenance.json; empty where it is not readable."""
    return read_json_object(run / "provenance.json") or {}


def mixtures(runs: Sequence["RunFacts"], collected: Collected) -> list[str]:
    """What the runs of a table do not have in common, though they should: code, libraries, data of a part."""
    found = []
    commits = Counter(run.commit for run in runs)
    if len(commits) > 1:
        each = ", ".join(f"{commit} ({count} runs)" for commit, count in commits.most_common())
        found.append(f"the runs are of different code versions: {each}")
    if any("+changes" in commit for commit in commits):
        found.append("some runs are of code with changes that are in no commit")
    for package in ("torch", "numpy", "lightning", "scikit-learn", "small_gicp", "pnet"):
        versions = {
            provenance_of(Path(run.folder)).get("packages", {}).get(package, "unknown") for run in runs
        }
        if len(versions) > 1:
            found.append(f"the runs are of different versions of {package}: {', '.join(sorted(versions))}")
    for what, parts in (("scored", collected.data), ("trained", collected.trained)):
        for part, data in parts.items():
            if len(data) > 1:
                name = part.rsplit(".", 1)[-1]
                found.append(f"the runs of {name} were {what} on different data: {', '.join(sorted(data))}")
    return found


if __name__ == "__main__":
    main()
