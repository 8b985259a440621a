"""Points that lie on their bodies agree with the poses; turned, shifted or shrunk ones do not."""

from dataclasses import replace

import numpy as np
import pytest

from pnet.data.agreement import agreement


@pytest.fixture(scope="module")
def scene(factory):
    """A pile's scene as the camera sees it."""
    from pnet.parts.spread import spread_order

    protocol = factory.piles.protocol
    grids = {name: spread_order(grid) for name, grid in factory.piles.part.grids.items()}
    task = next(task for task in protocol.tasks(grids) if task.split == "val")
    return factory.make_cycle(task).scenes[-1]


pytestmark = pytest.mark.usefixtures("bullet")


def test_a_rendered_scene_agrees_with_itself(scene, tn34):
    found = agreement(scene, tn34)
    assert found.share > 0.99 and found.gap < 1e-6 and found.is_good


@pytest.mark.parametrize(
    "change",
    [
        lambda s: {"t": s.t + np.array([0.02, 0, 0])},
        lambda s: {"R": np.swapaxes(s.R, 1, 2), "t": s.t * [-1, 1, 1]},
        lambda s: {"instance": np.roll(s.instance, 97)},
    ],
    ids=["shifted", "mirrored", "other ids"],
)  # fmt: skip
def test_wrong_frames_and_ids_show(scene, tn34, change):
    assert agreement(replace(scene, **change(scene)), tn34).share < 0.8


def test_a_wrong_depth_shows_in_the_gap(scene, tn34):
    nearer = replace(scene, points=scene.points * np.float32(0.99))
    assert agreement(nearer, tn34).gap == pytest.approx(0.01 * np.median(scene.points[:, 2]), rel=0.05)


def test_nothing_agrees_with_nothing(scene, tn34):
    empty = replace(scene, points=scene.points[:0], instance=scene.instance[:0])
    assert np.isnan(agreement(empty, tn34).share) and not agreement(empty, tn34).is_good
