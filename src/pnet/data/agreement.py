"""Whether a scene's points lie where the part at its true poses says: wrong frames and units show here."""

from dataclasses import dataclass

import numpy as np

from pnet.parts.base import ParametricPart
from pnet.records import Scene
from pnet.scenes.rendering import render_view

AGREED = 0.8  # share of the points on their own body below which something is wrong


@dataclass(frozen=True)
class Agreement:
    """How well points and poses go together.

    Attributes:
        share: of the points that fall on their own body in the rendered view, in [0, 1].
        gap: median distance in depth between point and body, of these points, metres; NaN without any.
    """

    share: float
    gap: float

    @property
    def is_good(self) -> bool:
        """Whether frames, units and shape can be right."""
        return self.share >= AGREED


def agreement(scene: Scene, part: ParametricPart) -> Agreement:
    """Compare a scene's points with the part rendered at the scene's poses.

    Args:
        scene: all bodies of one size. part: what it shows.
    Raises:
        ValueError: where a body at its pose reaches behind the camera.
    """
    if not len(scene.R) or not len(scene.points):
        return Agreement(float("nan"), float("nan"))
    image = render_view(scene.camera, part.mesh(scene.parameters[0]), scene.R, scene.t)
    u, v = np.rint(scene.camera.project(scene.points)).astype(np.int64).T
    inside = (u >= 0) & (v >= 0) & (u < scene.camera.width) & (v < scene.camera.height)
    u, v, owner, z = u[inside], v[inside], scene.instance[inside], scene.points[inside, 2]
    own = image.instance[v, u] == owner
    gaps = np.abs(image.depth[v, u] - z)[own]
    return Agreement(
        float(own.sum() / len(scene.points)), float(np.median(gaps)) if len(gaps) else float("nan")
    )
