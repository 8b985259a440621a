"""The second stage: from a pile to a scene as a camera sees it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from time import perf_counter
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from pnet.geometry.camera import Camera
from pnet.ops.sampling import farthest_point_order
from pnet.parts.base import ParametricPart
from pnet.records import Scene, SceneId
from pnet.scenes.edges import image_edges
from pnet.scenes.noise import SensorNoise
from pnet.scenes.pile import Pile
from pnet.scenes.rendering import View, render_view
from pnet.scenes.viewpoints import Viewpoints

# Neighbouring pixels have an edge between them where the depth changes by more than so many times their
# distance: more than on a surface that is seen at 80 degrees.
EDGE_SLOPE = 6.0


@dataclass
class ViewTimes:
    """Seconds spent on views, by stage."""

    render: float = 0.0
    sample: float = 0.0


@dataclass(frozen=True, eq=False)
class ViewFactory:
    """Everything that a pile's scene is made from.

    Attributes:
        part: what lies there. camera, viewpoints, noise: see their classes. points: N of a scene.
    """

    part: ParametricPart
    camera: Camera
    viewpoints: Viewpoints
    noise: SensorNoise
    points: int

    def view(
        self,
        pile: Pile,
        parameters: Sequence[float],
        scene_id: SceneId,
        rng: np.random.Generator,
        times: ViewTimes | None = None,
    ) -> Scene | None:
        """Render, measure and sample one pile; None where the camera sees no body.

        Args:
            pile: in the world frame. parameters: (k) of its part object, metres.
            scene_id: of the scene. rng: of viewpoint and noise, in this order. times: to add to.
        """
        times = times or ViewTimes()
        start = perf_counter()
        R_camera, t_camera = self.viewpoints.draw(rng)
        R, t = R_camera @ pile.R, pile.t @ R_camera.T + t_camera
        image = render_view(self.camera, self._mesh(tuple(parameters)), R, t)
        rendered = perf_counter()
        times.render += rendered - start
        measured = self._measure(image, rng)
        if not len(measured["points"]):
            return None
        order = farthest_point_order(measured["points"], self.points)
        times.sample += perf_counter() - rendered
        return Scene(
            **{name: values[order] for name, values in measured.items()},
            R=R,
            t=t,
            parameters=np.tile(np.array(parameters), (len(R), 1)),
            visibility=image.visibility,
            occlusion=image.occlusion,
            camera=self.camera,
            part=self.part.name,
            id=scene_id,
        )

    def _measure(self, image: View, rng: np.random.Generator) -> dict[str, NDArray[Any]]:
        """The pixels on bodies as the sensor measures them, as the arrays of a `Scene`."""
        pixels, found, kept = measured_pixels(image, self.camera, self.noise, rng)
        found["instance"] = image.instance.reshape(-1)[pixels]
        return {name: values[kept] for name, values in found.items()}

    @lru_cache(maxsize=256)  # noqa: B019  as long-lived as its process
    def _mesh(self, parameters: tuple[float, ...]) -> trimesh.Trimesh:
        return self.part.mesh(np.array(parameters))


def measured_pixels(
    image: View, camera: Camera, noise: SensorNoise, rng: np.random.Generator
) -> tuple[NDArray[np.int64], dict[str, NDArray[Any]], NDArray[np.bool_]]:
    """The pixels on bodies as a sensor measures them.

    Args:
        image: the exact view. camera: of it. noise: of the sensor. rng: of the noise.
    Returns:
        (n,) places in the flattened image; points (n, 3), incidence and edge (n,) as in a `Scene`; (n,) which
        were measured at all.
    """
    pixels = np.flatnonzero(image.instance >= 0)
    v, u = np.divmod(pixels, camera.width)
    cloud = (camera.rays(u, v) * image.depth.reshape(-1)[pixels, None]).astype(np.float32)
    incidence = np.rint(255 * image.incidence.reshape(-1)[pixels]).astype(np.uint8)
    edge = image_edges(image.depth, edge_step(cloud, camera)).reshape(-1)[pixels]
    cloud, kept = noise(cloud, incidence / 255, edge, camera, rng)
    return pixels, {"points": cloud, "incidence": incidence, "edge": edge}, kept


def edge_step(cloud: NDArray[np.floating], camera: Camera) -> float:
    """The step in depth from pixel to pixel that is an edge of an image, metres. cloud: (n, 3) its points."""
    return EDGE_SLOPE * float(cloud[:, 2].mean()) / camera.fx if len(cloud) else 0.0
