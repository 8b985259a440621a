"""The interactive figure of a scene."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pnet.reporting.scene_view import (
    GREY,
    instance_colours,
    point_colours,
    pose_bodies,
    scene_figure,
)

# a flange of 24 sections: six vertices and twelve triangles a section
VERTICES, FACES = 6 * 24, 12 * 24


def traces(figure):
    return {trace.name: trace for trace in figure.data}


def notes(figure):
    return [note.text for note in figure.layout.annotations]


def test_layers_are_switched_in_the_legend_and_truth_is_off_at_first(scene, detect, flange):
    figure = scene_figure(scene, detect([2, 0]), flange)
    listed = [trace.name for trace in figure.data if trace.showlegend]
    assert listed == ["points", "estimates", "truth"]
    hidden = {trace.name for trace in figure.data if trace.visible == "legendonly"}
    assert hidden == {"truth", "truth edges"}
    assert {trace.legendgroup for trace in figure.data} == set(listed)


def test_all_bodies_of_a_layer_are_one_coarse_mesh(scene, detect, flange):
    layers = traces(scene_figure(scene, detect([2, 0]), flange))
    assert len(layers["estimates"].x) == 2 * VERTICES
    assert len(layers["estimates"].i) == len(layers["estimates"].facecolor) == 2 * FACES
    assert len(layers["truth"].x) == 3 * VERTICES
    assert len(layers["truth"].i) == 3 * FACES
    assert flange.sections == 48


def test_coordinates_are_millimetres_rounded_to_hundredths(scene, detect, flange):
    estimates = traces(scene_figure(scene, detect([2, 0]), flange))["estimates"]
    assert estimates.x.min() == pytest.approx(-78.0, abs=0.01)
    assert estimates.x.max() == pytest.approx(78.0, abs=0.01)
    x = estimates.x.astype(float)
    np.testing.assert_allclose(x, x.round(2), atol=1e-5)


def test_points_take_the_colour_of_their_detection_and_others_are_grey(scene, detect, flange):
    layers = traces(scene_figure(scene, detect([2, 0]), flange))
    points, others = layers["points"], layers["points of no instance"]
    left = np.array(points.marker.color)[points.x < -30]
    right = np.array(points.marker.color)[points.x > 30]
    assert len(left) == len(right) == len(others.x) == 200
    assert len(set(left)) == len(set(right)) == 1
    assert left[0] != right[0]
    assert others.marker.color == "#8f96a1"
    assert np.abs(others.x).max() < 20


def test_hover_tells_number_score_place_and_parameters_in_mm(scene, detect, flange):
    estimates = traces(scene_figure(scene, detect([2, 0]), flange))["estimates"]
    rows = np.unique(estimates.customdata, axis=0)
    np.testing.assert_allclose(rows, [[1, 0.9, 60, 0, 600, 18, 16], [2, 0.8, -60, 0, 600, 18, 16]], atol=1e-4)
    assert "r %{customdata[5]:.2f} mm<br>h %{customdata[6]:.2f} mm" in estimates.hovertemplate


def test_hovered_faces_belong_to_the_body_that_the_text_is_about(scene, detect, flange):
    estimates = traces(scene_figure(scene, detect([2, 0]), flange))["estimates"]
    corner = estimates.x[estimates.i]
    np.testing.assert_array_less(np.abs(corner - estimates.customdata[:, 2]), 18.01)


def test_faces_are_drawn_from_far_to_near(scene, detect, flange):
    estimates = traces(scene_figure(scene, detect([1]), flange))["estimates"]
    depth = sum(estimates.z[estimates[corner]] for corner in "ijk")
    assert (np.diff(depth) <= 1e-3).all()


def test_axes_are_equal_and_show_the_camera_above(scene, detect, flange):
    axes = scene_figure(scene, detect([1]), flange).layout.scene
    spans = [abs(np.diff(axes[f"{name}axis"].range)[0]) for name in "xyz"]
    ratio = [axes.aspectratio[name] for name in "xyz"]
    np.testing.assert_allclose(np.array(spans) / ratio, spans[0] / ratio[0])
    assert axes.xaxis.range[0] < axes.xaxis.range[1]
    assert axes.yaxis.range[0] > axes.yaxis.range[1]
    assert axes.zaxis.range[0] > axes.zaxis.range[1]


def test_a_scene_without_points_and_detections_says_so(empty_scene, nothing, flange):
    figure = scene_figure(empty_scene, nothing, flange)
    assert notes(figure) == ["this scene has no points", "nothing was found"]
    assert {trace.type for trace in figure.data} == {"scatter3d"}
    assert all(len(trace.x) == 0 for trace in figure.data)


def test_points_without_detections_are_all_grey(scene, detect, flange):
    figure = scene_figure(scene, detect([]), flange)
    assert len(traces(figure)["points of no instance"].x) == len(scene.points)
    assert notes(figure) == ["nothing was found"]


def test_detections_of_the_first_points_only_show_those(scene, detect, flange):
    found = detect([0])
    layers = traces(scene_figure(scene, replace(found, instance=found.instance[:120]), flange))
    assert len(layers["points"].x) == 120
    assert len(layers["points of no instance"].x) == 0


@pytest.mark.parametrize("parameter", [-0.01, 0.0, float("nan")])
def test_an_estimate_that_is_no_solid_is_left_out_and_counted(scene, detect, flange, parameter):
    found = detect([2, 0])
    parameters = found.parameters.clone()
    parameters[0, 0] = parameter
    figure = scene_figure(scene, replace(found, parameters=parameters), flange)
    assert len(traces(figure)["estimates"].x) == VERTICES
    assert notes(figure) == ["estimates without a valid solid, not drawn: 1"]


def test_an_estimate_without_a_finite_pose_is_left_out(scene, detect, flange):
    found = detect([2, 0])
    lost = replace(found, t=torch.full_like(found.t, torch.nan))
    assert "estimates" not in traces(scene_figure(scene, lost, flange))


def test_posed_bodies_know_their_owners(scene, flange):
    bodies = pose_bodies(flange, 12, scene.R, scene.t, scene.parameters)
    assert bodies.missing == 0
    assert np.bincount(bodies.owner).tolist() == [72, 72, 72]
    assert np.bincount(bodies.face_owner).tolist() == [144, 144, 144]
    assert bodies.mesh.vertices[bodies.owner == 1].mean(0)[:2] == pytest.approx([0, 0], abs=1e-9)


def test_colours_are_far_apart_and_stay_when_more_are_needed():
    colours = instance_colours(24)
    assert colours.shape == (24, 3)
    assert colours.min() >= 0 and colours.max() <= 1
    apart = np.linalg.norm(colours[:, None] - colours, axis=-1) + np.eye(24)
    assert apart.min() > 0.08
    np.testing.assert_array_equal(instance_colours(60)[:24], colours)


def test_points_of_no_instance_are_grey():
    colours = point_colours(np.array([1, -1]), 2)
    np.testing.assert_array_equal(colours, [instance_colours(2)[1], GREY])
