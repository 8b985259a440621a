"""Where scenes come from: pnet's own store, or a public data set as its authors laid it out."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from pnet.parts.base import ParametricPart
from pnet.records import Scene, SceneId
from pnet.scenes.manifest import read_manifest

Keep = Callable[[set[int]], set[int]]


class SceneSet(Sequence[Scene]):
    """The scenes of a split, read one by one."""

    @property
    @abstractmethod
    def ids(self) -> list[SceneId]:
        """The scenes' ids, in order."""

    @property
    @abstractmethod
    def points_per_scene(self) -> int:
        """N, the points of a scene."""

    def draw(self, index: int, rng: np.random.Generator) -> Scene:
        """Scene `index`; nothing of it is left to chance."""
        return self[index]


class DataSource(Protocol):
    """A data set."""

    def manifest(self) -> dict[str, Any]:
        """What the data are, as plain values: equal ones stand for equal data."""

    def scenes(self, split: str, part: ParametricPart, every: int = 1, keep: Keep | None = None) -> SceneSet:
        """The scenes of a split.

        Args:
            split: "train", "val", "test_l" or "test_g". part: what they show.
            every: keep every so many scenes only, counted from the end of each cycle.
            keep: of the part objects there (places in their grid) those to keep; None: all.
        Raises:
            FileNotFoundError, ValueError: where the split is missing, empty, damaged or of another part.
        """


@dataclass(frozen=True)
class StoredData:
    """pnet's own store, as pnet-generate or pnet-data convert made it.

    Attributes:
        root: its folder.
    """

    root: Path

    def manifest(self) -> dict[str, Any]:
        """See `DataSource`: the settings that made it."""
        return read_manifest(self.root)

    def scenes(self, split: str, part: ParametricPart, every: int = 1, keep: Keep | None = None) -> SceneSet:
        """See `DataSource`."""
        from pnet.data.scene_folder import SceneFolder  # a set of scenes itself

        return SceneFolder(self.root, split, part.name, every, keep)
