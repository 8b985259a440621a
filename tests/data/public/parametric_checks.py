"""What must hold of every scene, and what may happen to damaged files of the Parametric data set."""

import os
import shutil
from pathlib import Path

import numpy as np
from tests.mutations import mutate_folder

from pnet.data.public.parametric import ParametricData
from pnet.parts.base import ParametricPart
from pnet.records import Scene

MUTATIONS = int(os.environ.get("PNET_MUTATIONS", "200"))


def assert_is_scene(scene: Scene, points: int) -> None:
    """The promises of `Scene`."""
    d, n = len(scene.R), len(scene.points)
    assert n in (0, points)
    assert scene.points.shape == (n, 3) and scene.points.dtype == np.float32
    assert np.isfinite(scene.points).all() and (scene.points[:, 2] > 0).all()
    assert scene.instance.shape == (n,) and scene.instance.dtype == np.int64
    assert ((scene.instance >= 0) & (scene.instance < d)).all()
    assert scene.R.shape == (d, 3, 3) and scene.t.shape == (d, 3)
    assert np.isfinite(scene.t).all()
    assert np.abs(scene.R @ scene.R.swapaxes(1, 2) - np.eye(3)).max() <= 1e-3
    assert (np.linalg.det(scene.R) > 0).all()
    assert scene.parameters.shape == (d, 3) and (scene.parameters > 0).all()
    for share in (scene.visibility, scene.occlusion):
        assert share.shape == (d,) and ((share >= 0) & (share <= 1)).all()
    for values in (scene.incidence, scene.edge):
        assert values is None or (values.shape == (n,) and values.dtype == np.uint8)


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
