"""The interactive figure of a scene."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pnet.reporting.page import PageContent, page_html
from pnet.reporting.scene_view import (
    AXIS_COLOURS,
    GREY,
    estimated_axes,
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


def test_axes_of_a_body_of_unknown_size_by_hand(scene, detect, sizeless, flange):
    """Tops towards the camera: y and z turned round. As long as the radius, 18 mm, the larger parameter."""
    axes = estimated_axes(flange, sizeless(detect([2])))
    origin = np.array([0.06, 0, 0.6])
    ends = origin + 0.018 * np.diag([1, -1, -1])
    np.testing.assert_allclose(axes, [[[origin, end] for end in ends]], atol=1e-12)


def test_axes_are_the_columns_of_the_rotation(scene, detect, sizeless, flange):
    R = torch.tensor([[0.0, -0.6, 0.8], [1, 0, 0], [0, 0.8, 0.6]]).double()
    axes = estimated_axes(flange, replace(sizeless(detect([1])), R=R[None]))[0]
    np.testing.assert_allclose((axes[:, 1] - axes[:, 0]) / 0.018, R.T, atol=1e-9)


def test_bodies_of_known_size_and_lost_ones_have_no_axes(scene, detect, sizeless, flange):
    known, unknown = detect([0, 1, 2]), sizeless(detect([0, 1, 2]))
    assert estimated_axes(flange, known).shape == (0, 3, 2, 3)
    assert estimated_axes(flange, sizeless(detect([]))).shape == (0, 3, 2, 3)
    t = unknown.t.clone()
    t[1, 2] = torch.nan
    axes = estimated_axes(flange, replace(unknown, t=t))
    np.testing.assert_allclose(axes[:, 0, 0], scene.t[[0, 2]])
    mixed = replace(
        unknown, parameters=torch.where(torch.tensor([[True], [False], [True]]), known.parameters, torch.nan)
    )
    np.testing.assert_allclose(estimated_axes(flange, mixed)[:, 0, 0], scene.t[[1]])


def test_without_sizes_the_estimates_are_drawn_as_axes(scene, detect, sizeless, flange):
    figure = scene_figure(scene, sizeless(detect([2, 0])), flange)
    layers = traces(figure)
    assert "estimates" not in layers and len(layers["truth"].x) == 3 * VERTICES
    drawn = layers["axes of estimates"]
    assert drawn.legendgroup == "estimates" and drawn.showlegend
    lines = np.stack([drawn.x, drawn.y, drawn.z], -1).reshape(2, 3, 3, 3)
    assert np.isnan(lines[:, :, 2]).all()  # the gap between two lines
    np.testing.assert_allclose(
        lines[:, :, 0], np.tile([[[60, 0, 600]], [[-60, 0, 600]]], (1, 3, 1)), atol=0.01
    )
    np.testing.assert_allclose(lines[0, :, 1], [[78, 0, 600], [60, -18, 600], [60, 0, 582]], atol=0.01)
    assert list(drawn.line.color) == 2 * [c for c in AXIS_COLOURS for _ in range(3)]
    assert notes(figure) == ["sizes are not estimated: axes stand for the bodies"]
    ranges = [figure.layout.scene[f"{name}axis"].range for name in "xyz"]
    assert all(np.isfinite(ends).all() for ends in ranges)


def test_with_sizes_there_are_none(scene, detect, flange):
    layers = traces(scene_figure(scene, detect([2, 0]), flange))
    assert len(layers["axes of estimates"].x) == 0 and not layers["axes of estimates"].showlegend


def test_solids_axes_and_lost_bodies_are_told_apart(scene, detect, sizeless, flange):
    found = detect([0, 1, 2])
    parameters, t = found.parameters.clone(), found.t.clone()
    parameters[1] = torch.nan
    t[2] = torch.inf
    figure = scene_figure(scene, replace(found, parameters=parameters, t=t), flange)
    assert len(traces(figure)["estimates"].x) == VERTICES
    assert len(traces(figure)["axes of estimates"].x) == 9
    assert notes(figure) == [
        "sizes are not estimated: axes stand for the bodies",
        "estimates without a valid solid, not drawn: 1",
    ]


def test_hover_says_nothing_of_unknown_sizes(scene, detect, sizeless, flange):
    points = traces(scene_figure(scene, sizeless(detect([2, 0])), flange))["points"]
    assert points.hovertemplate == (
        "<b>detection %{customdata[0]}</b><br>score %{customdata[1]:.3f}"
        "<br>at (%{customdata[2]:.1f}, %{customdata[3]:.1f}, %{customdata[4]:.1f}) mm<extra></extra>"
    )
    np.testing.assert_allclose(
        np.unique(points.customdata[:, :5], axis=0), [[1, 0.9, 60, 0, 600], [2, 0.8, -60, 0, 600]], atol=1e-4
    )


def test_the_page_of_a_method_without_sizes_is_whole(scene, detect, sizeless, flange):
    figure = scene_figure(scene, sizeless(detect([2, 0])), flange)
    row = ("Parameter error", "–", "Mean error of the estimated dimensions of found bodies.")
    page = page_html(PageContent("pnet", "one", [row], [("a scene", figure)], figure, None, "", []))
    assert "<strong>–</strong>" in page and "axes of estimates" in page
    assert page.rstrip().endswith("</html>")
    assert "NaN" not in page.split("const config", 1)[1]
