"""Where the views come from that a training sees: the stored ones, or new ones of the stored piles."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from pnet.data.noisy_scenes import NoisyScenes
from pnet.data.rendered_scenes import RenderedScenes
from pnet.data.scene_folder import SceneFolder
from pnet.geometry.camera import Camera
from pnet.parts.base import ParametricPart
from pnet.records import Scene, SceneId
from pnet.scenes.limits import require_range
from pnet.scenes.manifest import MANIFEST, read_manifest
from pnet.scenes.noise import NoNoise, SensorNoise
from pnet.scenes.view_factory import ViewFactory
from pnet.scenes.viewpoints import MOST_TILT, Viewpoints

Keep = Callable[[set[int]], set[int]]


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
        self, root: Path, part: ParametricPart, points: int | None, noise: SensorNoise, keep: Keep | None
    ) -> SceneSource:
        """The training's scenes.

        Args:
            root: the data set's folder. points: N wanted; None: as many as stored.
            noise: of the sensor. keep: see `SceneFolder`.
        """


@dataclass(frozen=True)
class StoredViews:
    """Every scene as it was stored, with new noise each time."""

    def open(
        self, root: Path, part: ParametricPart, points: int | None, noise: SensorNoise, keep: Keep | None
    ) -> SceneSource:
        """See `Views`."""
        stored = SceneFolder(root, "train", part.name, keep=keep)
        if isinstance(noise, NoNoise):
            return stored
        if has_noise(root, "train"):
            raise ValueError(
                f"{root}: its scenes for training have a noise already; train with noise=none, or make them "
                "without (pnet-generate noise_in=[val,test_l,test_g])"
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
        self, root: Path, part: ParametricPart, points: int | None, noise: SensorNoise, keep: Keep | None
    ) -> SceneSource:
        """See `Views`; the camera is the one of the stored scenes."""
        made = read_manifest(root)
        try:
            camera = Camera(**{key: value for key, value in made["camera"].items() if key != "_target_"})
            stored = int(made["protocol"]["points"])
        except (LookupError, TypeError, AttributeError) as fault:
            raise ValueError(f"{root}: its manifest names no camera ({fault}); make the data anew") from fault
        viewpoints = Viewpoints(self.distance, self.tilt, self.turn)
        views = ViewFactory(part, camera, viewpoints, noise, points or stored)
        return RenderedScenes(root / self.piles, "train", views, keep)
