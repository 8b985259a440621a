"""The still pictures of parts."""

from itertools import combinations

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from pnet.geometry.symmetry import (
    FiniteSymmetry,
    RevolutionSymmetry,
    SphericalSymmetry,
    cyclic,
    dihedral,
    reflection,
)
from pnet.parts.tn34 import TN34
from pnet.reporting import part_picture as room
from pnet.reporting.part_labels import DOT
from pnet.reporting.part_view import PANEL, keypoint_places, part_views
from pnet.reporting.picture import BACKGROUND
from pnet.reporting.scene_view import instance_colours

PANEL_CORNERS = [(10 + i * (PANEL[0] + 10), 104) for i in range(3)]


@pytest.fixture(scope="module")
def bar_picture(bar, tmp_path_factory):
    """The path of its picture, in a folder of its own."""
    path = tmp_path_factory.mktemp("bar") / "bar.png"
    room.part_picture(bar, bar.part_object("L", 0), path)
    return path


@pytest.fixture(params=["tn06", "tn34", "bar", "marble", "disc"])
def any_part(request):
    return request.getfixturevalue(request.param)


@pytest.fixture
def bare(monkeypatch):
    """No ray casting: the bodies are left out of the pictures, which then are drawn at once."""
    monkeypatch.setattr(room, "render_bodies", lambda camera, *_: (np.zeros((2, 2, 3)), np.zeros((2, 2))))


def pixels_of(path):
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB")) / 255


def text_boxes(figure):
    """Of every text: the panel it must stay in (left, top, right, bottom) and its box, pixels from above."""
    boxes = []
    whole = figure.bbox
    for text in [*figure.texts, *(text for axes in figure.axes for text in axes.texts)]:
        panel = whole if text.axes is None else text.axes.bbox
        boxes.append((text.get_text(), panel, text.get_window_extent()))
    return boxes


def assert_texts_are_apart_and_inside(figure):
    boxes = text_boxes(figure)
    for words, panel, box in boxes:
        assert panel.x0 <= box.x0 and box.x1 <= panel.x1, words
        assert panel.y0 <= box.y0 and box.y1 <= panel.y1, words
    for (one, _, a), (other, _, b) in combinations(boxes, 2):
        assert not a.overlaps(b), (one, other)


def assert_texts_leave_the_dots_free(figure, part, parameters):
    for axes, view in zip(figure.axes, part_views(part, parameters), strict=True):
        for u, v in view.pixels(keypoint_places(part, parameters)):
            x, y = axes.transData.transform((u, v))
            for text in axes.texts:
                assert not text.get_window_extent().padded(DOT).contains(x, y), text.get_text()


def test_the_file_is_a_picture_of_the_expected_size_and_nothing_else_is_left(bar_picture):
    with Image.open(bar_picture) as picture:
        assert picture.size == room.SIZE
    assert len(np.unique(pixels_of(bar_picture).reshape(-1, 3), axis=0)) > 100
    assert [path.name for path in bar_picture.parent.iterdir()] == ["bar.png"]


def test_keypoints_appear_where_the_camera_has_them_the_hidden_ones_dimmed(bar, bar_picture):
    parameters = bar.part_object("L", 0)
    image, colours = pixels_of(bar_picture), instance_colours(5)
    places = keypoint_places(bar, parameters)[1:]
    seen_hidden = []
    for (left, top), view in zip(PANEL_CORNERS, part_views(bar, parameters), strict=True):
        pixels, hidden, depth = view.pixels(places), view.hidden(places), places @ view.R[2]
        for i, (u, v) in enumerate(pixels.round().astype(int)):
            near = np.linalg.norm(pixels - pixels[i], axis=-1) < DOT
            if depth[i] == depth[near].min():
                expected = 0.7 * colours[i] + 0.3 * np.array(BACKGROUND) if hidden[i] else colours[i]
                np.testing.assert_allclose(image[top + v, left + u], expected, atol=0.01)
                seen_hidden.append(bool(hidden[i]))
    assert any(seen_hidden) and not all(seen_hidden)


def test_of_keypoints_in_one_pixel_the_farther_is_a_ring_about_the_nearer(tmp_path):
    flange = TN34(learning={"r": [18], "h": [16]})
    parameters = flange.part_object("L", 0)
    room.part_picture(flange, parameters, tmp_path / "flange.png")
    image, colours = pixels_of(tmp_path / "flange.png"), instance_colours(3)
    left, top = PANEL_CORNERS[2]
    above = part_views(flange, parameters)[2]
    base, upper = above.pixels(keypoint_places(flange, parameters)[1:3]).round().astype(int)
    np.testing.assert_array_equal(base, upper)
    u, v = upper
    np.testing.assert_allclose(image[top + v, left + u], colours[1], atol=0.01)
    diagonal = round((DOT + 2.3) * np.sqrt(0.5))  # off the reference lines
    np.testing.assert_allclose(image[top + v - diagonal, left + u - diagonal], colours[0], atol=0.03)


@pytest.mark.usefixtures("bare")
def test_texts_stay_apart_inside_their_panels_and_off_the_dots(any_part):
    parameters = any_part.part_object("L", 0)
    figure = room.part_figure(any_part, parameters)
    assert_texts_are_apart_and_inside(figure)
    assert_texts_leave_the_dots_free(figure, any_part, parameters)
    for axes in figure.axes:
        words = [text.get_text() for text in axes.texts]
        assert set(words) >= {"centroid", *any_part.chain.names}


@pytest.mark.usefixtures("bare")
def test_what_a_line_measures_is_written_where_the_line_is_seen(tn06):
    figure = room.part_figure(tn06, np.array([0.004, 0.011, 0.014]))
    words = [{text.get_text() for text in axes.texts} for axes in figure.axes]
    assert {"r = 4 mm", "h/2 = 5.5 mm", "d = 14 mm"} <= words[0]
    assert "d = 14 mm" in words[2] and "h/2 = 5.5 mm" not in words[2]
    titles = [text.get_text() for text in figure.texts]
    assert "TN06   r = 4 mm, h = 11 mm, d = 14 mm" in titles
    assert "symmetry: dihedral, 12 rotations   ·   overall size 28 × 24.2 × 11 mm" in titles


@pytest.mark.parametrize("name", ["marble", "disc"])
def test_a_part_with_one_keypoint_is_drawn(name, tmp_path, request):
    part = request.getfixturevalue(name)
    room.part_picture(part, part.part_object("L", 0), tmp_path / "one.png")
    image, (left, top) = pixels_of(tmp_path / "one.png"), PANEL_CORNERS[0]
    view = part_views(part, part.part_object("L", 0))[0]
    u, v = view.pixels(keypoint_places(part, part.part_object("L", 0))[1]).round().astype(int)
    np.testing.assert_allclose(image[top + v, left + u], instance_colours(1)[0], atol=0.01)


@pytest.mark.usefixtures("bare")
def test_the_gallery_has_a_tile_for_every_part(tn06, tn34, bar, marble, disc, tmp_path):
    parts = [tn06, tn34, bar, marble, disc]
    figure = room.gallery_figure(parts)
    assert len(figure.axes) == 5
    assert_texts_are_apart_and_inside(figure)
    names = [text.get_text() for text in figure.texts]
    assert names[::2] == ["TN06", "TN34", "TN42", "MARBLE", "DISC"]
    room.gallery(parts, tmp_path / "gallery.png")
    with Image.open(tmp_path / "gallery.png") as picture:
        assert picture.size == (1202, 856)
    assert [path.name for path in tmp_path.iterdir()] == ["gallery.png"]


@pytest.mark.parametrize(
    ("count", "rows"),
    [
        (1, [[8]]),
        (4, [[8, 406, 804, 1202]]),
        (5, [[8, 406, 804], [207, 605]]),
        (8, [[8, 406, 804, 1202]] * 2),
        (9, [[8, 406, 804]] * 3),
        (10, [[8, 406, 804, 1202]] * 2 + [[406, 804]]),
    ],
)
def test_the_gallerys_rows_are_even_and_the_last_one_centred(disc, monkeypatch, count, rows):
    monkeypatch.setattr(room, "_draw_part", lambda *_, **__: None)
    corners = [(axes.bbox.y1, axes.bbox.x0) for axes in room.gallery_figure([disc] * count).axes]
    tops = sorted({round(top) for top, _ in corners}, reverse=True)
    assert [[round(left) for top, left in corners if round(top) == row] for row in tops] == rows


def test_a_gallery_of_nothing_is_refused(tmp_path):
    with pytest.raises(ValueError, match="at least one"):
        room.gallery([], tmp_path / "gallery.png")


@pytest.mark.usefixtures("bare")
def test_nothing_is_left_where_the_file_cannot_be_written(bar, tmp_path, monkeypatch):
    def broken(*_):
        raise OSError("the disk is full")

    monkeypatch.setattr("pnet.scenes.record_file.os.replace", broken)
    with pytest.raises(OSError, match="full"):
        room.part_picture(bar, bar.part_object("L", 0), tmp_path / "bar.png")
    with pytest.raises(OSError, match="full"):
        room.gallery([bar], tmp_path / "gallery.png")
    assert list(tmp_path.iterdir()) == []


def test_values_that_make_no_solid_are_refused(bar, tmp_path):
    with pytest.raises(ValueError, match="large end"):
        room.part_picture(bar, np.array([0.04, 0.002, 0.01]), tmp_path / "bar.png")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("symmetry", "mirror", "words"),
    [
        (cyclic(1), None, "none"),
        (cyclic(1), reflection((0, 1, 0)), "one mirror plane"),
        (cyclic(2), None, "cyclic, 2 rotations"),
        (cyclic(4), reflection((0, 1, 0)), "cyclic, 4 rotations, mirrored"),
        (dihedral(2), None, "dihedral, 4 rotations"),
        (dihedral(6), None, "dihedral, 12 rotations"),
        (RevolutionSymmetry(), None, "revolution"),
        (RevolutionSymmetry(rotoreflection=True), None, "revolution, ends equal"),
        (SphericalSymmetry(), None, "spherical"),
    ],
)
def test_the_symmetry_in_words(bar, monkeypatch, symmetry, mirror, words):
    monkeypatch.setattr(bar, "symmetry", symmetry)
    monkeypatch.setattr(bar, "mirror", mirror)
    assert room.symmetry_words(bar) == words


def test_the_rotations_of_a_cube_are_only_counted(bar, monkeypatch):
    cube = torch.from_numpy(Rotation.create_group("O").as_matrix())
    monkeypatch.setattr(bar, "symmetry", FiniteSymmetry(cube))
    monkeypatch.setattr(bar, "mirror", None)
    assert room.symmetry_words(bar) == "24 rotations"
