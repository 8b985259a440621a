"""Any data set into pnet's own store, which is read many times faster."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

from pnet.data.source import DataSource, SceneSet
from pnet.parts.base import ParametricPart
from pnet.records import Scene
from pnet.scenes.generation import open_root
from pnet.scenes.manifest import settings_fingerprint
from pnet.scenes.protocol import SPLITS
from pnet.scenes.record_file import SUFFIX
from pnet.scenes.store import CycleFile, CycleHeader, write_cycle
from pnet.scenes.workers import in_parallel


@dataclass(frozen=True)
class ConvertedCycle:
    """A file to make: the scenes `places` of a split.

    Attributes:
        place: kind, number of the cycle, part object. stem: the file's name without ending.
    """

    split: str
    stem: str
    place: tuple[str, int, int]
    places: tuple[int, ...]


@dataclass(frozen=True)
class CycleReport:
    """What became of a file: scenes written, and scenes left out because no body was measured."""

    cycle: ConvertedCycle
    scenes: int
    empty: int


@dataclass(frozen=True, eq=False)
class Conversion:
    """What is converted and where to.

    Attributes:
        source: the data set. part: what it shows. sets: its scenes by split. root: the store's folder.
        fingerprint: of the source, kept in every file.
    """

    source: DataSource
    part: ParametricPart
    sets: Mapping[str, SceneSet]
    root: Path
    fingerprint: str
    cycles: Sequence[ConvertedCycle] = field(default_factory=list)

    def path(self, cycle: ConvertedCycle) -> Path:
        """Where a file lies."""
        return self.root / cycle.split / (cycle.stem + SUFFIX)

    def is_done(self, cycle: ConvertedCycle) -> bool:
        """Whether the file is there, whole and of this source."""
        try:
            return CycleFile(self.path(cycle)).header.fingerprint == self.fingerprint
        except (ValueError, FileNotFoundError):
            return False

    def make(self, cycle: ConvertedCycle) -> CycleReport:
        """Read a cycle's scenes and write their file."""
        scenes = [self.sets[cycle.split][place] for place in cycle.places]
        kept = [scene for scene in scenes if len(scene.points)]
        header = self._header(scenes, kept)
        write_cycle(self.path(cycle), header, kept)
        return CycleReport(cycle, len(kept), len(scenes) - len(kept))

    def _header(self, scenes: Sequence[Scene], kept: Sequence[Scene]) -> CycleHeader:
        first = scenes[0]
        for scene in scenes:
            if scene.camera != first.camera:
                raise ValueError(f"{scene.id}: its camera differs from that of {first.id} in the same cycle")
        return CycleHeader(
            fingerprint=self.fingerprint,
            part=self.part.name,
            camera=first.camera,
            split=first.id.split,
            kind=first.id.kind,
            cycle=first.id.cycle,
            part_index=first.id.part_index,
            drops=tuple(scene.id.drop for scene in kept),
            empty=len(scenes) - len(kept),
        )


def plan_conversion(source: DataSource, part: ParametricPart, root: Path) -> Conversion:
    """List what there is to convert.

    Raises:
        ValueError, FileNotFoundError: where the source has no split at all; one that it lacks is left out.
    """
    sets, faults = {}, []
    for split in SPLITS:
        try:
            sets[split] = source.scenes(split, part)
        except (ValueError, FileNotFoundError) as fault:
            faults.append(fault)
    if not sets:
        raise faults[0]
    cycles = [cycle for split, scenes in sets.items() for cycle in _cycles(split, scenes)]
    fingerprint = settings_fingerprint(source.manifest())
    return Conversion(source, part, sets, root, fingerprint, cycles)


def conversion_manifest(plan: Conversion, part: Mapping[str, Any]) -> dict[str, Any]:
    """The manifest of the store that comes out. part: its settings."""
    scenes = next(iter(plan.sets.values()))
    files = {split: sum(cycle.split == split for cycle in plan.cycles) for split in plan.sets}
    return {
        "converted": plan.source.manifest(),
        "fingerprint": plan.fingerprint,
        "part": dict(part),
        "camera": asdict(scenes[0].camera),
        "points": scenes.points_per_scene,
        "cycles": [[cycle.split, *cycle.place] for cycle in plan.cycles],
        "files": files,
    }


def convert(
    plan: Conversion, manifest: Mapping[str, Any], workers: int, splits: Sequence[str] = SPLITS
) -> Iterator[tuple[ConvertedCycle, CycleReport | None]]:
    """Write what is missing.

    Args:
        manifest: of `conversion_manifest`. workers: processes; 0 works in this one. splits: those wanted now.
    Yields:
        Every file and its report, or None where it was there.
    """
    open_root(plan.root, manifest)
    missing = []
    for cycle in (one for one in plan.cycles if one.split in splits):
        if plan.is_done(cycle):
            yield cycle, None
        else:
            missing.append(cycle)
    for split in plan.sets:
        (plan.root / split).mkdir(exist_ok=True)
    if workers == 0 or not missing:
        for cycle in missing:
            yield cycle, plan.make(cycle)
        return
    for report in in_parallel(plan, missing, workers, [plan.root]):
        yield report.cycle, report


def _cycles(split: str, scenes: SceneSet) -> Iterator[ConvertedCycle]:
    """The files of a split; a cycle's scenes stand together."""
    ids = scenes.ids
    for stem, places in groupby(range(len(ids)), lambda place: ids[place].file_stem):
        own = tuple(places)
        first = ids[own[0]]
        yield ConvertedCycle(split, stem, (first.kind, first.cycle, first.part_index), own)
