"""Where the views come from that a training sees: the stored ones, or new ones of the stored piles."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from pnet.data.noisy_scenes import NoisyScenes
from pnet.data.rendered_scenes import RenderedScenes
from pnet.data.source import DataSource, Keep, StoredData
from pnet.geometry.camera import Camera
from pnet.parts.base import ParametricPart
from pnet.records import Scene, SceneId
from pnet.scenes.limits import require_range
from pnet.scenes.manifest import MANIFEST, read_manifest
from pnet.scenes.noise import NoNoise, SensorNoise
from pnet.scenes.view_factory import ViewFactory
from pnet.scenes.viewpoints import MOST_TILT, Viewpoints


class SceneSource(Protocol):
    """Scenes by index; chance, where there is any, comes from the generator alone."""

    @property
    def ids(self) -> list[SceneId]:
        """The scenes' ids, in order."""

    @property
    def points_per_scene(self) -> int:
        """N, the points of a scene."""

    def __len__(self) -> int: ...

    def draw(self, index: int, rng: np.random.Generator) -> Scene:
        """Scene `index`."""


class Views(Protocol):
    """A choice of where a training's views come from."""

    def open(
        self,
        source: DataSource,
        part: ParametricPart,
        points: int | None,
        noise: SensorNoise,
        keep: Keep | None,
    ) -> SceneSource:
        """The training's scenes.

        Args:
            source: the data set. points: N wanted; None: as many as stored.
            noise: of the sensor. keep: see `DataSource`.
        """


@dataclass(frozen=True)
class StoredViews:
    """Every scene as it was stored, with new noise each time."""

    def open(
        self,
        source: DataSource,
        part: ParametricPart,
        points: int | None,
        noise: SensorNoise,
        keep: Keep | None,
    ) -> SceneSource:
        """See `Views`."""
        stored = source.scenes("train", part, keep=keep)
        if isinstance(noise, NoNoise):
            return stored
        if isinstance(source, StoredData) and has_noise(source.root, "train"):
            raise ValueError(
                f"{source.root}: its scenes for training have a noise already; train with noise=none, or "
                "make them without (pnet-generate noise_in=[val,test_l,test_g])"
            )
        return NoisyScenes(stored, noise)


def has_noise(root: Path, split: str) -> bool:
    """Whether a split's stored scenes were measured by a noisy sensor, as the manifest says."""
    if not (root / MANIFEST).exists():
        return False
    made = read_manifest(root)
    target = (made.get("noise") or {}).get("_target_", "")
    return bool(target) and not target.endswith(f".{NoNoise.__name__}") and split in made.get("noise_in", [])


@dataclass(frozen=True)
class RandomViews:
    """A new view of every pile in every epoch, rendered when it is read: few piles give endless views.

    Noise that the stored scenes may have is not in them: views are rendered from piles.

    Attributes:
        distance, tilt, turn: see `Viewpoints`. piles: their folder inside the data set's.
    """

    distance: Sequence[float]
    tilt: Sequence[float]
    turn: bool = True
    piles: str = "piles"

    def __post_init__(self) -> None:
        require_range("views.distance", self.distance, 0, above=True)
        require_range("views.tilt", self.tilt, 0, MOST_TILT)

    def open(
        self,
        source: DataSource,
        part: ParametricPart,
        points: int | None,
        noise: SensorNoise,
        keep: Keep | None,
    ) -> SceneSource:
        """See `Views`; the camera is the one of the stored scenes."""
        if not isinstance(source, StoredData):
            raise ValueError("views=random renders piles, which data=stored alone has: use views=stored")
        root, made = source.root, source.manifest()
        try:
            camera = Camera(**{key: value for key, value in made["camera"].items() if key != "_target_"})
            stored = int(made["protocol"]["points"])
        except (LookupError, TypeError, AttributeError) as fault:
            raise ValueError(f"{root}: its manifest names no camera ({fault}); make the data anew") from fault
        viewpoints = Viewpoints(self.distance, self.tilt, self.turn)
        views = ViewFactory(part, camera, viewpoints, noise, points or stored)
        return RenderedScenes(root / self.piles, "train", views, keep)
