"""What several rooms' tests share: the two templates as the configs have them, a tiny data set's maker."""

from importlib.util import find_spec
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from pnet.cli.instantiate import instantiate
from pnet.geometry.camera import Camera
from pnet.parts.base import ParametricPart
from pnet.scenes.factory import SceneFactory
from pnet.scenes.pile import Bin
from pnet.scenes.piling import Physics
from pnet.scenes.protocol import Protocol, SplitPlan

CONF = Path(__file__).parents[1] / "conf"


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
    return SceneFactory(
        tn34,
        protocol,
        camera,
        box,
        Physics(),
        camera_height=0.65,
        clutter_spacing=0.6,
        seed=0,
        fingerprint="tiny",
    )
