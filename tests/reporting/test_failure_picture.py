"""The picture of a scene's failures."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from pnet.metrics.breakdown import break_down
from pnet.parts.choice import KeypointChoice, KeypointRule
from pnet.reporting.failure_picture import failure_figure, failure_picture, outline
from pnet.reporting.picture import SIZE

CHOICE = KeypointChoice(KeypointRule.POINT)


@pytest.fixture
def draw(flange):
    """The figure of a scene and its detections."""

    def make(scene, found):
        rows = break_down(flange, CHOICE, [scene], [found])
        return failure_figure(scene, found, rows.truths, rows.results, flange)

    return make


def words(axes):
    return [text.get_text() for text in axes.texts]


def test_the_file_is_a_picture_of_the_usual_size(scene, detect, flange, tmp_path):
    found = detect([0, 2])
    rows = break_down(flange, CHOICE, [scene], [found])
    failure_picture(scene, found, rows.truths, rows.results, flange, tmp_path / "worst.png")
    with Image.open(tmp_path / "worst.png") as picture:
        assert picture.size == SIZE
    assert [path.name for path in tmp_path.iterdir()] == ["worst.png"]


def test_only_bodies_that_were_not_found_are_marked(scene, detect, draw):
    figure = draw(scene, detect([0, 2]))
    left, right = figure.axes
    assert words(left) == ["missed"] and len(left.lines) == len(right.lines) == 1
    assert "1 of 3 bodies to find not found" in figure.texts[-1].get_text()


def test_a_wrong_pose_says_what_is_wrong(scene, detect, draw):
    found = detect([0, 1, 2])
    R, t = found.R.clone(), found.t.clone()
    R[0] = R[0] @ torch.diag(torch.tensor([1.0, -1, -1])).double()
    t[1] = t[1] + torch.tensor([0.0, 0.0, 0.02])
    assert words(draw(scene, replace(found, R=R, t=t)).axes[0]) == ["rotation 180°", "position"]


def test_all_found_marks_nothing_and_so_does_an_empty_scene(
    scene, detect, draw, empty_scene, nothing, sizeless
):
    assert words(draw(scene, detect([0, 1, 2])).axes[0]) == []
    assert words(draw(empty_scene, nothing).axes[0]) == []
    axes = draw(scene, sizeless(detect([0, 1, 2]))).axes[1]
    assert len(axes.lines) == 9  # axes stand for bodies without sizes


def test_an_outline_is_convex_and_closed(scene):
    z = np.full(5, 0.5)
    square = np.c_[[0, 0.1, 0.1, 0, 0.05], [0, 0, 0.1, 0.1, 0.05], z]
    line = outline(scene.camera, square)
    assert len(line) == 5 and np.allclose(line[0], line[-1])
    assert outline(scene.camera, np.c_[[0, 0.1, 0.2], [0, 0, 0], z[:3]]).shape == (0, 2)
    assert outline(scene.camera, -square).shape == (0, 2)
