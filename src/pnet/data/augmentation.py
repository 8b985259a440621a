"""Augmentation of a scene; labels are made afterwards, so they stay true."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pnet.records import Scene


@dataclass(frozen=True)
class Augmentation:
    """What is done to a training scene.

    Attributes:
        rotate: turn by a random angle about the view axis; a pinhole view stays one.
        jitter: standard deviation of Gaussian noise on every coordinate, metres (the released code has
            0.0005, the paper none).
    """

    rotate: bool = True
    jitter: float = 0.0

    def __call__(self, scene: Scene, rng: np.random.Generator) -> Scene:
        """A changed copy of the scene."""
        if self.rotate:
            scene = rotate_about_view_axis(scene, rng.uniform(0, 2 * np.pi))
        if self.jitter > 0:
            noise = rng.normal(0, self.jitter, scene.points.shape).astype(np.float32)
            scene = replace(scene, points=scene.points + noise)
        return scene


def rotate_about_view_axis(scene: Scene, angle: float) -> Scene:
    """Turn points and poses about the camera's z axis by `angle` radians."""
    c, s = np.cos(angle), np.sin(angle)
    turn: NDArray[np.float64] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    points = (scene.points @ turn.T.astype(np.float32)).astype(np.float32)
    return replace(scene, points=points, R=turn @ scene.R, t=scene.t @ turn.T)
