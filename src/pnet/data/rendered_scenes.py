"""Scenes that are rendered when they are read: a new view of a stored pile each time."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from pnet.data.scene_folder import check_complete
from pnet.data.split_files import SplitFiles
from pnet.records import Scene, SceneId
from pnet.scenes.pile_store import PileFile
from pnet.scenes.record_file import SUFFIX
from pnet.scenes.view_factory import ViewFactory

REMEDY = "stage=simulate with the same part and protocol"
ATTEMPTS = 20  # views of one pile that may show no body


class RenderedScenes:
    """Views of all piles of a split, each from a place and with a noise of its own.

    Args:
        piles: the folder of piles. split: "train", … views: how a pile is seen.
        keep: of the part objects there (places in their grid) those to keep; None: all.
    Attributes:
        ids: of the scenes, in order. points_per_scene: N.
    Raises:
        FileNotFoundError, ValueError: where piles are missing, damaged or of another part.
    """

    def __init__(
        self,
        piles: Path,
        split: str,
        views: ViewFactory,
        keep: Callable[[set[int]], set[int]] | None = None,
    ) -> None:
        files = [PileFile(path) for path in sorted((piles / split).glob(f"[!.]*{SUFFIX}"))]
        if not files:
            raise FileNotFoundError(f"{piles / split}: no piles there; run pnet-generate {REMEDY}")
        check_complete(piles, split, len(files), REMEDY)
        if len({file.header.fingerprint for file in files}) > 1:
            raise ValueError(
                f"{piles / split}: made with different settings; delete it and make the piles anew"
            )
        for file in files:
            if file.header.part != views.part.name:
                raise ValueError(f"{file.path}: a pile of {file.header.part}, not of {views.part.name}")
        if keep is not None:
            objects = keep({file.header.part_index for file in files})
            files = [file for file in files if file.header.part_index in objects]
        headers = [file.header for file in files]
        self.ids = [
            SceneId(h.split, h.kind, h.cycle, h.part_index, drop) for h in headers for drop in h.drops
        ]
        self.points_per_scene = views.points
        self._views = views
        self._files = SplitFiles(PileFile, [file.path for file in files], [len(file) for file in files])

    def __len__(self) -> int:
        return len(self._files)

    def draw(self, index: int, rng: np.random.Generator) -> Scene:
        """A view of pile `index`; `rng` alone decides which."""
        _, file, place = self._files.locate(index)
        pile = file.pile(place)
        for _ in range(ATTEMPTS):
            scene = self._views.view(pile, file.header.parameters, self.ids[index], rng)
            if scene is not None:
                return scene
        raise ValueError(
            f"{file.path}: the camera saw no body in {ATTEMPTS} views of {self.ids[index]}; "
            "narrow views.distance or views.tilt"
        )
