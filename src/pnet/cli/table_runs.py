"""What the runs behind a table say beside its figures: what each took, its errors, its learning curve."""

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pnet.cli.app import key_of
from pnet.cli.evaluate import Evaluation
from pnet.cli.runs import RunIndex, read_json_object, read_metrics
from pnet.cli.settings import METRICS
from pnet.cli.sweep_file import CellPlan, Heading, TablePlan
from pnet.scenes.manifest import MANIFEST, settings_fingerprint

if TYPE_CHECKING:
    from pnet.reporting.error_table import CellErrors
    from pnet.reporting.learning_curves import CurveRun
    from pnet.reporting.paper_table import RunFacts

PACKAGES = ("torch", "numpy", "lightning", "scikit-learn", "small_gicp", "pnet")  # of one version


@dataclass(frozen=True)
class Served:
    """A run that has a figure for a cell.

    Attributes:
        evaluation: the cell's. scores: its entry in the run's metrics.json.
    """

    run: Path
    cell: CellPlan
    evaluation: Evaluation
    scores: dict[str, Any]


@dataclass
class Collected:
    """What was found for a table so far.

    Attributes:
        missing: a line for each cell without a figure. served: the figures, cell by cell.
    """

    plan: TablePlan
    missing: list[str] = field(default_factory=list)
    served: list[Served] = field(default_factory=list)

    @property
    def runs(self) -> list[Path]:
        """Each once."""
        return list(dict.fromkeys(each.run for each in self.served))

    def of(self, run: Path) -> list[Served]:
        """The cells that a run serves."""
        return [each for each in self.served if each.run == run]


def run_facts(run: Path, served: Sequence[Served], index: RunIndex) -> "RunFacts":
    """What stands behind a run's figures."""
    from pnet.reporting.paper_table import RunFacts

    metrics, settings, state = read_metrics(run) or {}, index.settings[run], provenance_of(run)
    evaluations = metrics.get("evaluations", {}).values()
    fingerprints = sorted({str(scores.get("data")) for scores in evaluations})
    steps = int(metrics.get("steps") or 0)
    return RunFacts(
        cells="; ".join(each.cell.name.split(": ", 1)[1] for each in served),
        folder=str(run),
        seed=int(settings["seed"]),
        steps=steps,
        scene_iterations=steps * scenes_a_step(settings),
        training_seconds=metrics.get("training_seconds"),
        parameters=(metrics.get("network") or {}).get("parameters"),
        device=f"{state.get('device', 'unknown')}, {state.get('threads', '?')} threads",
        commit=", ".join(commits_of(state, list(evaluations))),
        data=f"{settings['data']['root']} ({', '.join(fingerprints)})",
    )


def scenes_a_step(settings: dict[str, Any]) -> int:
    """Every device takes a batch of its own."""
    return int(settings["data"]["batch_size"]) * int(settings["trainer"]["devices"])


def commits_of(state: dict[str, Any], evaluations: Sequence[dict[str, Any]]) -> list[str]:
    """The code versions that trained and evaluated a run."""
    from pnet.engine.provenance import commit_text

    evaluated = [str(scores["commit"]) for scores in evaluations if "commit" in scores]
    return list(dict.fromkeys([*state.get("commits", [commit_text(state.get("git", {}))]), *evaluated]))


def provenance_of(run: Path) -> dict[str, Any]:
    """A run's provenance.json; empty where it is not readable."""
    return read_json_object(run / "provenance.json") or {}


def mixtures(runs: Sequence["RunFacts"], collected: Collected, index: RunIndex) -> list[str]:
    """What the runs of a table do not have in common, though they should: code, libraries, data of a part."""
    found = []
    commits = Counter(run.commit for run in runs)
    if len(commits) > 1:
        each = ", ".join(f"{commit} ({count} runs)" for commit, count in commits.most_common())
        found.append(f"the runs are of different code versions: {each}")
    if any("+changes" in commit for commit in commits):
        found.append("some runs are of code with changes that are in no commit")
    for package in PACKAGES:
        versions = {
            provenance_of(Path(run.folder)).get("packages", {}).get(package, "unknown") for run in runs
        }
        if len(versions) > 1:
            found.append(f"the runs are of different versions of {package}: {', '.join(sorted(versions))}")
    return found + data_mixtures(collected, index)


def data_mixtures(collected: Collected, index: RunIndex) -> list[str]:
    """A line for each part whose runs were scored, or trained, on different data."""
    found: dict[tuple[str, str], set[str]] = defaultdict(set)
    for each in collected.served:
        part = str(index.settings[each.run]["part"]["_target_"]).rsplit(".", 1)[-1]
        found["scored", part].add(str(each.scores.get("data")))
        made = read_json_object(each.run / MANIFEST)
        if made is not None:
            found["trained", part].add(settings_fingerprint(made))
    return [
        f"the runs of {part} were {what} on different data: {', '.join(sorted(data))}"
        for (what, part), data in sorted(found.items(), key=lambda item: item[0][0])
        if len(data) > 1
    ]


def error_rows(collected: Collected, index: RunIndex) -> list["CellErrors"]:
    """A row for each cell whose evaluations have parameter errors."""
    from pnet.reporting.error_table import cell_errors
    from pnet.reporting.paper_table import Column, Row

    by_cell: dict[tuple[int, int], list[Served]] = defaultdict(list)
    for each in collected.served:
        by_cell[each.cell.row, each.cell.column].append(each)
    found = []
    for (i, j), served in by_cell.items():
        row, column = collected.plan.rows[i], collected.plan.columns[j]
        scores = [scores_of(each) for each in served]
        order = list(index.settings[served[0].run]["part"].get("learning") or ())
        names = Row(row.name, (), row.origin), Column(column.name, column.group)
        found.append(cell_errors(*names, collected.plan.metric, scores, order))
    return [row for row in found if row is not None]


def scores_of(served: Served) -> dict[str, Any]:
    """An evaluation's metrics, with those that a later scoring of the same predictions added."""
    later = read_json_object(served.evaluation.folder(served.run) / METRICS) or {}
    same = all(later[key] == value for key, value in served.scores.items() if key in later)
    return {**later, **served.scores} if same else served.scores


def curve_runs(collected: Collected, index: RunIndex) -> list["CurveRun"]:
    """The runs behind a table, named by its headings, for `learning_curves`."""
    return [
        curve_run(run, index.settings[run], name_of(collected.of(run)), collected.plan.metric)
        for run in collected.runs
    ]


def curve_run(run: Path, settings: dict[str, Any], name: tuple[str, ...], metric: str = "mAP") -> "CurveRun":
    """A run for `learning_curves`.

    Args:
        settings: as `read_resolved` gives them. name: words that tell it from others. metric: "AP" or "mAP".
    """
    from pnet.reporting.learning_curves import CurveRun

    metrics, part = read_metrics(run) or {}, settings["part"]
    return CurveRun(
        folder=run,
        part=str(part.get("name") or str(part["_target_"]).rsplit(".", 1)[-1]),
        name=name,
        scenes_a_step=scenes_a_step(settings),
        steps=int(metrics.get("steps") or 0),
        training_seconds=metrics.get("training_seconds"),
        metric=metric,
    )


def name_of(served: Sequence[Served]) -> tuple[str, ...]:
    """A run's words in a legend: row, group and column of its cells, without those that name the part.

    A training is validated with the run's own post-processing, so cells that are scored with another ("w/o
    RF") name it only where there is no other cell.
    """
    own = [each for each in served if not each.evaluation.postprocess] or list(served)
    places = zip(*(_words(each.cell) for each in own), strict=True)
    joined = [" = ".join(dict.fromkeys(word for word in place if word)) for place in places]
    return tuple(joined)


def _words(cell: CellPlan) -> Iterator[str]:
    row, column = cell.table.rows[cell.row], cell.table.columns[cell.column]
    yield "" if _names_part(row) else row.name
    yield column.group or ""
    yield "" if _names_part(column) else column.name


def _names_part(heading: Heading) -> bool:
    return any(key_of(word) == "part" for word in heading.set)
