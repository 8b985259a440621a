"""The figure of errors."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from tests.conftest import Marble

from pnet.metrics.breakdown import break_down
from pnet.parts.choice import KeypointChoice, KeypointRule
from pnet.reporting.breakdown_summary import summary
from pnet.reporting.error_figure import HEIGHT, WIDTH, error_figure, error_picture
from pnet.reporting.error_panels import OUTCOME_COLOURS, boxes, histogram, lost_shares, waterfall

CHOICE = KeypointChoice(KeypointRule.POINT)


def figure_of(part, scenes, found):
    rows = break_down(part, CHOICE, scenes, found)
    return error_figure(rows, part, summary(rows, part, [f"a/{i}" for i in range(len(scenes))]))


def panels(figure):
    return {axes.get_title(loc="left"): axes for axes in figure.axes}


def texts(axes):
    return " ".join(text.get_text() for text in axes.texts)


@pytest.fixture
def axes():
    from matplotlib.figure import Figure

    return Figure().add_subplot()


def test_the_file_is_a_picture_and_nothing_else_is_left(scene, detect, flange, tmp_path):
    rows = break_down(flange, CHOICE, [scene], [detect([0, 2])])
    error_picture(rows, flange, summary(rows, flange, ["a/1"]), tmp_path / "errors.png")
    with Image.open(tmp_path / "errors.png") as picture:
        assert picture.size == (WIDTH, HEIGHT)
    assert [path.name for path in tmp_path.iterdir()] == ["errors.png"]


def test_bars_show_the_share_that_is_missed(scene, detect, flange):
    of = panels(figure_of(flange, [scene], [detect([0, 2])]))
    heights = [bar.get_height() for bar in of["Not found, by visibility"].patches]
    assert sum(heights) == pytest.approx(1 / 3) and texts(of["Not found, by visibility"]) == "3"
    assert "From 1 to AP" in " ".join(of) and "0.667" in texts(of["From 1 to AP (axis cut)"])


def test_a_method_without_sizes_says_so(scene, detect, flange, sizeless):
    of = panels(figure_of(flange, [scene], [sizeless(detect([0, 1, 2]))]))
    assert texts(of["Parameter error"]) == "no sizes are estimated"
    assert texts(of["Keypoint error"]) == "the method estimates no keypoints"


def test_an_empty_evaluation_has_a_figure(empty_scene, nothing, flange):
    of = panels(figure_of(flange, [empty_scene], [nothing]))
    assert texts(of["Position error"]) == "there is no result to compare"
    assert texts(of["Precision, by score"]) == "there is no result"


def test_a_sphere_has_no_tilt(make_scene):
    part = Marble({"r": [10]})
    scene = make_scene(part, 2)
    found = torch.from_numpy(scene.R), torch.from_numpy(scene.t), torch.from_numpy(scene.parameters)
    from pnet.records import Detections

    rest = torch.ones(2).double(), torch.zeros(2, 1, 3).double(), torch.from_numpy(scene.instance)
    of = panels(figure_of(part, [scene], [Detections(*found, *rest)]))
    assert texts(of["Not found, by tilt"]) == "no true pose has one"
    assert texts(of["Rotation error"]) == "no error can be told"


def test_few_are_pale(axes):
    shares = {outcome: np.array([0.1, 0.1]) for outcome in OUTCOME_COLOURS}
    lost_shares(axes, np.arange(2.0), shares, np.array([19, 20]))
    assert {bar.get_alpha() for bar in axes.patches[::2]} == {0.45}
    assert {bar.get_alpha() for bar in axes.patches[1::2]} == {1.0}


def test_the_steps_lead_from_one_to_ap(axes):
    losses = {"missed": 0.1, "wrong pose": 0.5}
    waterfall(axes, 0.4, losses, dict.fromkeys(losses, "k"))
    tops = [bar.get_y() + bar.get_height() for bar in axes.patches]
    assert tops == pytest.approx([1, 1, 0.9, 0.4])
    assert axes.patches[2].get_y() == pytest.approx(0.4) and axes.get_ylim()[0] == 0


def test_boxes_tell_mean_bias_and_count(axes):
    boxes(axes, np.array([[1.0, np.nan], [-3.0, np.nan]]), ["a", "b"])
    assert texts(axes) == "mean 2.00\nbias -1.00\nn 2"


def test_the_last_bar_holds_everything_larger(axes):
    histogram(axes, np.array([0.5, 7.0, 9.0, np.nan]), np.array([False, False, True, False]), 4.0)
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels == ["within (2)", "beyond by it alone (1)"]
    assert axes.get_xlim() == (0, 4)


def test_bodies_that_are_all_hidden_leave_no_true_pose(scene, detect, flange):
    few = replace(scene, occlusion=np.full(3, 0.9))
    of = panels(figure_of(flange, [few], [detect([0])]))
    assert texts(of["Not found, by the part object's sizes"]) == "there is no true pose"
