"""The still picture of a scene."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from pnet.reporting.picture import (
    BACKGROUND,
    PANEL,
    SIZE,
    caption_texts,
    crop,
    render_bodies,
    scene_picture,
    unexplained,
)
from pnet.reporting.scene_view import AXIS_COLOURS, detected_bodies, instance_colours


def nearest_hue(pixel, colours):
    """Which colour a pixel has, brightness aside; it must have one clearly."""
    likeness = colours @ pixel / np.linalg.norm(colours, axis=-1) / np.linalg.norm(pixel)
    assert likeness.max() > 0.99
    return likeness.argmax()


@pytest.fixture
def view(scene):
    return crop(scene.camera, scene.points.astype(float), np.zeros((0, 3)))


def test_the_file_is_a_picture_of_the_expected_size_and_nothing_else_is_left(scene, detect, flange, tmp_path):
    scene_picture(scene, detect([0, 1, 2]), flange, tmp_path / "scene.png")
    with Image.open(tmp_path / "scene.png") as picture:
        assert picture.size == SIZE
        pixels = np.asarray(picture.convert("RGB"))
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 100
    assert [path.name for path in tmp_path.iterdir()] == ["scene.png"]


def test_each_body_has_its_instance_s_colour_in_both_panels(scene, detect, flange, tmp_path, view):
    scene_picture(scene, detect([0, 1, 2]), flange, tmp_path / "scene.png")
    with Image.open(tmp_path / "scene.png") as picture:
        pixels = np.asarray(picture.convert("RGB")) / 255
    for body, (u, v) in enumerate(view.project(scene.t).round().astype(int)):
        for left in (8, SIZE[0] - PANEL - 8):
            patch = pixels[v + 64 - 80 : v + 64 + 80, u + left - 80 : u + left + 80].reshape(-1, 3)
            coloured = patch[patch.max(-1) > 0.3]
            assert len(coloured) > 5000
            hue = np.median(coloured, 0)
            assert nearest_hue(hue, instance_colours(3)) == body


def test_crop_puts_the_points_into_a_square(scene, view):
    pixels = view.project(scene.points)
    assert (view.width, view.height) == (PANEL, PANEL)
    middle = (pixels.min(0) + pixels.max(0)) / 2
    np.testing.assert_allclose(middle, [PANEL / 2 - 0.5] * 2, atol=1e-6)
    assert np.ptp(pixels[:, 0]) == pytest.approx(PANEL / 1.1)
    assert view.fx / view.fy == pytest.approx(scene.camera.fx / scene.camera.fy)


def test_the_nearer_body_hides_the_farther(scene, detect, flange):
    found = detect([0, 1])
    t = found.t.clone()
    t[0], t[1] = t.new_tensor([0, 0, 0.6]), t.new_tensor([0, 0, 0.5])
    bodies = detected_bodies(flange, 24, replace(found, t=t))
    colours = np.array([[0.9, 0.1, 0.1], [0.1, 0.1, 0.9]])
    small = replace(scene.camera, width=64, height=64, cx=31.5, cy=31.5)
    image, depth = render_bodies(small, bodies, colours)
    assert image.shape == (128, 128, 3)
    seen = np.isfinite(depth)
    np.testing.assert_allclose(image[~seen], np.tile(BACKGROUND, ((~seen).sum(), 1)))
    assert depth[seen].min() == pytest.approx(0.5 - 0.016 * 0.638, abs=2e-4)
    assert (image[seen][:, 2] > image[seen][:, 0]).mean() > 0.95


def test_depth_is_that_of_the_plane_facing_the_camera(scene, detect, flange):
    bodies = detected_bodies(flange, 24, detect([1]))
    small = replace(scene.camera, width=64, height=64, cx=31.5, cy=31.5)
    _, depth = render_bodies(small, bodies, instance_colours(1))
    row, column = 64, 64 + round(2 * 375 * 0.008 / 0.6)
    assert depth[row, column] == pytest.approx(bodies.mesh.vertices[:, 2].min(), abs=1e-7)
    assert not np.isfinite(depth[64, 64])  # the hole


def test_a_body_throws_its_shadow_on_the_one_below(scene, detect, flange):
    found = detect([0, 1])
    t = found.t.clone()
    t[0], t[1] = t.new_tensor([0, 0, 0.60]), t.new_tensor([0.02, 0, 0.56])
    small = replace(scene.camera, width=64, height=64, cx=31.5, cy=31.5)
    colours = np.ones((2, 3)) * 0.5
    both = detected_bodies(flange, 24, replace(found, t=t))
    t[1] = float("nan")
    alone = detected_bodies(flange, 24, replace(found, t=t))
    bright, depth = render_bodies(small, alone, colours)
    dim, shown = render_bodies(small, both, colours)
    below = np.isfinite(depth) & (depth == shown)
    assert bright[below].mean() > 1.05 * dim[below].mean()


def test_only_points_beside_or_before_the_estimates_are_unexplained(scene, detect, flange, view):
    bodies = detected_bodies(flange, 48, detect([0, 2]))
    _, depth = render_bodies(view, bodies, instance_colours(2))
    points = scene.t + np.array([0.0, 0.008, -0.0102])
    assert unexplained(view, points, depth).tolist() == [False, True, False]
    assert unexplained(view, points - [0, 0, 0.02], depth).tolist() == [True, True, True]
    behind = np.array([[0.0, 0.0, -0.1]])
    assert unexplained(view, behind, depth).tolist() == [True]


def test_a_scene_without_anything_gives_a_picture_that_says_so(empty_scene, nothing, flange, tmp_path):
    scene_picture(empty_scene, nothing, flange, tmp_path / "scene.png")
    with Image.open(tmp_path / "scene.png") as picture:
        assert picture.size == SIZE
    headings, foot = caption_texts(empty_scene, nothing, 0)
    assert headings == ("This scene has no points", "Nothing was found")
    assert foot == "TN34   ·   test_l/pile_0000_part_00/003"


@pytest.mark.parametrize("points", [0, 1, 2])
def test_very_few_points_are_drawn(scene, detect, flange, tmp_path, points):
    found = detect([])
    few = replace(found, instance=found.instance[:points])
    scene_picture(replace(scene, points=scene.points[:points]), few, flange, tmp_path / "scene.png")
    assert (tmp_path / "scene.png").stat().st_size > 1000


def test_the_caption_counts(scene, detect):
    headings, foot = caption_texts(scene, detect([0, 2]), 1)
    assert headings == ("Points, coloured by instance (600)", "Estimated poses (2)")
    assert "3 bodies in the bin, 2 poses estimated" in foot
    assert "1 without a valid solid" in foot


def test_bodies_of_unknown_size_are_drawn_as_axes(scene, detect, sizeless, flange, tmp_path, view):
    """On the ends of x, to the right, and y, upwards, lie the axes' colours; no body covers them."""
    scene_picture(scene, sizeless(detect([0, 2])), flange, tmp_path / "scene.png")
    with Image.open(tmp_path / "scene.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    left, top = SIZE[0] - PANEL - 8, 64
    for body, drawn in ((0, True), (1, False), (2, True)):
        for offset, colour in (([0.014, 0, 0], AXIS_COLOURS[0]), ([0, -0.014, 0], AXIS_COLOURS[1])):
            ((u, v),) = view.project(scene.t[[body]] + offset).round().astype(int)
            patch = pixels[v + top - 3 : v + top + 4, u + left - 3 : u + left + 4].reshape(-1, 3)
            wanted = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
            assert (np.abs(patch - wanted).max(1) < 12).any() == drawn, (body, colour)


def test_axes_behind_the_camera_are_left_out(scene, detect, sizeless, flange, tmp_path, view):
    found = sizeless(detect([0, 1, 2]))
    t = found.t.clone()
    t[0, 2], t[1, 2] = -0.5, 0.01
    scene_picture(scene, replace(found, t=t), flange, tmp_path / "scene.png")
    with Image.open(tmp_path / "scene.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    wanted = [int(AXIS_COLOURS[0][i : i + 2], 16) for i in (1, 3, 5)]
    where = np.argwhere(np.abs(pixels - wanted).max(2) < 12)
    # one line, the last body's x
    (start, row), (end, _) = view.project(scene.t[[2, 2]] + [[0, 0, 0], [0.018, 0, 0]])
    assert len(where) > 20 and np.abs(where[:, 0] - 64 - row).max() < 6
    column = where[:, 1] - (SIZE[0] - PANEL - 8)
    assert column.min() > start - 6 and abs(column.max() - end) < 6


def test_the_caption_tells_axes_from_what_is_not_drawn(scene, detect):
    both = caption_texts(scene, detect([0, 1, 2]), 3, 2)[1]
    assert (
        "sizes are not estimated: axes stand for the bodies   ·   1 without a valid solid, not drawn" in both
    )
    alone = caption_texts(scene, detect([0, 1]), 2, 2)[1]
    assert "axes stand for the bodies" in alone and "not drawn" not in alone
