"""Piles at hand-placed poses on a floor, as a camera sees them: what the tests write in others' layouts."""

import os
import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.conftest import load_part
from tests.mutations import mutate_folder

from pnet.data.source import DataSource
from pnet.geometry.camera import Camera
from pnet.parts.base import ParametricPart
from pnet.records import Scene
from pnet.scenes.rendering import render_view

MUTATIONS = int(os.environ.get("PNET_MUTATIONS", "200"))

# six bodies: the image's border cuts the first, the second stands free, the fourth lies before the third, the
# sixth before the fifth
PLACES = [[-0.27, -0.1, 0.9], [0.15, -0.11, 0.95], [-0.11, 0.1, 1.0], [-0.08, 0.09, 0.8]]
PLACES += [[0.14, 0.1, 1.1], [0.11, 0.078, 0.85]]
TURNS = [
    [0.4, 0.2, 0.1],
    [1.6, 0.3, -0.4],
    [2.6, -0.5, 0.8],
    [0.1, -1.1, 2.0],
    [1.0, 1.0, 0.3],
    [0.2, 0.1, 0],
]
FLOOR = np.array([0.05, -0.08, 1.0]), 1.25  # normal and offset: n · x = offset, metres, camera frame


@dataclass(frozen=True, eq=False)
class Picture:
    """A camera's view of bodies of one part object, and the truth.

    Attributes:
        part, camera: what and by what. R: (d, 3, 3), t: (d, 3) part → camera, metres.
        depth: (h, w) planar depth of bodies and floor, instance: (h, w), −1 for the floor.
        floor: (h, w) planar depth of the floor alone. occlusion: (d,). visible: (d,) pixels.
    """

    part: ParametricPart
    camera: Camera
    R: np.ndarray
    t: np.ndarray
    depth: np.ndarray
    instance: np.ndarray
    floor: np.ndarray
    occlusion: np.ndarray
    visible: np.ndarray

    @property
    def cloud(self) -> np.ndarray:
        """(h, w, 3) exact points, the camera's formula written out."""
        v, u = np.indices(self.depth.shape)
        c = self.camera
        x, y = (u - c.cx) / c.fx, (v - c.cy) / c.fy
        return np.stack([x, y, np.ones_like(x)], -1) * self.depth[..., None]


def take_picture(part: ParametricPart, camera: Camera, bodies: int = len(PLACES)) -> Picture:
    """The first so many bodies of the part's only part object, before the floor."""
    R = Rotation.from_rotvec(TURNS).as_matrix()[:bodies]
    t = np.reshape(PLACES[:bodies], (-1, 3))
    view = render_view(camera, part.mesh(part.part_object("L", 0)), R, t)
    v, u = np.indices((camera.height, camera.width))
    ray = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)
    floor = FLOOR[1] / (ray @ FLOOR[0])
    assert (view.depth < floor).all()  # nothing is below it
    depth = np.where(view.instance < 0, floor, view.depth)
    return Picture(part, camera, R, t, depth, view.instance, floor, view.occlusion, view.visible)


def assert_is_scene(scene: Scene, points: int, tolerance: float = 1e-9, measured: bool = True) -> None:
    """The promises of `Scene`. tolerance: of rotations. measured: it came from a depth image."""
    d, n = len(scene.R), len(scene.points)
    assert n in (0, points)
    assert scene.points.shape == (n, 3) and scene.points.dtype == np.float32
    assert np.isfinite(scene.points).all() and (scene.points[:, 2] > 0).all()
    assert scene.instance.shape == (n,) and scene.instance.dtype == np.int64
    assert ((scene.instance >= 0) & (scene.instance < d)).all()
    assert scene.R.shape == (d, 3, 3) and scene.t.shape == (d, 3)
    assert np.isfinite(scene.t).all()
    assert np.abs(scene.R @ scene.R.swapaxes(1, 2) - np.eye(3)).max(initial=0) <= tolerance
    assert (np.linalg.det(scene.R) > 0).all()
    assert scene.parameters.ndim == 2 and len(scene.parameters) == d
    assert np.isfinite(scene.parameters).all() and (scene.parameters > 0).all()
    for share in (scene.visibility, scene.occlusion):
        assert share.shape == (d,) and ((share >= 0) & (share <= 1)).all()
    for values in (scene.incidence, scene.edge):
        assert values is not None or not measured
        assert values is None or (values.shape == (n,) and values.dtype == np.uint8)


@pytest.fixture(scope="session", params=["gear", "candlestick"])
def fixed_part(request: pytest.FixtureRequest) -> ParametricPart:
    """Each part of one size in turn."""
    return load_part(request.param)


@pytest.fixture(scope="session")
def gear() -> ParametricPart:
    return load_part("gear")


def round_trip_errors(scene: Scene, picture: Picture) -> dict[str, float]:
    """Compare a scene with the picture that it was written from.

    Returns:
        Largest errors: of R; of t, of the points against the exact cloud, and of their depth, all mm.
    """
    uv = picture.camera.project(scene.points)
    u, v = np.rint(uv).astype(int).T
    assert np.abs(uv - np.stack([u, v], -1)).max() < 1e-3  # pixels: float32 rounds
    np.testing.assert_array_equal(scene.instance, picture.instance[v, u])
    gap = scene.points - picture.cloud[v, u]
    return {
        "R": float(np.abs(scene.R - picture.R).max()),
        "t": 1000 * float(np.abs(scene.t - picture.t).max()),
        "point": 1000 * float(np.linalg.norm(gap, axis=1).max()),
        "z": 1000 * float(np.abs(gap[:, 2]).max()),
    }


def read_damaged(
    whole: Path,
    folder: Path,
    open_data: Callable[[str], DataSource],
    splits: Sequence[str],
    part: ParametricPart,
) -> Counter[str]:
    """Read `MUTATIONS` damaged copies of a data set.

    Args:
        whole: the data set; its scenes have 64 points. folder: for the copies. open_data: from a root.
        splits: to read.
    Returns:
        How many copies were not opened, and how many scenes of the others were read or refused.
    """
    outcomes: Counter[str] = Counter()
    for seed in range(MUTATIONS):
        copy = folder / f"seed_{seed}" / whole.name
        shutil.copytree(whole, copy)
        done = mutate_folder(copy, np.random.default_rng(seed))
        try:
            outcomes.update(_outcomes(copy, open_data(str(copy)), splits, part))
        except BaseException as fault:
            raise AssertionError(f"seed {seed} ({done}): {fault!r}") from fault
        shutil.rmtree(copy.parent)
    return outcomes


def _outcomes(root: Path, data: DataSource, splits: Sequence[str], part: ParametricPart) -> list[str]:
    """Of every scene of one data set; only what readers may raise is taken for a refusal."""
    found = []
    try:
        data.manifest()
        sets = [data.scenes(split, part) for split in splits]
    except (ValueError, OSError, ModuleNotFoundError) as fault:
        assert str(root.parent) in str(fault), "the error does not name the file"
        return ["not opened"]
    for scenes in sets:
        for index in range(len(scenes)):
            try:
                assert_is_scene(scenes[index], 64)
                found.append("read")
            except (ValueError, OSError, ModuleNotFoundError) as fault:
                assert str(root.parent) in str(fault), "the error does not name the file"
                found.append("refused")
    return found
