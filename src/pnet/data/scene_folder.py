"""The scenes of one split of pnet's own store, by index."""

from bisect import bisect_right
from collections.abc import Callable, Sequence
from itertools import accumulate
from pathlib import Path

import numpy as np

from pnet.records import Scene, SceneId
from pnet.scenes.manifest import MANIFEST, read_manifest
from pnet.scenes.record_file import SUFFIX
from pnet.scenes.store import CycleFile


class SceneFolder(Sequence[Scene]):
    """All scenes of a split, read one by one.

    Args:
        root: the data set's folder. split: "train", "val", "test_l" or "test_g".
        part: the template's name that the scenes must show.
        every: keep every so many scenes only, counted from the end of each cycle.
        keep: of the part objects there (places in their grid) those to keep; None: all.
    Raises:
        FileNotFoundError, ValueError: where the split is missing, empty, damaged or of another part.
    """

    def __init__(
        self,
        root: Path,
        split: str,
        part: str,
        every: int = 1,
        keep: Callable[[set[int]], set[int]] | None = None,
    ) -> None:
        self._paths = sorted((root / split).glob(f"[!.]*{SUFFIX}"))
        if not self._paths:
            raise FileNotFoundError(
                f"{root / split}: no scenes there; run pnet-generate with the same part and protocol first"
            )
        check_complete(root, split, len(self._paths))
        files = [CycleFile(path) for path in self._paths]
        if len({file.header.fingerprint for file in files}) > 1:
            raise ValueError(
                f"{root / split}: made with different settings; delete it and make the data anew"
            )
        for file in files:
            if file.header.part != part:
                raise ValueError(
                    f"{file.path}: shows {file.header.part}, not {part}; set part={file.header.part} "
                    "or another data.root"
                )
        if keep is not None:
            objects = keep({file.header.part_index for file in files})
            files = [file for file in files if file.header.part_index in objects]
            self._paths = [file.path for file in files]
        self.points_per_scene = min((file.points_per_scene for file in files if len(file)), default=0)
        chosen = [list(range(len(file)))[::-1][::every][::-1] for file in files]
        self._index = chosen
        self._ends = list(accumulate(len(indices) for indices in chosen))
        if not any(chosen):
            raise ValueError(f"{root / split}: its files hold no scene; make the data anew")
        self._ids = [file.scene_id(i) for file, indices in zip(files, chosen, strict=True) for i in indices]
        # opened again where they are read: file handles do not travel to the loader's workers
        self._open: dict[Path, CycleFile] = {}

    def __len__(self) -> int:
        return self._ends[-1]

    def __getitem__(self, index: int) -> Scene:  # type: ignore[override]
        if not 0 <= index < len(self):
            raise IndexError(index)
        number = bisect_right(self._ends, index)
        within = index - (self._ends[number - 1] if number else 0)
        return self._file(self._paths[number]).scene(self._index[number][within])

    def draw(self, index: int, rng: np.random.Generator) -> Scene:
        """Scene `index`; nothing of it is left to chance."""
        return self[index]

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_open": {}}

    @property
    def ids(self) -> list[SceneId]:
        """The scenes' ids, in order."""
        return self._ids

    def _file(self, path: Path) -> CycleFile:
        if path not in self._open:
            self._open[path] = CycleFile(path)
        return self._open[path]


def check_complete(root: Path, split: str, found: int, how: str = "again") -> None:
    """Refuse a split of which generation has not made all files yet. how: to run pnet-generate then."""
    if not (root / MANIFEST).exists():
        return
    planned = read_manifest(root).get("files", {}).get(split, found)
    if found < planned:
        raise ValueError(
            f"{root / split}: only {found} of {planned} cycles are there; run pnet-generate {how}, "
            "which makes what is missing"
        )
