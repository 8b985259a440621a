"""Views of parts, and where their keypoints could be instead."""

import numpy as np

from pnet.reporting.part_view import PANEL, equivalents, part_views


def test_the_body_is_in_the_middle_of_every_panel_with_room_for_labels(bar):
    parameters = bar.part_object("L", 0)
    for view in part_views(bar, parameters):
        pixels = view.pixels(bar.mesh(parameters).vertices)
        low, high = pixels.min(0), pixels.max(0)
        np.testing.assert_allclose((low + high) / 2, (np.array(PANEL) - 1) / 2, atol=4)
        free = np.array(PANEL) - (high - low)
        assert free[0] >= 150 and free[1] >= 100
        assert free[0] < 170 or free[1] < 120


def test_a_place_is_hidden_only_behind_the_body(bar):
    parameters = bar.part_object("L", 0)
    _, side, above = part_views(bar, parameters)
    places = np.array([[0, 0.006, 0], [0, -0.006, 0], [0, 0, 0], [0, 0, 0.05]])
    assert side.hidden(places).tolist() == [False, True, True, False]
    assert above.hidden(places[2:]).tolist() == [True, False]


def test_equivalents_of_a_nut_are_two_faces_two_circles_and_twelve_vertices(tn06):
    r, h, d = parameters = np.array([0.004, 0.011, 0.014])
    face, hole, vertex = equivalents(tn06, parameters, np.array([0.0, 0.0, -1.0]))
    np.testing.assert_allclose(sorted(np.concatenate(face)[:, 2]), [-h / 2, h / 2])
    assert [len(curve) for curve in hole] == [73, 73]
    np.testing.assert_allclose(np.linalg.norm(np.concatenate(hole)[:, :2], axis=-1), r)
    assert len(vertex) == 12
    np.testing.assert_allclose(np.linalg.norm(np.concatenate(vertex)[:, :2], axis=-1), d)


def test_equivalents_on_a_sphere_are_its_outline(marble):
    forward = np.array([0.0, 0.6, -0.8])
    ((outline,),) = equivalents(marble, np.array([0.01]), forward)
    np.testing.assert_allclose(np.linalg.norm(outline, axis=-1), 0.01)
    np.testing.assert_allclose(outline @ forward, 0, atol=1e-12)
