"""How a part is looked at: the views of its pictures, and where its keypoints and their equivalents lie."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from pnet.geometry.camera import Camera
from pnet.parts.base import ParametricPart
from pnet.parts.primitives import Freedom
from pnet.reporting.scene_view import Bodies, pose_bodies

Points = NDArray[np.float64]

PANEL = (520, 480)  # pixels
VIEWS = {  # caption → from where the camera looks, part frame
    "obliquely from above": (0.62, 0.70, 0.55),
    "from the side": (0.0, 1.0, 0.0),
    "from above, along z": (0.0, 0.0, 1.0),
}
_DISTANCE = 40.0  # sizes of the part: so far away that the view is nearly orthographic
_SECTIONS = 240  # polygon sides of a circle: no facets are seen
_TURNS = 72  # places on a circle of equivalents


@dataclass(frozen=True, eq=False)
class View:
    """One part as the camera of one panel sees it.

    Attributes:
        camera: the panel's. R: (3, 3), t: (3,) part → camera, metres. body: the part alone, camera frame.
    """

    camera: Camera
    R: Points
    t: Points
    body: Bodies

    def pixels(self, places: Points) -> Points:
        """(..., 3) part frame, metres → (..., 2) pixels of the panel."""
        return self.camera.project(places @ self.R.T + self.t)

    def hidden(self, places: Points) -> NDArray[np.bool_]:
        """Whether the body lies before places (n, 3), part frame, metres: (n,)."""
        seen = places @ self.R.T + self.t
        towards = -seen / np.linalg.norm(seen, axis=-1, keepdims=True)
        # from a little off the surface, so that a place on it does not hide itself
        start = seen + 0.005 * self.body.mesh.scale * towards
        return np.asarray(self.body.mesh.ray.intersects_first(start, towards) >= 0)


def part_views(part: ParametricPart, parameters: Points) -> list[View]:
    """The three views of a part's picture, in the order of VIEWS; parameters: (k,) metres."""
    return [look_from(part, parameters, side, PANEL, margin=(80, 54)) for side in VIEWS.values()]


def look_from(
    part: ParametricPart,
    parameters: Points,
    side: tuple[float, float, float],
    size: tuple[int, int],
    margin: tuple[int, int],
) -> View:
    """A far camera that frames the part, its keypoints and their equivalents.

    Args:
        parameters: (k,) metres. side: from the part to the camera, part frame.
        size: width and height of the panel. margin: what is kept free for labels left and right, and above
            and below; pixels.
    """
    part.check_named(parameters)
    R = _facing(np.array(side))
    curves = [curve for curves in equivalents(part, parameters, R[2]) for curve in curves]
    content = (
        np.concatenate([part.mesh(parameters).vertices, keypoint_places(part, parameters), *curves]) @ R.T
    )
    low, high = content.min(0), content.max(0)
    distance = _DISTANCE * float(np.linalg.norm(high - low))
    width, height = size
    fill = np.array([width - 2 * margin[0], height - 2 * margin[1]]) / (high - low)[:2]
    focal = distance * float(fill.min())
    camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    t = np.array([0, 0, distance]) - (low + high) / 2
    return View(camera, R, t, pose_bodies(part, _SECTIONS, R[None], t[None], parameters[None]))


def keypoint_places(part: ParametricPart, parameters: Points) -> Points:
    """(1 + m, 3) the centroid and the template's keypoints, part frame, metres; parameters: (k,) metres."""
    keypoints = part.chain.keypoints_from_parameters(torch.from_numpy(parameters)).numpy()
    return np.concatenate([np.zeros((1, 3)), keypoints])


def equivalents(part: ParametricPart, parameters: Points, forward: Points) -> list[list[Points]]:
    """Where else each keypoint could be: R(kp) of Fig. 4.

    Args:
        parameters: (k,) metres. forward: (3,) the view's direction, about which a sphere has its outline.
    Returns:
        For each keypoint its places: (1, 3) single ones, (73, 3) closed circles, part frame, metres.
    """
    group = part.chain.group.numpy()
    size = float(np.abs(keypoint_places(part, parameters)).max())
    owns = [_own_places(part, parameters, i, forward) for i in range(len(part.chain))]
    return [_distinct([own @ element.T for element in group], size) for own in owns]


def _own_places(part: ParametricPart, parameters: Points, i: int, forward: Points) -> Points:
    """The places that a keypoint has by its own freedom, or by that of a keypoint that it hangs on."""
    places, free = keypoint_places(part, parameters), i
    while part.chain.keypoints[free].primitive.freedom is Freedom.NONE:
        if part.chain.reference[free] == 0:
            return places[i + 1 : i + 2]
        free = part.chain.reference[free] - 1
    centre = places[part.chain.reference[free]]
    primitive, step = part.chain.keypoints[free].primitive, places[i + 1] - centre
    if primitive.freedom is Freedom.TURN:
        return centre + _turned(step, primitive.axis.numpy())
    across = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    return centre + _turned(np.linalg.norm(step) * across / np.linalg.norm(across), forward)


def _turned(step: Points, axis: Points) -> Points:
    """A vector (3,) turned about a unit axis (3,) all the way round: (73, 3), the last one the first."""
    angle = np.linspace(0, 2 * np.pi, _TURNS + 1)[:, None]
    along = (step @ axis) * axis
    return along + np.cos(angle) * (step - along) + np.sin(angle) * np.cross(axis, step)


def _distinct(curves: list[Points], size: float) -> list[Points]:
    """Those that lie elsewhere than all before; a circle that starts at another of its points is the same."""
    kept: dict[tuple[float, ...], Points] = {}
    for curve in curves:
        places = curve[:_TURNS] / size
        mark = np.r_[places.mean(0), (places.T @ places).ravel() / len(places)]
        kept.setdefault(tuple(np.round(mark + 1e-9, 5).tolist()), curve)
    return list(kept.values())


def _facing(side: Points) -> Points:
    """(3, 3) part → camera: looks against a direction, with z upwards, or y where it looks along z."""
    forward = -side / np.linalg.norm(side)
    up = np.array([0.0, 1.0, 0.0]) if abs(forward[2]) > 0.99 else np.array([0.0, 0.0, 1.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])
