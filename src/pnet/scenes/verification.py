"""Every record of a data set, read and checked."""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnet.records import Scene
from pnet.scenes.inspection import Advance, DataSet
from pnet.scenes.manifest import MANIFEST
from pnet.scenes.pile import Pile
from pnet.scenes.pile_store import PileFile
from pnet.scenes.protocol import CycleTask
from pnet.scenes.sharing import Sharing
from pnet.scenes.store import CycleFile

MISSING, DAMAGED, LASTING = "missing", "damaged", "lasting"
_ARRAYS = ("points", "R", "t", "parameters", "visibility", "occlusion")
_ROUNDING = 1e-6  # of rotations and shares


@dataclass(frozen=True)
class Fault:
    """What is wrong with a file.

    Attributes:
        path: the file. text: what is wrong. kind: "missing" or "damaged", which making the file again
            mends; "lasting", which it does not.
    """

    path: Path
    text: str
    kind: str

    def __str__(self) -> str:
        # what the store says names the file already
        return self.text if str(self.path) in self.text else f"{self.path}: {self.text}"


@dataclass
class Verification:
    """What was checked and what is wrong.

    Attributes:
        faults: of scenes, then of piles. files, scenes, piles: files of both kinds, scenes and piles read.
        size: bytes of the files. missing_piles: tasks without a file of piles; a fault only where the
            task's scenes are to be made.
    """

    faults: list[Fault] = field(default_factory=list)
    files: int = 0
    scenes: int = 0
    piles: int = 0
    size: int = 0
    missing_piles: list[CycleTask] = field(default_factory=list)


def verify(data: DataSet, advance: Advance = lambda files: None) -> Verification:
    """Read everything and check it.

    Args:
        data: the set. advance: called with how many more files are done, of two for each task.
    """
    found, sharing = Verification(), Sharing(data.part, data.protocol)
    _check_plan(data, found)
    for task in data.tasks:
        check_scenes(data, task, found, sharing.see)
        advance(1)
    for path in data.extra_files(data.root):
        found.faults.append(Fault(path, "not of this data set's plan; move it away", LASTING))
        sharing.see_extra(path)
    found.faults += [Fault(path, text, LASTING) for path, text in sharing.faults()]
    for task in data.tasks:
        if data.protocol is not None:
            check_piles(data, task, found)
        advance(1)
    for path in data.extra_files(data.piles) if data.piles.is_dir() else []:
        found.faults.append(Fault(path, "not of this data set's plan; move it away", LASTING))
    return found


def check_scenes(
    data: DataSet,
    task: CycleTask,
    found: Verification,
    see: Callable[[Path, CycleFile, list[Scene]], None] = lambda path, file, scenes: None,
) -> None:
    """Check a task's file of scenes.

    Args:
        found: to add to. see: takes the file and its scenes where all of them can be read.
    """
    path = data.scene_path(task)
    if not path.is_file():
        found.faults.append(Fault(path, "missing", MISSING))
        return
    found.files += 1
    found.size += path.stat().st_size
    try:
        file = CycleFile(path)
        scenes = [file.scene(i) for i in range(len(file))]
    except (ValueError, OSError) as fault:
        found.faults.append(_unreadable(path, fault))
        return
    found.scenes += len(scenes)
    wrong = [*_scene_header_faults(data, task, file), *_scene_faults(data, task, scenes)]
    _add(found, path, wrong)
    see(path, file, scenes)


def check_piles(data: DataSet, task: CycleTask, found: Verification) -> None:
    """Check a task's file of piles; that it is missing is no fault, scenes do without it."""
    path = data.pile_path(task)
    if not path.is_file():
        found.missing_piles.append(task)
        return
    found.files += 1
    found.size += path.stat().st_size
    try:
        file = PileFile(path)
        piles = [file.pile(i) for i in range(len(file))]
    except (ValueError, OSError) as fault:
        found.faults.append(_unreadable(path, fault))
        return
    found.piles += len(piles)
    _add(found, path, [*_pile_header_faults(data, task, file), *_pile_faults(piles)])


def _check_plan(data: DataSet, found: Verification) -> None:
    planned = Counter(task.split for task in data.tasks)
    if dict(planned) != dict(data.files):
        text = f"speaks of {dict(data.files)} files, its protocol plans {dict(planned)}: another pnet made it"
        found.faults.append(Fault(data.root / MANIFEST, text, LASTING))


def _unreadable(path: Path, fault: Exception) -> Fault:
    """Files of a newer pnet stay: they are whole, and this one would replace them all."""
    lasting = isinstance(fault, OSError) or "written by a newer pnet" in str(fault)
    return Fault(path, str(fault), LASTING if lasting else DAMAGED)


def _add(found: Verification, path: Path, wrong: list[str]) -> None:
    """One fault for a file: the first thing that is wrong, and how many more there are."""
    if wrong:
        more = f" (and {len(wrong) - 1} more)" if len(wrong) > 1 else ""
        found.faults.append(Fault(path, wrong[0] + more, DAMAGED))


def _scene_header_faults(data: DataSet, task: CycleTask, file: CycleFile) -> Iterator[str]:
    header = file.header
    yield from _place_faults(header, task, ("split", "kind", "cycle", "part_index"))
    if header.fingerprint != data.fingerprint:
        yield f"made with other settings than {MANIFEST} says"
    if header.part != data.part.name:
        yield f"shows {header.part}, not {data.part.name}"
    if data.protocol is None:
        return
    planned = data.protocol.scene_drops()
    if not set(header.drops) <= set(planned) or list(header.drops) != sorted(set(header.drops)):
        yield f"holds scenes after {list(header.drops)} drops, which the protocol does not plan"
    if len(file) + header.empty != len(planned):
        yield f"holds {len(file)} scenes and {header.empty} were empty, expected {len(planned)}"
    if len(file) and file.points_per_scene != data.protocol.points:
        yield f"has {file.points_per_scene} points a scene, expected {data.protocol.points}"


def _pile_header_faults(data: DataSet, task: CycleTask, file: PileFile) -> Iterator[str]:
    assert data.protocol is not None  # else there are no piles
    header, planned = file.header, data.protocol.scene_drops()
    yield from _place_faults(header, task, ("split", "kind", "grid", "cycle", "part_index"))
    if header.fingerprint != data.piles_fingerprint:
        yield f"made with other settings than {MANIFEST} says"
    if header.part != data.part.name:
        yield f"shows {header.part}, not {data.part.name}"
    if list(header.drops) != planned:
        yield f"holds piles of {list(header.drops)} drops, expected {planned}"
    if not _are_close(np.array([header.parameters]), data.part.part_object(task.grid, task.part_index)):
        yield "has parameters that are not the part object's"


def _place_faults(header: object, task: CycleTask, names: tuple[str, ...]) -> Iterator[str]:
    for name in names:
        if getattr(header, name) != getattr(task, name):
            yield f"its header says {name} {getattr(header, name)}, its place {getattr(task, name)}"


def _scene_faults(data: DataSet, task: CycleTask, scenes: list[Scene]) -> Iterator[str]:
    for scene in scenes:
        # sizes that were read from elsewhere need not be those of the part's grids
        planned = None if data.protocol is None else data.part.part_object(task.grid, task.part_index)
        for text in _array_faults(scene, planned):
            yield f"scene {scene.id.drop:03d}: {text}"


def _array_faults(scene: Scene, parameters: NDArray[np.float64] | None) -> Iterator[str]:
    for name in _ARRAYS:
        if not np.isfinite(getattr(scene, name)).all():
            yield f"{name} is not finite"
    if ((scene.instance < 0) | (scene.instance >= len(scene.R))).any():
        yield f"points belong to bodies that are not there, it has {len(scene.R)}"
    if not _are_rotations(scene.R):
        yield "R is no rotation"
    for name in ("visibility", "occlusion"):
        if (np.abs(getattr(scene, name) - 0.5) > 0.5 + _ROUNDING).any():
            yield f"{name} is outside of 0 to 1"
    if parameters is not None and not _are_close(scene.parameters, parameters):
        yield "parameters are not the part object's"


def _pile_faults(piles: list[Pile]) -> Iterator[str]:
    for pile in piles:
        if not np.isfinite(pile.t).all():
            yield f"pile {pile.drop:03d}: t is not finite"
        if not _are_rotations(pile.R):
            yield f"pile {pile.drop:03d}: R is no rotation"


def _are_rotations(R: NDArray[np.float64]) -> bool:
    """Whether all of (d, 3, 3) are orthonormal with determinant +1."""
    gap = np.abs(R.swapaxes(1, 2) @ R - np.eye(3))
    return bool((gap <= _ROUNDING).all() and (np.linalg.det(R) > 0).all())


def _are_close(rows: NDArray[np.float64], parameters: NDArray[np.float64]) -> bool:
    """Whether each of (d, k) is the part object's (k,), metres."""
    return rows.shape[1:] == parameters.shape and bool((np.abs(rows - parameters) <= 1e-12).all())
