"""The picture of what was found in one image."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image
from scipy.ndimage import binary_erosion

from pnet.geometry.camera import Camera
from pnet.reporting import overlay as room
from pnet.reporting.body_layer import body_layer
from pnet.reporting.overlay import CAPTION, framing, overlay_figure, overlay_picture, resized
from pnet.reporting.picture import BACKGROUND, pixel_axes
from pnet.reporting.prediction_tables import by_score
from pnet.reporting.scene_view import AXIS_COLOURS, detected_bodies, instance_colours
from pnet.scenes.rendering import render_view

FLOOR = 0.64  # metres
R, H = 0.018, 0.016  # of the scene's flanges


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Pictures of 640 x 512 pixels, which are drawn sooner."""
    monkeypatch.setattr(room, "LONG_SIDE", (640, 800))


@pytest.fixture
def depth(scene, flange):
    """The scene's three flanges before a floor."""
    seen = render_view(scene.camera, flange.mesh(scene.parameters[0]), scene.R, scene.t).depth
    return np.where(seen > 0, seen, FLOOR)


@pytest.fixture
def bodies(detect, flange):
    return detected_bodies(flange, 72, detect([0, 1, 2]))


def pixels_of(figure):
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3] / 255


def place(view, point):
    u, v = view.project(np.asarray(point)).round().astype(int)
    return v, u


def has_colour(pixels, where, colour, reach=3):
    v, u = where
    patch = pixels[v - reach : v + reach + 1, u - reach : u + reach + 1].reshape(-1, 3)
    return bool((np.abs(patch - to_rgb(colour)).max(1) < 0.05).any())


def texts(figure):
    return [text.get_text() for axes in figure.axes for text in axes.texts]


# the picture


def test_the_file_is_the_camera_s_view_above_a_caption_and_nothing_else_is_left(
    scene, detect, flange, depth, tmp_path
):
    found = detect([0, 1])
    overlay_picture(depth, scene.camera, scene.points, found, flange, tmp_path / "a.png", "a.tif")
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.size == (640, 512 + CAPTION)
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def test_a_body_s_colour_is_mixed_with_what_was_measured(scene, detect, flange, depth):
    view, colours = resized(scene.camera), instance_colours(2)
    found, nothing = detect([0, 2]), detect([])
    bare = pixels_of(overlay_figure(depth, scene.camera, scene.points, nothing, flange))
    mixed = pixels_of(overlay_figure(depth, scene.camera, scene.points, found, flange))
    for i, body in enumerate((0, 2)):
        where = place(view, scene.t[body] + [0, 0.013, -0.638 * H])  # on the face, beside the number
        added = (mixed[where] - 0.45 * bare[where]) / 0.55
        light = added / colours[i]
        np.testing.assert_allclose(light, light.mean(), atol=0.02)
        assert 0.7 < light.mean() < 1.1
    other = place(view, scene.t[1] + [0, 0.013, -0.638 * H])
    np.testing.assert_array_equal(mixed[other], bare[other])


def test_outside_of_bodies_the_picture_shows_what_was_measured(scene, detect, flange, depth, bodies):
    owner = body_layer(resized(scene.camera), bodies, instance_colours(3)).owner
    bare = pixels_of(overlay_figure(depth, scene.camera, scene.points, detect([]), flange))
    mixed = pixels_of(overlay_figure(depth, scene.camera, scene.points, detect([0, 1, 2]), flange))
    changed = np.abs(mixed - bare).max(-1)[:512] > 0.01
    changed[:100] = False  # "nothing was found"
    hole = np.hypot(*(np.mgrid[:512, :640] - np.array([255, 319])[:, None, None])) < 40  # numbers
    spread = np.zeros_like(changed)
    for shift in ((0, 0), (0, 1), (1, 0), (0, -1), (-1, 0)):
        spread |= np.roll(owner >= 0, shift, (0, 1))
    assert not (changed & ~spread & ~hole)[:, 220:420].any()
    assert changed[owner >= 0].mean() > 0.95


def test_the_measured_surface_is_lit_and_what_is_missing_is_dark(scene, detect, flange, depth):
    view = resized(scene.camera)
    depth = depth.copy()
    depth[:, :20], depth[:, -20:] = 0, np.nan
    pixels = pixels_of(overlay_figure(depth, scene.camera, scene.points, detect([]), flange))
    for column in (10, 70, 570, 630):
        np.testing.assert_allclose(pixels[300, column], BACKGROUND, atol=0.003)
    face = pixels[place(view, scene.t[1] + [0, 0.013, -0.638 * H])]
    assert pixels[450, 320].min() > 0.3 and face.mean() > pixels[450, 320].mean() + 0.03  # nearer: brighter
    assert np.ptp(face) < 0.06  # grey


def test_nothing_found_is_said_in_the_picture_and_below(scene, detect, flange, depth):
    figure = overlay_figure(depth, scene.camera, scene.points, detect([]), flange, "bin.png")
    assert texts(figure) == ["nothing was found"]
    assert figure.texts[0].get_text() == "bin.png   ·   TN34   ·   nothing was found"


def test_numbers_are_ranks_by_score_at_the_bodies(scene, detect, flange, depth):
    found = detect([0, 1, 2])
    found = replace(found, score=torch.tensor([0.2, 0.9, 0.5], dtype=torch.float64))
    figure = overlay_figure(depth, scene.camera, scene.points, found, flange)
    view = resized(scene.camera)
    written = {text.get_text(): text.get_position() for text in figure.axes[0].texts}
    assert list(written) == ["1", "2", "3"]
    for rank, body in (("1", 1), ("2", 2), ("3", 0)):
        np.testing.assert_allclose(written[rank], view.project(scene.t[body]))
    assert figure.texts[0].get_text() == "TN34   ·   3 found, best score 0.90   ·   numbers: ranks by score"


@pytest.mark.parametrize("sizes", [torch.nan, -0.01])
def test_bodies_of_unknown_or_impossible_size_are_drawn_as_axes(scene, detect, flange, depth, sizes):
    found = detect([0, 2])
    found.parameters[0] = sizes
    figure = overlay_figure(depth, scene.camera, scene.points, found, flange)
    view, pixels = resized(scene.camera), pixels_of(figure)
    for body, axes in ((0, True), (1, False), (2, False)):
        for offset, colour in (([0.014, 0, 0], AXIS_COLOURS[0]), ([0, -0.014, 0], AXIS_COLOURS[1])):
            assert has_colour(pixels, place(view, scene.t[body] + offset), colour) == axes
    assert texts(figure) == ["1", "2"]
    note = (
        "sizes are not estimated: axes stand for the bodies" if np.isnan(sizes) else "1 of impossible sizes"
    )
    assert note in figure.texts[0].get_text()


def test_detections_without_a_pose_or_behind_the_camera_are_left_out(scene, detect, flange, depth):
    found = detect([0, 1, 2])
    found.t[0] = torch.nan
    found.t[1, 2] = -0.6
    figure = overlay_figure(depth, scene.camera, scene.points, found, flange)
    assert texts(figure) == ["3"]
    assert "1 without a pose" in figure.texts[0].get_text()


def test_a_cloud_without_a_camera_is_drawn_in_a_square(scene, detect, flange):
    found = detect([0, 1, 2])
    figure = overlay_figure(None, None, scene.points, found, flange)
    pixels = pixels_of(figure)
    assert pixels.shape == (1024 + CAPTION, 1024, 3)
    assert texts(figure) == ["1", "2", "3"]
    written = np.array([text.get_position() for text in figure.axes[0].texts])
    assert np.ptp(written[:, 0]) == pytest.approx(1024 / 1.1 * 0.12 / 0.156, rel=0.03)  # 0.12 m of 0.156 m
    np.testing.assert_allclose(written[1], [511.5, 511.5], atol=12)
    view, _ = framing(scene.points.astype(float), np.zeros((0, 3)))
    near = scene.points[scene.points[:, 2] < 0.592]
    seen = np.array([pixels[place(view, point)] for point in near])
    assert (np.ptp(seen, axis=1) > 0.08).mean() > 0.9  # points lie beneath the coloured glass


@pytest.mark.parametrize("count", [0, 1, 2])
def test_hardly_any_points_and_no_detections_give_a_picture(scene, nothing, flange, count):
    pixels = pixels_of(overlay_figure(None, None, scene.points[:count], nothing, flange))
    drawn = (np.abs(pixels[100:1024] - BACKGROUND).max(-1) > 0.1).any()
    assert drawn == (count > 0)


def test_an_image_without_depth_gives_a_dark_picture(scene, detect, flange, depth):
    pixels = pixels_of(overlay_figure(0 * depth, scene.camera, scene.points[:0], detect([1]), flange))
    np.testing.assert_allclose(pixels[300, 40], BACKGROUND, atol=0.003)
    assert pixels[:512].max() > 0.5


def test_a_depth_image_needs_its_own_camera(scene, nothing, flange, depth):
    with pytest.raises(ValueError, match="give its camera"):
        overlay_figure(depth, None, scene.points, nothing, flange)
    with pytest.raises(ValueError, match=r"\(128, 159\), the camera expects \(128, 160\)"):
        overlay_figure(depth[:, 1:], scene.camera, scene.points, nothing, flange)


@pytest.mark.parametrize(
    ("width", "height", "size"),
    [(160, 120, (640, 480)), (700, 350, (700, 350)), (1000, 2000, (400, 800)), (9000, 2, (800, 1))],
)
def test_small_images_are_enlarged_and_large_ones_reduced(width, height, size):
    camera = Camera(width, height, 500.0, 510.0, 80.0, 60.0)
    view = resized(camera)
    assert (view.width, view.height) == size
    corners = np.array([[-0.5, -0.5], [width - 0.5, height - 0.5]])
    rays = camera.rays(*corners.T)
    np.testing.assert_allclose(view.project(rays), [[-0.5, -0.5], np.array(size) - 0.5], atol=1e-9)


# the bodies


def test_the_nearer_body_is_seen(scene, detect, flange):
    found = detect([0, 1])
    found.t[0] = torch.tensor([0, 0, 0.6])
    found.t[1] = torch.tensor([0.01, 0, 0.5])
    view = resized(scene.camera)
    layer = body_layer(view, detected_bodies(flange, 72, found), instance_colours(2))
    assert layer.owner[place(view, [0.02, 0, 0.5])] == 1
    assert layer.owner[place(view, [-0.016, 0, 0.59])] == 0
    assert layer.owner[10, 10] == -1 and layer.image[10, 10, 3] == 0


def test_outlines_are_firm_and_what_they_enclose_is_glass(scene, bodies):
    view, colours = resized(scene.camera), instance_colours(3)
    layer = body_layer(view, bodies, colours)
    assert layer.image[place(view, scene.t[1] + [0, 0.013, 0])][3] == pytest.approx(0.55)
    column = layer.image[:, place(view, scene.t[1])[1]]
    rim = np.flatnonzero(column[:, 3] > 0)[0]
    assert rim == pytest.approx(place(view, scene.t[1] - [0, R, 0.638 * H])[0], abs=1.5)
    firm = column[rim : rim + 4]
    best = firm[firm[:, 3].argmax()]
    assert best[3] > 0.95
    np.testing.assert_allclose(best[:3], 1 - 0.75 * (1 - colours[1]), atol=0.02)


def test_a_body_is_paler_where_something_was_measured_before_it(scene, bodies):
    view = resized(scene.camera)
    surface = np.full((128, 160), scene.t[1, 2])
    surface[:, 80:] = 0.57  # 20 mm before the faces
    layer = body_layer(view, bodies, instance_colours(3), surface)
    left, right = (place(view, scene.t[1] + [x, 0.008, -0.638 * H]) for x in (-0.008, 0.008))
    assert layer.image[left][3] == pytest.approx(0.55)
    assert layer.image[right][3] == pytest.approx(0.15)


def test_noise_before_a_body_does_not_hide_it(scene, bodies, depth):
    noise = np.random.default_rng(0).normal(0, 0.002, depth.shape)
    layer = body_layer(resized(scene.camera), bodies, instance_colours(3), depth + noise)
    inner = binary_erosion(layer.owner == 1, iterations=8)
    assert inner.sum() > 1000
    assert (layer.image[inner][:, 3] < 0.5).mean() < 0.002


def test_a_body_about_the_camera_is_not_drawn(scene, detect, flange):
    found = detect([1])
    found.t[0] = torch.tensor([0, 0.01, 0.001])
    layer = body_layer(resized(scene.camera), detected_bodies(flange, 24, found), instance_colours(1))
    assert layer.image[..., 3].max() == 0


# the numbers


def test_a_number_is_at_the_centroid_or_within_what_is_seen():
    view = Camera(100, 80, 100.0, 100.0, 50.0, 40.0)
    owner = np.full((80, 100), -1)
    owner[20:60, 10:50] = 0  # centroid seen
    owner[30:50, 40:70] = 1  # centroid seen, and covers the centroid of 2
    owner[50:56, 52:90] = 2
    centres = np.array([[30, 40], [55, 40], [60, 45], [60, 45], [90, 10], [500, 10]])
    t = np.c_[(centres - [50, 40]) / 100, np.ones(6)]
    anchors = room.rank_anchors(view, owner, t, np.array([0, 1, 2, 3, 5]), np.array([2, 0, 1, 3, 4, 5]))
    assert list(anchors) == [1, 2, 3, 5]  # 3 is not seen; 4 has no body, only axes; 5 lies outside
    np.testing.assert_allclose(anchors[2], [30, 40])
    np.testing.assert_allclose(anchors[3], [55, 40])
    np.testing.assert_allclose(anchors[5], [90, 10])
    u, v = anchors[1].astype(int)
    assert owner[v, u] == 2 and v in (52, 53) and 54 <= u <= 87


def test_the_number_of_a_body_with_a_hole_is_at_its_centroid(scene, bodies):
    view = resized(scene.camera)
    owner = body_layer(view, bodies, instance_colours(3)).owner
    assert owner[place(view, scene.t[1])] == -1
    anchors = room.rank_anchors(view, owner, scene.t, bodies.owner, np.arange(3))
    np.testing.assert_allclose(list(anchors.values()), view.project(scene.t))


def test_crowded_numbers_shrink_or_give_way_to_better_ones():
    axes = pixel_axes(Figure((4, 4)), (0, 0), (400, 400))
    anchors = {1: np.array([100.0, 100]), 2: np.array([118.0, 100]), 3: np.array([100.0, 101])}
    assert room.write_ranks(axes, anchors | {4: np.array([300.0, 300])}, 20.0) == 1
    size = {text.get_text(): text.get_fontsize() / 0.72 for text in axes.texts}
    assert size == pytest.approx({"1": 20, "2": 11, "4": 20})


def test_numbers_never_cover_each_other():
    rng = np.random.default_rng(0)
    figure = Figure((4, 4), dpi=100)
    axes = pixel_axes(figure, (0, 0), (400, 400))
    anchors = {rank: rng.uniform(0, 400, 2) for rank in range(1, 201)}
    left_out = room.write_ranks(axes, anchors, 18.0)
    FigureCanvasAgg(figure)
    boxes = [text.get_window_extent() for text in axes.texts]
    assert 0 < left_out == 200 - len(boxes) < 120
    assert not any(a.padded(-1).overlaps(b.padded(-1)) for a, b in combinations(boxes, 2))
    assert {str(rank) for rank in range(1, 5)} <= {text.get_text() for text in axes.texts}


def test_the_caption_is_one_line_that_fits(scene, detect, flange, depth):
    name = "long/" * 80 + "file.png"
    found = detect([0, 1])
    found.parameters[0] = torch.nan
    figure = overlay_figure(depth, scene.camera, scene.points, found, flange, name)
    FigureCanvasAgg(figure)
    (text,) = figure.texts
    assert text.get_text().startswith("…") and "/file.png   ·   TN34   ·   2 found" in text.get_text()
    box = text.get_window_extent()
    assert box.x0 >= 0 and box.x1 <= 640 and box.y0 >= 0 and box.y1 <= CAPTION


# the virtual camera


def test_a_cloud_before_the_camera_is_seen_from_the_origin(scene):
    camera, shift = framing(scene.points.astype(float), np.zeros((0, 3)))
    np.testing.assert_array_equal(shift, 0)
    pixels = camera.project(scene.points)
    assert pixels.min() > 0 and pixels.max() < 1023
    assert np.ptp(pixels[:, 0]) == pytest.approx(1024 / 1.1)


@pytest.mark.parametrize("move", [[0, 0, -0.6], [3, -2, 0.0], [0, 0, -5]])
def test_a_cloud_in_any_other_frame_is_put_before_the_camera(scene, move):
    points = scene.points + np.array(move)
    camera, shift = framing(points, np.zeros((0, 3)))
    moved = points + shift
    assert moved[:, 2].min() > 0.1
    pixels = camera.project(moved)
    assert pixels.min() > 0 and pixels.max() < 1023
    assert np.ptp(pixels[:, 0]) > 900


def test_stray_points_do_not_shrink_the_rest(scene):
    stray = np.concatenate([scene.points, [[5.0, 0, 0.6], [0, 0, -3]]])
    camera, shift = framing(stray, np.zeros((0, 3)))
    np.testing.assert_array_equal(shift, 0)
    assert np.ptp(camera.project(scene.points)[:, 0]) == pytest.approx(1024 / 1.1, rel=0.02)


def test_without_points_the_detections_are_framed(scene):
    camera, _ = framing(np.zeros((0, 3)), np.concatenate([scene.t, [[np.nan] * 3]]))
    pixels = camera.project(scene.t)
    assert pixels.min() > 0 and pixels.max() < 1024


def test_ranks_do_not_depend_on_the_order_of_the_detections(detect):
    found = detect([0, 1, 2])
    assert by_score(replace(found, score=torch.tensor([0.1, torch.nan, 0.3]))).tolist() == [2, 0, 1]
    assert by_score(replace(found, score=torch.tensor([0.5, 0.5, 0.5]))).tolist() == [0, 1, 2]
