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
