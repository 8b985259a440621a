"""The bin."""

import numpy as np
import pytest

from pnet.scenes.pile import Bin


def test_positions_over_the_floor_and_between_the_walls_are_inside():
    box = Bin(0.2, 0.1, 0.05)
    positions = np.array(
        [[0, 0, 0], [0.1, 0.05, 0.01], [0.101, 0, 0], [0, -0.051, 0], [0, 0, -0.001], [0, 0, 3]]
    )
    assert box.contains(positions).tolist() == [True, True, False, False, False, True]


def test_a_margin_grows_the_bin_on_every_side():
    box = Bin(0.2, 0.1, 0.05)
    positions = np.array([[0.105, 0, 0], [0, 0.055, 0], [0, 0, -0.005], [0.115, 0, 0], [0, 0, -0.015]])
    assert box.contains(positions, margin=0.01).tolist() == [True, True, True, False, False]


def test_batch_dimensions_are_kept():
    assert Bin(1, 1, 1).contains(np.zeros((4, 5, 3))).shape == (4, 5)


@pytest.mark.parametrize("size", [(0.0, 1.0, 1.0), (1.0, -0.1, 1.0), (1.0, 1.0, 0.0)])
def test_a_size_that_is_not_positive_is_refused(size):
    with pytest.raises(ValueError, match=r"bin is .*every size must be positive"):
        Bin(*size)


def test_floor_and_walls_stand_around_the_inside():
    """Nothing of them inside, no gap between them: every point just outside is in one, up to the rim."""
    box, wall = Bin(0.2, 0.1, 0.05), 0.02
    slabs = box.slabs(wall)
    assert len(slabs) == 5 and all((half > 0).all() for half, _ in slabs)
    inner = np.array([0.1, 0.05])

    def covered(position) -> bool:
        return any((np.abs(np.array(position) - centre) < half + 1e-12).all() for half, centre in slabs)

    rng = np.random.default_rng(0)
    for x, y, z in rng.uniform([-0.1, -0.05, 0], [0.1, 0.05, 0.2], (200, 3)) * 0.999:
        assert not covered((x, y, z + 1e-4))
        assert covered((x, y, -0.01 * rng.random()))
    for z in (-0.015, 0.001, 0.02, 0.049):
        for angle in np.linspace(0, 2 * np.pi, 100):
            way = np.array([np.cos(angle), np.sin(angle)])
            reach = (inner / np.maximum(np.abs(way), 1e-9)).min()
            assert covered((*(way * (reach + 0.001)), z))
    assert not covered((0.101, 0, 0.051)) and not covered((0, 0, -0.021))
