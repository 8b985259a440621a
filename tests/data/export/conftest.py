"""Scenes in which bodies hide each other, reach over the image's border and lie outside of it; a plain ray
caster to check images with."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pnet.data.source import SceneSet
from pnet.geometry.camera import Camera
from pnet.parts.tn34 import TN34
from pnet.records import Scene, SceneId
from pnet.scenes.noise import NoNoise
from pnet.scenes.pile import Pile
from pnet.scenes.view_factory import ViewFactory
from pnet.scenes.viewpoints import Viewpoints


class ListedScenes(SceneSet):
    """Scenes in memory."""

    def __init__(self, scenes: Sequence[Scene]) -> None:
        self.scenes = list(scenes)

    @property
    def ids(self) -> list[SceneId]:
        return [scene.id for scene in self.scenes]

    @property
    def points_per_scene(self) -> int:
        return len(self.scenes[0].points)

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, index: int) -> Scene:
        return self.scenes[index]


@pytest.fixture(scope="session")
def listed() -> Callable[[Sequence[Scene]], SceneSet]:
    return ListedScenes


@pytest.fixture(scope="session")
def eye() -> Camera:
    """Some 2.8 mm a pixel; the numbers are not round on purpose."""
    return Camera(96, 72, 231.3, 229.1, 46.7, 36.4, near=0.31, far=1.03)


@pytest.fixture(scope="session")
def flange() -> TN34:
    """Two part objects, few faces."""
    return TN34({"r": [15, 20], "h": [12]}, sections=12)


@pytest.fixture(scope="session")
def make_set(eye: Camera) -> Callable[..., ListedScenes]:
    """Scenes as pnet-generate makes them, but for the physics: a heap of `drop` bodies without regard to
    overlap; the first reaches over the image's border, the second lies outside of it, the third low in the
    middle."""

    def make(
        part,
        drops=(1, 6),
        cycles=(3,),
        objects=(0,),
        kind="pile",
        split="test_l",
        noise=None,
        viewpoints=None,
        camera=eye,
        points=400,
    ):
        factory = ViewFactory(part, camera, viewpoints or Viewpoints(), noise or NoNoise(), points)
        scenes = []
        for index in objects:
            for cycle in cycles:
                for drop in drops:
                    rng = np.random.default_rng([index, cycle, drop])
                    t = rng.uniform((-0.05, -0.04, 0.025), (0.05, 0.04, 0.06), (drop, 3))
                    t[:3] = [[-0.12, 0, 0.03], [0.3, 0, 0.03], [0, 0, 0.025]][:drop]
                    pile = Pile(Rotation.random(drop, rng).as_matrix(), t, drop)
                    one = SceneId(split, kind, cycle, index, drop)
                    scenes.append(factory.view(pile, part.part_object("L", index), one, rng))
        return ListedScenes(scenes)

    return make


def near_triangle(camera: Camera, corners: np.ndarray, margin: int) -> tuple[slice, slice]:
    """Rows and columns that may see a triangle: all where it reaches behind the camera."""
    if corners[:, 2].min() <= 0:
        return np.s_[:, :]
    x, y, z = corners.T
    u, v = camera.fx * x / z + camera.cx + margin, camera.fy * y / z + camera.cy + margin
    return tuple(slice(max(int(w.min()) - 1, 0), max(int(w.max()) + 2, 0)) for w in (v, u))


@pytest.fixture(scope="session")
def naive_depth() -> Callable[..., np.ndarray]:
    """Planar depth of triangles by Möller and Trumbore's test of every ray against every triangle, in double
    precision; infinite where none is."""

    def cast(camera: Camera, triangles: np.ndarray, margin: int = 0) -> np.ndarray:
        v, u = np.mgrid[-margin : camera.height + margin, -margin : camera.width + margin]
        every = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)
        found = np.full(u.shape, np.inf)
        for a, b, c in triangles:
            place = near_triangle(camera, np.stack([a, b, c]), margin)
            rays = every[place]
            with np.errstate(divide="ignore", invalid="ignore"):
                p = np.cross(rays, c - a)
                scale = 1 / (p @ (b - a))
                x = -(p @ a) * scale
                q = np.cross(-a, b - a)
                y = (rays @ q) * scale
                z = ((c - a) @ q) * scale
            hit = (x >= 0) & (y >= 0) & (x + y <= 1) & (z > 0)
            found[place] = np.where(hit & (z < found[place]), z, found[place])
        return found

    return cast


@pytest.fixture(scope="session")
def triangles_of() -> Callable[..., np.ndarray]:
    """(f, 3, 3) triangles of a body in the camera frame."""
    return lambda mesh, R, t: mesh.triangles @ R.T + t
