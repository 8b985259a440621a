"""Where texts go."""

from itertools import combinations

import numpy as np

from pnet.reporting.part_labels import place_labels


def test_labels_of_one_crowded_place_find_room():
    anchors = np.tile([[60.0, 60.0]], (6, 1))
    sizes = np.tile([[80.0, 16.0]], (6, 1))
    centres = place_labels(anchors, sizes, anchors[:1], np.zeros((0, 2)), (400, 300))
    for a, b in combinations(centres, 2):
        assert (np.abs(a - b) >= [80, 16]).any()
    assert (centres - sizes / 2 > 0).all() and (centres + sizes / 2 < [400, 300]).all()
    assert (np.abs(centres - [60, 60]) > [40, 8]).any(1).all()
