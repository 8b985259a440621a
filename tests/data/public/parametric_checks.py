"""What must hold of every scene, and what may happen to damaged files of the Parametric data set."""

import shutil
from pathlib import Path

import numpy as np
from tests.data.public.conftest import MUTATIONS
from tests.data.public.conftest import assert_is_scene as assert_promises
from tests.mutations import mutate_folder

from pnet.data.public.parametric import ParametricData
from pnet.parts.base import ParametricPart
from pnet.records import Scene


def assert_is_scene(scene: Scene, points: int) -> None:
    """The promises of `Scene`, for the three sizes of a nut."""
    assert_promises(scene, points, tolerance=1e-3, measured=False)
    assert scene.parameters.shape == (len(scene.R), 3)


def read_everything(data: ParametricData, part: ParametricPart) -> int:
    """Read all scenes of both splits of the training set; how many there are."""
    data.manifest()
    count = 0
    for split in ("train", "val"):
        for scene in data.scenes(split, part):
            assert_is_scene(scene, data.points)
            count += 1
    return count


def damage_and_read(whole: Path, copies: Path, part: ParametricPart, first: int = 0) -> dict[str, int]:
    """Read `MUTATIONS` damaged copies of a folder; how many were read, and how many gave which error."""
    outcomes: dict[str, int] = {}
    for seed in range(first, first + MUTATIONS):
        copy = copies / str(seed)
        shutil.copytree(whole, copy)
        done = mutate_folder(copy, np.random.default_rng(seed))
        try:
            read_everything(ParametricData(str(copy), points=64), part)
            outcome = "read"
        except (ValueError, OSError, ModuleNotFoundError) as fault:
            assert str(copy) in str(fault), f"seed {seed} ({done}): names no file: {fault}"
            outcome = type(fault).__name__
        except Exception as fault:
            raise AssertionError(f"seed {seed} ({done})") from fault
        outcomes[outcome] = outcomes.get(outcome, 0) + 1
        shutil.rmtree(copy)
    return outcomes
