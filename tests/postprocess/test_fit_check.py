"""How exactly exact keypoints give the pose back."""

import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from pnet.geometry.symmetry import cyclic
from pnet.parts.choice import KeypointRule
from pnet.parts.tn06 import TN06
from pnet.parts.tn42 import TN42
from pnet.postprocess.fit_check import fit_error

GRID = {"l": [30, 48], "a": [10, 19], "w": [8, 17]}


@pytest.mark.parametrize("rule", list(KeypointRule))
def test_of_a_sound_part_only_rounding_is_left(any_part, rule):
    angle, distance = fit_error(any_part, rule, samples=20)
    assert angle < 1e-6 and distance < 1e-9


def test_labels_turned_against_the_declaration_are_found():
    part = TN42(GRID)
    turn = Rotation.from_euler("z", 0.1).as_matrix()
    select = part.chain.select

    def turned(*arguments):
        local, choice = select(*arguments)
        return local @ torch.from_numpy(turn).mT, choice

    part.chain.select = turned
    angle, distance = fit_error(part, KeypointRule.CAMERA, samples=20)
    assert angle == pytest.approx(math.sin(0.1), rel=0.1)  # the largest entry of the difference
    assert distance < 1e-9  # turned about the centroid


def test_labels_off_the_declaration_are_found():
    part = TN42(GRID)
    select = part.chain.select

    def moved(*arguments):
        local, choice = select(*arguments)
        return local + torch.tensor([0.005, 0, 0], dtype=local.dtype), choice

    part.chain.select = moved
    angle, distance = fit_error(part, KeypointRule.CAMERA, samples=20)
    assert angle < 0.6 and 0.003 < distance < 0.005  # four keypoints of five points say so


def test_keypoints_of_more_symmetry_than_the_part_has_leave_half_a_turn():
    part = TN06({"r": [3, 5], "h": [8, 11], "d": [12, 18]})
    part.symmetry = cyclic(1)
    angle, distance = fit_error(part, KeypointRule.CAMERA, samples=200)
    assert angle > 1.9 and distance < 1e-9


def test_the_samples_come_from_the_seed(tn42):
    rule = KeypointRule.POINT
    assert fit_error(tn42, rule, 10, seed=1) == fit_error(tn42, rule, 10, seed=1)
    assert fit_error(tn42, rule, 10, seed=1) != fit_error(tn42, rule, 10, seed=2)
