"""Parts to draw, and a scene small enough to count: three flanges side by side, points on their faces."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.conftest import Marble

from pnet.geometry.camera import Camera
from pnet.geometry.symmetry import RevolutionSymmetry
from pnet.parts.base import ParametricPart
from pnet.parts.primitives import Plane
from pnet.parts.selection import Keypoint
from pnet.parts.solids import cylinder
from pnet.parts.tn34 import TN34
from pnet.parts.tn42 import TN42
from pnet.records import Detections, Scene, SceneId

R, H = 0.018, 0.016
POINTS_PER_BODY = 200


class Disc(ParametricPart):
    """One keypoint on the axis."""

    name = "disc"
    parameter_names = ("h",)
    symmetry = RevolutionSymmetry(rotoreflection=True)
    keypoints = (Keypoint("face", "centroid", Plane("z"), "h", factor=0.5),)

    def solid(self, parameters):
        (h,) = self.split(parameters)
        return cylinder(0.01 + 0 * h, -h / 2, h / 2)


@pytest.fixture(scope="session")
def marble() -> ParametricPart:
    return Marble({"r": [10]})


@pytest.fixture(scope="session")
def disc() -> ParametricPart:
    return Disc({"h": [12]})


@pytest.fixture(scope="session")
def bar() -> ParametricPart:
    return TN42(learning={"l": [40], "a": [16], "w": [12]})


@pytest.fixture(scope="session")
def flange() -> ParametricPart:
    return TN34(learning={"r": [18], "h": [16]}, generalization={"r": [18], "h": [16]})


@pytest.fixture
def scene(flange: ParametricPart) -> Scene:
    """Three bodies 60 mm apart along x, their tops towards the camera."""
    parameters = np.tile([R, H], (3, 1))
    facing = np.diag([1.0, -1.0, -1.0])
    t = np.array([[-0.06, 0, 0.6], [0, 0, 0.6], [0.06, 0, 0.6]])
    samples = flange.mesh(parameters[0]).sample(POINTS_PER_BODY, seed=0)
    points = np.concatenate([samples @ facing.T + place for place in t])
    return Scene(
        points=points.astype(np.float32),
        instance=np.repeat(np.arange(3), POINTS_PER_BODY),
        R=np.tile(facing, (3, 1, 1)),
        t=t,
        parameters=parameters,
        visibility=np.ones(3),
        occlusion=np.zeros(3),
        camera=Camera(160, 128, 375.0, 375.0, 79.5, 63.5, near=0.3, far=1.0),
        part="tn34",
        id=SceneId("test_l", "pile", 0, 0, 3),
    )


@pytest.fixture
def detect(scene: Scene) -> Callable[[list[int]], Detections]:
    """Detections of the bodies of a list, in their true poses, with scores 0.9, 0.8, …"""

    def make(bodies: list[int]) -> Detections:
        number = np.full(3, -1)
        number[bodies] = np.arange(len(bodies))
        return Detections(
            R=torch.from_numpy(scene.R[bodies]),
            t=torch.from_numpy(scene.t[bodies]),
            parameters=torch.from_numpy(scene.parameters[bodies]),
            score=0.9 - 0.1 * torch.arange(len(bodies)).double(),
            keypoints=torch.zeros(len(bodies), 3, 3).double(),
            instance=torch.from_numpy(number[scene.instance]),
        )

    return make


@pytest.fixture
def empty_scene(scene: Scene) -> Scene:
    """No points, no truth."""
    return replace(
        scene,
        points=scene.points[:0],
        instance=scene.instance[:0],
        R=scene.R[:0],
        t=scene.t[:0],
        parameters=scene.parameters[:0],
        visibility=scene.visibility[:0],
        occlusion=scene.occlusion[:0],
    )


@pytest.fixture
def nothing(detect: Callable[[list[int]], Detections]) -> Detections:
    """No detections in a scene without points."""
    return replace(detect([]), instance=torch.zeros(0, dtype=torch.int64))


@pytest.fixture
def sizeless() -> Callable[[Detections], Detections]:
    """The same detections by a method that knows of no sizes (PPR-Net)."""

    def make(found: Detections) -> Detections:
        unknown = torch.full_like(found.parameters, torch.nan)
        return replace(found, parameters=unknown, keypoints=torch.full_like(found.keypoints, torch.nan))

    return make
