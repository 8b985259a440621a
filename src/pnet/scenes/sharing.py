"""What the splits of a data set share that they must not: cycles, poses, and part objects of test_g."""

from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from pnet.parts.base import ParametricPart
from pnet.records import Scene
from pnet.scenes.protocol import Protocol
from pnet.scenes.store import CycleFile


class Sharing:
    """Looks at every file of a data set, one after another.

    Args:
        part: what lies there. protocol: which grid a split's part objects are of; None: converted data, whose
            splits number their cycles apart.
    """

    def __init__(self, part: ParametricPart, protocol: Protocol | None) -> None:
        self._part, self._protocol = part, protocol
        self._cycles: dict[tuple[object, ...], Path] = {}
        self._poses: dict[bytes, Path] = {}
        self._objects: dict[str, dict[tuple[float, ...], Path]] = {}
        self._faults: list[tuple[Path, str]] = []

    def see(self, path: Path, file: CycleFile, scenes: list[Scene]) -> None:
        """Take note of a file in its split's folder."""
        header, split = file.header, path.parent.name
        if self._protocol is not None:
            plan = self._protocol.splits.get(split)
            key = (plan and plan.grid, header.part_index, header.cycle, header.kind)
            self._note(self._cycles, key, path, "is the cycle")
        if not scenes:
            return
        digest = sha256(b"".join(scene.R.tobytes() + scene.t.tobytes() for scene in scenes)).digest()
        self._note(self._poses, digest, path, "holds the poses")
        objects = self._objects.setdefault(split, {})
        for row in np.unique(np.concatenate([scene.parameters for scene in scenes]), axis=0):
            objects.setdefault(tuple(np.round(row, 9).tolist()), path)

    def see_extra(self, path: Path) -> None:
        """The same of a file that nobody planned, where it can be read."""
        try:
            file = CycleFile(path)
            self.see(path, file, [file.scene(i) for i in range(len(file))])
        except (ValueError, OSError):
            return

    def faults(self) -> list[tuple[Path, str]]:
        """Everything shared, once all files were seen: the second file of each two, and what it shares."""
        tested, trained = self._objects.get("test_g", {}), self._objects.get("train", {})
        for row in sorted(set(tested) & set(trained)):
            text = f"its part object ({self._part.text(np.array(row))}) is one of training's: {trained[row]}"
            self._faults.append((tested[row], text))
        return self._faults

    def _note(self, seen: dict[Any, Path], key: object, path: Path, what: str) -> None:
        other = seen.setdefault(key, path)
        if other.parent != path.parent:
            self._faults.append((path, f"{what} of another split's file: {other}"))
