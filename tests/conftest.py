"""What several rooms' tests share: the two templates as the configs have them, a tiny data set's maker."""

import os
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from scipy.spatial.transform import Rotation

from pnet.cli.instantiate import instantiate
from pnet.geometry.camera import Camera
from pnet.geometry.symmetry import SphericalSymmetry
from pnet.parts.base import ParametricPart
from pnet.parts.primitives import Sphere
from pnet.parts.selection import Keypoint
from pnet.parts.shapes import Ball
from pnet.records import Scene, SceneId
from pnet.scenes.bullet import BulletPhysics
from pnet.scenes.clutter import Clutter
from pnet.scenes.factory import SceneFactory
from pnet.scenes.noise import NoNoise
from pnet.scenes.pile import Bin
from pnet.scenes.pile_factory import PileFactory
from pnet.scenes.protocol import Protocol, SplitPlan
from pnet.scenes.store import CycleHeader, write_cycle
from pnet.scenes.view_factory import ViewFactory
from pnet.scenes.viewpoints import Viewpoints

CONF = Path(__file__).parents[1] / "conf"

if not torch.cuda.is_available():  # Triton asks once, when something first imports it
    os.environ["TRITON_INTERPRET"] = "1"


class Marble(ParametricPart):
    """One keypoint, one parameter, every rotation a symmetry."""

    name = "marble"
    parameter_names = ("r",)
    symmetry = SphericalSymmetry()
    keypoints = (Keypoint("surface", "centroid", Sphere(), "r"),)

    def solid(self, parameters):
        return Ball(self.split(parameters)[0])


def load_part(name: str) -> ParametricPart:
    """A template as conf/part has it."""
    part: ParametricPart = instantiate(OmegaConf.load(CONF / "part" / f"{name}.yaml"))
    return part


@pytest.fixture(scope="session")
def bullet() -> None:
    """For `usefixtures`: skips what needs the physics engine. Not importorskip, the import prints."""
    if find_spec("pybullet") is None:
        pytest.skip("needs the extra [sim]")


@pytest.fixture(scope="session")
def tn06() -> ParametricPart:
    return load_part("tn06")


@pytest.fixture(scope="session")
def tn34() -> ParametricPart:
    return load_part("tn34")


@pytest.fixture(scope="session", params=["tn06", "tn34"])
def part(request: pytest.FixtureRequest) -> ParametricPart:
    """Each template in turn."""
    return load_part(request.param)


@pytest.fixture(scope="session")
def camera() -> Camera:
    """The paper's field of view in few pixels: 1.7 mm a pixel at the bin's floor."""
    return Camera(160, 128, 375.0, 375.0, 79.5, 63.5, near=0.3, far=1.0)


@pytest.fixture(scope="session")
def box() -> Bin:
    return Bin(0.15, 0.15, 0.15)


@pytest.fixture(scope="session")
def factory(tn34: ParametricPart, camera: Camera, box: Bin) -> SceneFactory:
    """Three drops, two part objects: two piles and two clutters to train on, one pile to validate."""
    splits = {
        "train": SplitPlan("L", cycles=1, objects=[0, 5], clutter=0.5),
        "val": SplitPlan("L", cycles=1, first_cycle=1, objects=[0]),
    }
    protocol = Protocol("tiny", drop_limit=3, points=256, splits=splits)
    piles = PileFactory(
        tn34, protocol, box, BulletPhysics(), Clutter(spacing=0.6), seed=0, fingerprint="tiny"
    )
    views = ViewFactory(tn34, camera, Viewpoints(), NoNoise(), protocol.points)
    return SceneFactory(piles, views, fingerprint="tiny")


@pytest.fixture(scope="session")
def make_scene(camera: Camera) -> Callable[..., Scene]:
    """Makes a scene without physics: bodies 50 mm apart in random orientations, points in random order."""

    def make(part: ParametricPart, bodies: int = 4, points: int = 400, seed: int = 0) -> Scene:
        rng = np.random.default_rng(seed)
        size = part.part_object("L", seed % len(part.grids["L"]))
        R = Rotation.random(bodies, rng).as_matrix()
        column, row = np.arange(bodies) % 3, np.arange(bodies) // 3
        t = np.stack([0.05 * (column - 1), 0.05 * (row - 1), 0.6 + 0.002 * np.arange(bodies)], -1)
        instance = rng.permutation(np.arange(points) % bodies)
        surface = part.mesh(size).sample(points, seed=seed)
        cloud = np.einsum("nij,nj->ni", R[instance], surface) + t[instance]
        return Scene(
            points=cloud.astype(np.float32),
            instance=instance,
            R=R,
            t=t,
            parameters=np.tile(size, (bodies, 1)),
            visibility=0.5 + 0.5 * rng.random(bodies),
            occlusion=0.4 * rng.random(bodies),
            camera=camera,
            part=part.name,
            id=SceneId("train", "pile", 0, 0, bodies),
        )

    return make


@pytest.fixture(scope="session")
def write_split(make_scene: Callable[..., Scene]) -> Callable[..., list[Scene]]:
    """Writes a split of such scenes, one more body in each, and returns them in the order of reading."""

    def write(
        root: Path, part: ParametricPart, split: str, cycles: int = 2, scenes: int = 3, points: int = 256
    ) -> list[Scene]:
        (root / split).mkdir(parents=True)
        written: list[Scene] = []
        for cycle in range(cycles):
            drops = tuple(range(1, scenes + 1))
            made = [
                replace(make_scene(part, drop, points, 10 * cycle), id=SceneId(split, "pile", cycle, 0, drop))
                for drop in drops
            ]
            header = CycleHeader("tiny", part.name, made[0].camera, split, "pile", cycle, 0, drops)
            write_cycle(root / split / f"pile_{cycle:04d}_part_00.safetensors", header, made)
            written += made
        return written

    return write
