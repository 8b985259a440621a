"""The depth image of a scene, rendered again.

A `Scene` holds sampled points and no image, but also every body's pose, its parameters and the camera; so its
exact depth and instance images are those that it was sampled from. The bin is not in it, see `Background`.
"""

import zlib
from dataclasses import dataclass, field

import numpy as np
import trimesh
from numpy.typing import NDArray

from pnet.data.export.background import Background
from pnet.geometry.camera import Camera
from pnet.records import Scene
from pnet.scenes.noise import NoNoise, SensorNoise
from pnet.scenes.rendering import View, render_view
from pnet.scenes.view_factory import measured_pixels

Depth = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class DepthView:
    """The images of a scene with d bodies.

    Attributes:
        exact: (h, w) planar depth, metres, of the bodies and of the bin behind them; NaN where nothing is.
        measured: (h, w) the same as the sensor measures it; NaN where it measures nothing.
        instance: (h, w) int64 index of the body, −1 where none is.
        silhouette: (d,) pixels of each body alone, not clipped by the image.
        visible: (d,) pixels of each body in this view.
    """

    exact: Depth
    measured: Depth
    instance: NDArray[np.int64]
    silhouette: NDArray[np.int64]
    visible: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Imaging:
    """How the scenes of an export are turned into images.

    Attributes:
        noise: the sensor's, in `DepthView.measured` on the bodies' pixels alone. A depth image has no place
            for its lateral part: a measured depth stays in its pixel.
        background: the bin behind the bodies, without noise; None: nothing. It never hides a body, since the
            scene's visibility and occlusion know of no bin.
        seed: of the noise, which depends on it and on the scene's id alone.
    """

    noise: SensorNoise = field(default_factory=NoNoise)
    background: Background | None = None
    seed: int = 0

    def view(self, scene: Scene, mesh: trimesh.Trimesh) -> DepthView:
        """Render a scene.

        Args:
            scene: its bodies, camera and id count, its points do not. mesh: the part object that all of its
                bodies are, part frame, metres.
        Raises:
            ValueError: a body is not wholly in front of the camera's near plane; names the scene.
        """
        try:
            image = render_view(scene.camera, mesh, scene.R, scene.t)
        except ValueError as fault:
            raise ValueError(f"{scene.id}: {fault}") from fault
        behind, on_body = self.empty(scene.camera), image.instance >= 0
        rng = np.random.default_rng([self.seed, zlib.crc32(str(scene.id).encode())])
        return DepthView(
            exact=np.where(on_body, image.depth, behind),
            measured=np.where(on_body, self._measure(image, scene.camera, rng), behind),
            instance=image.instance,
            silhouette=image.silhouette,
            visible=image.visible,
        )

    def empty(self, camera: Camera) -> Depth:
        """(h, w) planar depth without bodies, metres; NaN where nothing is. Not to be written to."""
        if self.background is None:
            return np.full((camera.height, camera.width), np.nan)
        return self.background.depth(camera)

    def _measure(self, image: View, camera: Camera, rng: np.random.Generator) -> Depth:
        """(h, w) depth of the bodies with noise, made as for a stored scene; NaN elsewhere."""
        pixels = np.flatnonzero(image.instance >= 0)
        measured = np.full(image.depth.shape, np.nan)
        if isinstance(self.noise, NoNoise) or not len(pixels):
            measured.flat[pixels] = image.depth.flat[pixels]  # exact beyond single precision
            return measured
        pixels, found, kept = measured_pixels(image, camera, self.noise, rng)
        measured.flat[pixels] = np.where(kept, found["points"][:, 2], np.nan)
        return measured


EXACT = Imaging()
