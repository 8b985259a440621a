"""What a sweep has to do: its cells as trainings, each of which is one run folder."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any

from hydra import compose
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import OmegaConf, open_dict

from pnet.cli.app import hydra_value, key_of
from pnet.cli.data_set import data_overrides
from pnet.cli.evaluate import Evaluation, wanted_evaluations
from pnet.cli.generate import making_settings
from pnet.cli.runs import RunIndex, read_json_object, read_metrics, read_resolved
from pnet.cli.settings import DECIDE_NOTHING, training_settings
from pnet.cli.sweep_file import CellPlan, TablePlan
from pnet.scenes.manifest import MANIFEST, settings_fingerprint

RUNS = Path("outputs/train")


@dataclass
class Job:
    """One training, and the evaluations that cells need of it.

    Attributes:
        overrides: of pnet-train. run: its folder.
        settings: all that the training depends on. postprocess: of the run. steps: of the training.
        evaluations: by name. generate: overrides of pnet-generate; None where data is not made.
        cells: which cells it serves.
    """

    overrides: tuple[str, ...]
    run: Path
    settings: dict[str, Any]
    postprocess: dict[str, Any]
    steps: int
    generate: tuple[str, ...] | None = None
    evaluations: dict[str, Evaluation] = field(default_factory=dict)
    cells: list[str] = field(default_factory=list)

    def missing(self) -> list[str]:
        """What is not there yet: "training", and names of evaluations; from the run's metrics.json.

        A run of other settings in the folder, or on other data, counts as missing: the job itself says then
        what is wrong.
        """
        metrics = read_metrics(self.run)
        if metrics is None or metrics["steps"] < self.steps or not self._is_own():
            return ["training", *self.evaluations]
        data = read_json_object(Path(self.settings["data"]["root"]) / MANIFEST)
        now = None if data is None else settings_fingerprint(data)
        done = metrics["evaluations"]
        # data that is gone leaves the figures as they are
        return [n for n in self.evaluations if n not in done or now not in (None, done[n].get("data"))]

    def _is_own(self) -> bool:
        """Whether the folder's run has this job's settings, and was trained on the data that is asked for."""
        found = read_resolved(self.run)
        if found is None or found[0] != self.settings:
            return False
        made = read_json_object(self.run / MANIFEST)
        there = read_json_object(Path(self.settings["data"]["root"]) / MANIFEST)
        if made is not None and there is not None and made != there:
            return False
        if self.generate is None or made is None:
            return True
        wanted = making(tuple(data_overrides(self.overrides, self.settings["data"]["root"], self.generate)))
        return {key: made.get(key) for key in wanted} == wanted

    def command(self) -> list[str]:
        """Overrides with which pnet-train does all of it, or what is missing."""
        wanted = [
            {"split": e.split, "postprocess": e.postprocess} if e.postprocess else e.split
            for e in self.evaluations.values()
        ]
        added = {"evaluate": hydra_value(wanted), "run_dir": hydra_value(str(self.run)), "ckpt": "auto"}
        if self.generate is not None:
            added["data.generate"] = hydra_value(list(self.generate))
        own = [word for word in self.overrides if key_of(word) not in added]
        return [*own, *(f"{key}={value}" for key, value in added.items())]


@dataclass(frozen=True)
class Composed:
    """What pnet-train would run, resolved.

    Attributes:
        settings: all that the training depends on. postprocess: the rest that results depend on.
        run: the folder. steps: of the training; 0 for a method without one.
        evaluations, generate: what the overrides themselves ask for.
    """

    settings: dict[str, Any]
    postprocess: dict[str, Any]
    run: Path
    steps: int
    evaluations: tuple[Evaluation, ...]
    generate: tuple[str, ...]


@lru_cache(maxsize=1024)
def composed(overrides: tuple[str, ...]) -> Composed:
    """What pnet-train would run with these overrides; a Hydra app must be running."""
    cfg = compose("train", overrides=list(overrides), return_hydra_config=True)
    outer = HydraConfig.instance().cfg
    HydraConfig.instance().set_config(cfg)  # what ${hydra:…} refers to
    try:
        with open_dict(cfg):
            del cfg["hydra"]
        plain: Any = OmegaConf.to_container(cfg, resolve=True)
    finally:
        HydraConfig.instance().cfg = outer
    steps = plain["trainer"]["steps"] if plain["method"]["estimator"] is None else 0
    return Composed(
        training_settings(plain),
        plain["postprocess"],
        Path(plain["run_dir"]),
        int(steps),
        tuple(wanted_evaluations(plain["evaluate"])),
        tuple(plain["data"]["generate"] or ()),
    )


def expand(arguments: Sequence[str]) -> list[list[str]]:
    """All combinations of overrides with several values (`seed=0,1`), in Hydra's order.

    Raises:
        ValueError: for a sweep over a range that is not a list of values.
    """
    choices: dict[str, list[str]] = {}
    for override in OverridesParser.create().parse_overrides(list(arguments)):
        key = override.get_key_element()
        if override.is_delete() and override.value() is None:  # with a value it would ask for that value
            choices[key] = [key]
        elif not override.is_sweep_override():
            choices[key] = [f"{key}={override.get_value_element_as_str()}"]
        elif override.is_discrete_sweep():
            choices[key] = [f"{key}={value}" for value in override.sweep_string_iterator()]
        else:
            raise ValueError(f"{override.input_line}: give the values one by one, with commas")
    return [list(words) for words in product(*choices.values())]


def plain_jobs(arguments: Sequence[str]) -> list[Job]:
    """A job for each combination of a multirun without a sweep file, in a folder named by its overrides.

    Raises:
        ValueError: where different trainings would have the same folder.
    """
    jobs: dict[Path, Job] = {}
    for words in expand(arguments):
        whole = composed(tuple(words))
        asked = {evaluation.name: evaluation for evaluation in whole.evaluations}
        job = Job(tuple(words), whole.run, whole.settings, whole.postprocess, whole.steps, None, asked)
        first = jobs.setdefault(job.run, job)
        if (first.settings, first.postprocess) != (job.settings, job.postprocess):
            raise ValueError(f"{job.run}: the folder of several trainings; give each a run_dir of its own")
        first.evaluations.update(asked)
    return list(jobs.values())


def sweep_jobs(tables: Sequence[TablePlan], arguments: Sequence[str]) -> list[Job]:
    """The jobs of a sweep: cells that train the same thing share one, whatever table they stand in.

    Raises:
        ValueError: where no cell has the values that the arguments ask for.
    """
    index = RunIndex(RUNS)
    jobs: list[Job] = []
    for words in expand(arguments):
        for table in tables:
            for cell, overrides in restricted(table, words):
                job = find_job(overrides, own_data(overrides, cell), jobs, index)
                add_cell(job, cell, overrides)
    if not jobs:
        keys = {key_of(word) for table in tables for cell in table.cells() for word in cell.overrides}
        chosen = [word for word in arguments if key_of(word) in keys]
        raise ValueError(
            f"no cell of the sweep has {' and '.join(chosen)}: it sweeps {', '.join(sorted(keys))} itself, "
            "so a value of these selects cells"
        )
    return jobs


def restricted(table: TablePlan, words: Sequence[str]) -> Iterator[tuple[CellPlan, tuple[str, ...]]]:
    """A table's cells with their overrides and the user's; the user's value of a key that the table itself
    sweeps selects cells (`part=tn34`)."""
    own_keys = {key_of(word) for cell in table.cells() for word in cell.overrides}
    further = [word for word in words if key_of(word) not in own_keys]
    chosen = [word for word in words if key_of(word) in own_keys]
    for cell in table.cells():
        if all(word in cell.overrides for word in chosen):
            yield cell, (*further, *cell.overrides)


def find_job(
    overrides: tuple[str, ...], generate: tuple[str, ...] | None, known: list[Job], index: RunIndex
) -> Job:
    """The job of a cell's overrides: one that is known, or a new one, put to the known.

    A run that is there with the same settings is taken, whatever its name; else the folder is named by the
    overrides that change what is trained.
    """
    whole = composed(overrides)
    for job in known:
        if job.settings == whole.settings:
            return job
    run = index.find(whole.settings)
    if run is not None and read_metrics(run) is not None:  # it has ended and keeps its post-processing
        named, trained_with = overrides, index.postprocess[run]
    else:
        named = deciding(overrides, whole.settings)
        trained_with = composed(named).postprocess
        run = run or composed(named).run
    asked = {evaluation.name: evaluation for evaluation in whole.evaluations}
    job = Job(named, run, whole.settings, trained_with, whole.steps, generate, asked)
    known.append(job)
    return job


def own_data(overrides: Iterable[str], cell: CellPlan) -> tuple[str, ...] | None:
    """With which settings a cell's data is made; None where the user names a data set that is there."""
    if any(key_of(word) == "data.root" for word in overrides):
        return None
    return (*cell.generate, *composed(tuple(overrides)).generate)


def deciding(overrides: Sequence[str], settings: dict[str, Any]) -> tuple[str, ...]:
    """The overrides without those whose absence changes nothing of the training; part and protocol stay, and
    what decides nothing by itself (threads, say)."""
    kept = list(overrides)
    for word in overrides:
        rest = [other for other in kept if other != word]
        if key_of(word) in ("part", "protocol", "data.root", *DECIDE_NOTHING):
            continue
        try:
            if composed(tuple(rest)).settings == settings:
                kept = rest
        except HydraException:  # another override sets a key that only this one brings
            continue
    return tuple(kept)


def add_cell(job: Job, cell: CellPlan, overrides: Sequence[str]) -> str:
    """Have a job serve a cell; the name of the evaluation that is the cell's."""
    evaluation = cell_evaluation(job.postprocess, cell, composed(tuple(overrides)).postprocess)
    job.evaluations.setdefault(evaluation.name, evaluation)
    if cell.name not in job.cells:
        job.cells.append(cell.name)
    return evaluation.name


def cell_evaluation(trained: dict[str, Any], cell: CellPlan, wanted: dict[str, Any]) -> Evaluation:
    """How a run with one post-processing is scored for a cell that wants another."""
    changes = changed(trained, wanted)
    if changes is None or "_target_" in changes:  # an evaluation's `_target_` stands in place of all settings
        changes = wanted
    return Evaluation(cell.table.split, changes)


def changed(old: dict[str, Any], new: dict[str, Any]) -> dict[str, Any] | None:
    """What has to be merged into old settings to make them new; None where merging cannot.

    Keys stay as they are, except below what was empty: an evaluation refuses others as misspelt.
    """
    if set(old) != set(new):
        return None
    changes: dict[str, Any] = {}
    for key, value in new.items():
        was = old[key]
        if was == value:
            continue
        if isinstance(value, dict) and isinstance(was, dict):
            inner = changed(was, value)
            if inner is None:
                return None
            changes[key] = inner
        elif isinstance(value, dict | list) and was is not None and type(was) is not type(value):
            return None
        else:
            changes[key] = value
    return changes


@lru_cache(maxsize=256)
def making(overrides: tuple[str, ...]) -> dict[str, Any]:
    """The settings by which pnet-generate would make a data set."""
    return making_settings(compose("generate", overrides=list(overrides)))
