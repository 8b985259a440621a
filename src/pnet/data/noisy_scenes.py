"""Stored scenes with a new sensor noise each time they are read."""

from dataclasses import dataclass, replace

import numpy as np

from pnet.data.source import SceneSet
from pnet.records import Scene, SceneId
from pnet.scenes.noise import SensorNoise, fill_lost


@dataclass(frozen=True)
class NoisyScenes:
    """Scenes through a noisier sensor.

    Attributes:
        scenes: as they are stored.
        noise: added to them; points that it loses are replaced by repeating others.
    """

    scenes: SceneSet
    noise: SensorNoise

    @property
    def ids(self) -> list[SceneId]:
        """The scenes' ids, in order."""
        return self.scenes.ids

    @property
    def points_per_scene(self) -> int:
        """N."""
        return self.scenes.points_per_scene

    def __len__(self) -> int:
        return len(self.scenes)

    def draw(self, index: int, rng: np.random.Generator) -> Scene:
        """Scene `index` with a noise that `rng` alone decides."""
        return add_noise(self.scenes[index], self.noise, rng)


def add_noise(scene: Scene, noise: SensorNoise, rng: np.random.Generator) -> Scene:
    """The scene as a noisier sensor measures it; labels and order of sampling stay.

    Raises:
        ValueError: where the scene does not say how its points face the camera.
    """
    if scene.incidence is None or scene.edge is None:
        raise ValueError(f"{scene.id}: noise needs the surface's incidence, which this scene does not have")
    points, kept = noise(scene.points, scene.incidence / 255, scene.edge, scene.camera, rng)
    rows = fill_lost(kept, len(points), str(scene.id))
    return replace(
        scene,
        points=points[rows],
        instance=scene.instance[rows],
        incidence=scene.incidence[rows],
        edge=scene.edge[rows],
    )
