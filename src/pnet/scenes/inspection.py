"""What there is of a data set, against what its manifest plans. Reads the bodies, not the points."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from pnet.geometry.symmetry import Symmetry
from pnet.parts.base import ParametricPart
from pnet.scenes.coverage import Coverage, direction_coverage, viewing_directions
from pnet.scenes.generation import cycle_path
from pnet.scenes.pile_store import PileFile
from pnet.scenes.protocol import KINDS, SPLITS, CycleTask, Protocol
from pnet.scenes.record_file import SUFFIX
from pnet.scenes.store import CycleFile

VISIBILITY_BINS = 10
MOST_OCCLUDED = 0.5  # what must be found is occluded at most so much

Reader = TypeVar("Reader", CycleFile, PileFile)
Advance = Callable[[int], None]
Directions = Mapping[str, Sequence[NDArray[np.float64]]]


@dataclass(frozen=True, eq=False)
class DataSet:
    """A data set as its manifest plans it.

    Attributes:
        root, piles: the folders of its scenes and of its piles.
        part: what lies there. protocol: its plan for this part; None: converted from another data set,
            without piles. tasks: every file that is planned.
        fingerprint, piles_fingerprint: what the header of every file of scenes and of piles must say.
        files: how many files of each split the manifest speaks of.
    """

    root: Path
    piles: Path
    part: ParametricPart
    protocol: Protocol | None
    tasks: Sequence[CycleTask]
    fingerprint: str
    piles_fingerprint: str
    files: Mapping[str, int]

    def scene_path(self, task: CycleTask) -> Path:
        """Where a task's scenes lie."""
        return cycle_path(self.root, task)

    def pile_path(self, task: CycleTask) -> Path:
        """Where a task's piles lie."""
        return cycle_path(self.piles, task)

    @property
    def splits(self) -> list[str]:
        """Those that are planned, in the usual order."""
        planned = {task.split for task in self.tasks}
        return [split for split in SPLITS if split in planned]

    def extra_files(self, folder: Path) -> list[Path]:
        """Files in the places of scenes (`root`) or piles (`piles`) that no task plans; a training on the
        split would read them."""
        planned = {cycle_path(folder, task) for task in self.tasks}
        there = [path for split in SPLITS for path in (folder / split).glob(f"[!.]*{SUFFIX}")]
        return sorted(set(there) - planned)


@dataclass
class SplitSummary:
    """What there is of one split.

    Attributes:
        part_objects: of the plan. planned, whole, missing, damaged: cycles (files); damaged ones are those
            that cannot be opened or were made with other settings. extra: files that nobody planned.
        scenes, instances: in the whole cycles. to_find: instances that are at most half occluded.
        size: bytes of all planned files there.
        escaped: bodies that left the bin. unsettled, empty: scenes, see `CycleHeader`.
        points: smallest and largest N of a scene; (0, 0) without scenes.
        visibility: instances in ten bins of equal width from 0 to 1.
    """

    part_objects: int = 0
    planned: int = 0
    whole: int = 0
    missing: int = 0
    damaged: int = 0
    extra: int = 0
    scenes: int = 0
    instances: int = 0
    to_find: int = 0
    size: int = 0
    escaped: int = 0
    unsettled: int = 0
    empty: int = 0
    points: tuple[int, int] = (0, 0)
    visibility: list[int] = field(default_factory=lambda: [0] * VISIBILITY_BINS)


@dataclass
class PileSummary:
    """What there is of the piles: files planned, whole, missing, damaged; bytes."""

    planned: int = 0
    whole: int = 0
    missing: int = 0
    damaged: int = 0
    size: int = 0


@dataclass(frozen=True)
class Summary:
    """A data set in numbers.

    Attributes:
        splits: by name, in the usual order. piles: of all splits together.
        coverage: by kind of scene, of the instances that are at most half occluded.
    """

    splits: Mapping[str, SplitSummary]
    piles: PileSummary
    coverage: Mapping[str, Coverage]


def summarise(data: DataSet, advance: Advance = lambda files: None) -> Summary:
    """Count everything that can be told without the points.

    Args:
        data: the set; files may be missing or damaged. advance: called with how many more files are done.
    """
    splits = {split: SplitSummary() for split in data.splits}
    directions: dict[str, list[NDArray[np.float64]]] = {kind: [] for kind in KINDS}
    for task in data.tasks:
        _add_cycle(splits[task.split], data, task, directions[task.kind])
        advance(1)
    for split, found in splits.items():
        found.part_objects = len({task.part_index for task in data.tasks if task.split == split})
    for path in data.extra_files(data.root):
        splits.setdefault(path.parent.name, SplitSummary()).extra += 1
    return Summary(splits, summarise_piles(data), _coverage(directions, data.part.symmetry))


def summarise_piles(data: DataSet) -> PileSummary:
    """Count the files of piles by their headers."""
    found = PileSummary(planned=len(data.tasks) if data.protocol else 0)
    for task in data.tasks if data.protocol else []:
        path = data.pile_path(task)
        if not path.is_file():
            found.missing += 1
            continue
        found.size += path.stat().st_size
        file = _opened(PileFile, path)
        if file is None or file.header.fingerprint != data.piles_fingerprint:
            found.damaged += 1
        else:
            found.whole += 1
    return found


def whole_cycle(data: DataSet, task: CycleTask) -> CycleFile | None:
    """A task's file, opened; None where it is missing, damaged or made with other settings."""
    file = _opened(CycleFile, data.scene_path(task))
    return None if file is None or file.header.fingerprint != data.fingerprint else file


def _add_cycle(
    found: SplitSummary, data: DataSet, task: CycleTask, directions: list[NDArray[np.float64]]
) -> None:
    """Count one cycle's file and keep the directions from which its instances are seen."""
    path = data.scene_path(task)
    found.planned += 1
    if not path.is_file():
        found.missing += 1
        return
    found.size += path.stat().st_size
    file = whole_cycle(data, task)
    bodies = None if file is None else _read_bodies(path)
    if file is None or bodies is None:
        found.damaged += 1
        return
    header = file.header
    found.whole += 1
    found.scenes += len(file)
    for name in ("escaped", "unsettled", "empty"):
        setattr(found, name, getattr(found, name) + getattr(header, name))
    if not len(file):
        return
    low, high = found.points
    n = file.points_per_scene
    found.points = (min(low or n, n), max(high, n))
    to_find = bodies["occlusion"] <= MOST_OCCLUDED
    found.instances += len(to_find)
    found.to_find += int(to_find.sum())
    counts = np.histogram(bodies["visibility"], VISIBILITY_BINS, (0, 1))[0].tolist()
    found.visibility = [old + new for old, new in zip(found.visibility, counts, strict=True)]
    directions.append(viewing_directions(bodies["R"][to_find], bodies["t"][to_find]))


def _read_bodies(path: Path) -> dict[str, NDArray[np.float64]] | None:
    """Poses, visibility and occlusion of a cycle's bodies, scene after scene; None where they cannot be
    read. Not checked against checksums, which cover the points too."""
    try:
        with safe_open(path, framework="numpy") as file:
            return {name: file.get_tensor(name) for name in ("R", "t", "visibility", "occlusion")}
    except (SafetensorError, OSError):
        return None


def _opened(reader: type[Reader], path: Path) -> Reader | None:
    try:
        return reader(path)
    except (ValueError, OSError):
        return None


def _coverage(directions: Directions, symmetry: Symmetry) -> dict[str, Coverage]:
    """Of the kinds that are there."""
    return {
        kind: direction_coverage(np.concatenate(found), symmetry)
        for kind, found in directions.items()
        if found
    }
