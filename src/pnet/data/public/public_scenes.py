"""The scenes of one split of a public data set, by index."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from hashlib import sha256
from itertools import groupby
from pathlib import Path
from typing import Any

from pnet.data.source import Keep, SceneSet
from pnet.geometry.camera import Camera
from pnet.records import Scene, SceneId


@dataclass(frozen=True)
class Listed:
    """A scene that a listing of the folders found.

    Attributes:
        id: what it becomes. folder: its cycle's. name: what its files begin with, for the reader.
    """

    id: SceneId
    folder: Path
    name: str


class PublicScenes(SceneSet):
    """Scenes that are read from their authors' files when they are asked for.

    Args:
        listed: in order, cycles together. read: reads one. points: N of a scene.
        every: keep every so many scenes only, counted from the end of each cycle.
        keep: of the part objects there those to keep; None: all.
    """

    def __init__(
        self,
        listed: Iterable[Listed],
        read: Callable[[Listed], Scene],
        points: int,
        every: int = 1,
        keep: Keep | None = None,
    ) -> None:
        found = list(listed)
        if keep is not None:
            objects = keep({one.id.part_index for one in found})
            found = [one for one in found if one.id.part_index in objects]
        cycles = groupby(found, lambda one: (one.folder, one.id.file_stem))
        self._listed = [one for _, cycle in cycles for one in list(cycle)[::-1][::every][::-1]]
        self._read, self._points = read, points

    @property
    def ids(self) -> list[SceneId]:
        """The scenes' ids, in order."""
        return [one.id for one in self._listed]

    @property
    def names(self) -> list[str]:
        """What the authors' files of each scene begin with, in order."""
        return [one.name for one in self._listed]

    @property
    def points_per_scene(self) -> int:
        """N."""
        return self._points

    def __len__(self) -> int:
        return len(self._listed)

    def __getitem__(self, index: int) -> Scene:  # type: ignore[override]
        if not 0 <= index < len(self):
            raise IndexError(index)
        return self._read(self._listed[index])


def listing_digest(root: Path, listed: Sequence[Listed]) -> str:
    """Digest of which scenes there are, for a manifest: names only, as there may be many files."""
    folders = {folder: str(folder.relative_to(root)) for folder in {one.folder for one in listed}}
    names = sorted(f"{one.id} {folders[one.folder]}/{one.name}" for one in listed)
    return sha256("\n".join(names).encode()).hexdigest()[:16]


def public_manifest(
    name: str, settings: dict[str, Any], root: Path, listed: Sequence[Listed], camera: Camera | None
) -> dict[str, Any]:
    """What stands for a public data set: its settings, and which scenes there are.

    Args:
        name: of the data set. settings: of the reader, without the folder. root: the folder.
        listed: all its scenes. camera: of the first of them, where it is known.
    """
    splits = sorted({one.id.split for one in listed})
    scenes = {split: sum(one.id.split == split for one in listed) for split in splits}
    seen = None if camera is None else camera.to_dict()
    listing = listing_digest(root, listed)
    return {"source": name, **settings, "camera": seen, "scenes": scenes, "listing": listing}
