"""The selection loop's order, and a cone's two keypoints."""

import math

import numpy as np
import pytest
import torch

from pnet.geometry.symmetry import RevolutionSymmetry
from pnet.parts.keypoints import KeypointChain
from pnet.parts.primitives import Circle, Plane
from pnet.parts.selection import Keypoint, cone_keypoints, select_keypoints


def test_a_cone_is_measured_from_its_base():
    """Base centre 3 below the centroid, radius 2, height 12: the rule breaks the apex angle in two."""
    base = Keypoint("base", "centroid", Plane("-z", at=0))
    keypoints = [base, *cone_keypoints("rim", "tip", reference="base", axis="z", radius="r", height="h")]
    chain = KeypointChain(
        keypoints, ["r", "h"], RevolutionSymmetry(), None, lambda p: p[:, 1:] / 4 * np.array([[0, 0, 1]])
    )
    base, rim, tip = chain.keypoints_from_parameters(torch.tensor([0.002, 0.012]).double())
    assert base.tolist() == pytest.approx([0, 0, -0.003])
    assert rim.norm().item() == pytest.approx(math.hypot(0.002, 0.003)) and rim[2] == base[2]
    assert tip.tolist() == pytest.approx([0, 0, 0.009])


def test_keypoints_may_be_declared_in_any_order():
    declared = [
        Keypoint("rim", "top", Circle("z"), "r"),
        Keypoint("top", "base", Plane("z"), "h"),
        Keypoint("base", "centroid", Plane("-z", at=5)),
    ]
    assert [keypoint.name for keypoint in select_keypoints(declared, ["r", "h"])] == ["base", "top", "rim"]
    chain = KeypointChain(declared, ["r", "h"], RevolutionSymmetry())
    assert chain.reference == [0, 1, 2] and len(chain) == 3
