"""Make a data set: many cycles in parallel, in two stages, resumable at any moment.

Piles lie in a folder of their own: `simulate` makes them, `render` makes scenes of those that are there,
`all` does both, cycle by cycle.
"""

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

from pnet.scenes.factory import SceneFactory, StageTimes
from pnet.scenes.manifest import MANIFEST, differences, read_manifest
from pnet.scenes.pile_store import PileFile, write_piles
from pnet.scenes.protocol import CycleTask
from pnet.scenes.record_file import SUFFIX, remove_left_overs, write_atomically
from pnet.scenes.store import CycleFile, write_cycle
from pnet.scenes.workers import in_parallel

STAGES = ("simulate", "render", "all")


@dataclass(frozen=True)
class CycleReport:
    """What became of one task.

    Attributes:
        scenes: made (piles, where only those are). escaped, unsettled, empty: see `CycleHeader`.
        simulated: whether piles were made. times: seconds by stage.
    """

    task: CycleTask
    scenes: int
    escaped: int
    unsettled: int
    empty: int
    simulated: bool
    times: StageTimes


@dataclass
class Summary:
    """Totals of a generation.

    Attributes:
        made, kept: cycles made now and found whole. scenes, escaped, unsettled, empty: of those made now.
        simulated: cycles whose piles were made now.
        times: seconds by stage, summed over workers. seconds: wall time.
    """

    made: int = 0
    kept: int = 0
    scenes: int = 0
    escaped: int = 0
    unsettled: int = 0
    empty: int = 0
    simulated: int = 0
    times: StageTimes = field(default_factory=StageTimes)
    seconds: float = 0.0

    def add(self, report: CycleReport) -> None:
        """Count one finished cycle."""
        self.made += 1
        for name in ("scenes", "escaped", "unsettled", "empty", "simulated"):
            setattr(self, name, getattr(self, name) + getattr(report, name))
        mine, more = asdict(self.times), asdict(report.times)
        self.times = StageTimes(**{stage: mine[stage] + more[stage] for stage in mine})


@dataclass(frozen=True, eq=False)
class Plan:
    """What to make where.

    Attributes:
        factory: what scenes are made from. piles, scenes: opened folders of the two stages.
        stage: "simulate", "render" or "all".
    """

    factory: SceneFactory
    piles: Path
    scenes: Path
    stage: str = "all"

    def __post_init__(self) -> None:
        if self.stage not in STAGES:
            raise ValueError(f"stage={self.stage}: choose {', '.join(STAGES)}")

    def is_done(self, task: CycleTask) -> bool:
        """Whether the task's file is there, whole and of these settings."""
        if self.stage == "simulate":
            return self._has_piles(task)
        path = cycle_path(self.scenes, task)
        return path.exists() and _made_by(CycleFile, path) == self.factory.fingerprint

    def make(self, task: CycleTask) -> CycleReport:
        """Make what is missing of one task's files."""
        times, path = StageTimes(), cycle_path(self.piles, task)
        missing = self.stage != "render" and not self._has_piles(task)
        if missing:
            start = perf_counter()
            made = self.factory.piles.make_piles(task)
            simulated = perf_counter()
            write_piles(path, *made)
            times.simulate, times.write = simulated - start, perf_counter() - simulated
        file = PileFile(path)
        self._check_piles(file, task)
        piles = [file.pile(i) for i in range(len(file))]  # as they are read: so stages agree to the bit
        if self.stage == "simulate":
            unsettled = sum(not pile.settled for pile in piles)
            return CycleReport(task, len(piles), piles[-1].escaped, unsettled, 0, missing, times)
        cycle = self.factory.render_cycle(task, file.header, piles)
        start = perf_counter()
        write_cycle(cycle_path(self.scenes, task), cycle.header, cycle.scenes)
        times.write += perf_counter() - start
        times.render, times.sample = cycle.times.render, cycle.times.sample
        header = cycle.header
        counts = (len(cycle.scenes), header.escaped, header.unsettled, header.empty)
        return CycleReport(task, *counts, missing, times)

    def _check_piles(self, file: PileFile, task: CycleTask) -> None:
        """Refuse piles of other settings, or of another task that lie in this one's place."""
        header = file.header
        place = all(getattr(header, name) == getattr(task, name) for name in CycleTask.__dataclass_fields__)
        if header.fingerprint != self.factory.piles.fingerprint or not place:
            raise ValueError(f"{file.path}: made with other settings; delete it and run stage=simulate")

    def _has_piles(self, task: CycleTask) -> bool:
        path = cycle_path(self.piles, task)
        return path.exists() and _made_by(PileFile, path) == self.factory.piles.fingerprint


def cycle_path(root: Path, task: CycleTask) -> Path:
    """Where a task's file lies, of scenes or of piles."""
    return root / task.split / (task.scene_id(0).file_stem + SUFFIX)


def check_root(root: Path, settings: Mapping[str, Any], key: str = "data.root") -> None:
    """Check that a data folder, where it is there, was made with these settings.

    Args:
        key: the setting that names the folder, for messages.
    Raises:
        ValueError: where other settings made it; names the first few that differ.
    """
    manifest = root / MANIFEST
    differing = sorted(differences(read_manifest(root), settings)) if manifest.exists() else []
    if differing:
        raise ValueError(
            f"{manifest}: this data was made with other settings: {'; '.join(differing[:4])}. "
            f"Choose another {key}, or delete this folder to make it anew"
        )


def open_root(root: Path, settings: Mapping[str, Any], key: str = "data.root") -> None:
    """Create a data folder and its manifest, or check the one there. Arguments and errors as `check_root`."""
    check_root(root, settings, key)
    manifest = root / MANIFEST
    if not manifest.exists():
        root.mkdir(parents=True, exist_ok=True)
        write_atomically(manifest, (json.dumps(settings, indent=1, sort_keys=True) + "\n").encode())
    remove_left_overs(root)


def generate(plan: Plan, tasks: Iterable[CycleTask], workers: int) -> Iterator[CycleReport | None]:
    """Make what is missing.

    Args:
        plan: what to make where. tasks: the files wanted. workers: processes; 0 works in this one.
    Yields:
        For every task, in the order of completion, its report, or None where its file was whole already.
    """
    missing = []
    for task in tasks:
        if plan.is_done(task):
            yield None
        else:
            missing.append(task)
    if plan.stage == "render":
        _check_piles_there(plan, missing)
    wanted = {"simulate": [plan.piles], "render": [plan.scenes], "all": [plan.piles, plan.scenes]}
    for split in sorted({task.split for task in missing}):
        for root in wanted[plan.stage]:
            (root / split).mkdir(parents=True, exist_ok=True)
    if workers == 0 or not missing:
        for task in missing:
            yield plan.make(task)
        return
    yield from in_parallel(plan, missing, workers, _roots(plan))


def _check_piles_there(plan: Plan, tasks: list[CycleTask]) -> None:
    """Refuse to begin where piles are missing: the work would stop in the middle."""
    absent = [path for path in (cycle_path(plan.piles, task) for task in tasks) if not path.exists()]
    if absent:
        raise FileNotFoundError(
            f"{absent[0]}: no such pile file, and {len(absent) - 1} more are missing; run pnet-generate "
            "stage=simulate first, which makes only what is missing"
        )


def _roots(plan: Plan) -> list[Path]:
    return [root for root in (plan.piles, plan.scenes) if root.is_dir()]


def _made_by(reader: type[CycleFile] | type[PileFile], path: Path) -> str | None:
    """The fingerprint of the settings that made a file; None where it is damaged: it is made anew."""
    try:
        return reader(path).header.fingerprint
    except ValueError:
        return None
