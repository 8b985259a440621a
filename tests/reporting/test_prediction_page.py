"""The page of one image."""

import json
import re
from base64 import b64decode
from dataclasses import replace

import pytest
from tests.reporting.test_page import Elements

from pnet.geometry.camera import Camera
from pnet.reporting.prediction_page import (
    PredictionPage,
    camera_text,
    hints,
    prediction_page_html,
    write_prediction_page,
)

PICTURE = b"\x89PNG\r\n\x1a\n and so on"


@pytest.fixture
def untold(scene):
    """The scene as a user has it: nobody knows the truth."""
    names = ("R", "t", "parameters", "visibility", "occlusion")
    return replace(scene, **{name: getattr(scene, name)[:0] for name in names})


@pytest.fixture
def content(untold, detect, flange):
    return PredictionPage(
        title="bin <7>.png",
        facts=[("run", "outputs/demo & more"), ("camera", camera_text(untold.camera))],
        seconds={"network": 0.5, "poses": 0.25},
        picture=PICTURE,
        scene=untold,
        detections=detect([2, 0]),
        part=flange,
    )


@pytest.fixture
def empty(content, detect):
    return replace(content, detections=detect([]))


def words(page):
    return " ".join(" ".join(Elements(page).text).split())


def test_the_page_tells_where_it_comes_from_and_how_long_it_took(content):
    page = prediction_page_html(content)
    assert "bin <7>.png" in words(page) and "bin <7>" not in page
    assert "TN34: 2 found in 600 points" in words(page)
    assert "run outputs/demo & more" in words(page)
    assert "camera 160 × 128 pixels, fx 375, fy 375, cx 79.5, cy 63.5" in words(page)
    assert "time network 500 ms, poses 250 ms, together 750 ms" in words(page)


def test_the_table_holds_every_detection(content):
    page = prediction_page_html(content)
    (table,) = re.findall(r'<table class="sheet numbers">(.*?)</table>', page, re.DOTALL)
    rows = [re.findall(r"<t[hd]>(.*?)</t[hd]>", row) for row in re.findall(r"<tr>(.*?)</tr>", table)]
    assert rows[0] == ["#", "score", "x", "y", "z", "rx", "ry", "rz", "r", "h", "points"]
    pose = ["0.00", "600.00", "180.0", "0.0", "0.0", "18.00", "16.00", "200"]
    assert rows[1:] == [["1", "0.900", "60.00", *pose], ["2", "0.800", "-60.00", *pose]]


def test_the_picture_is_on_the_page(content):
    images = [a for tag, a in Elements(prediction_page_html(content)).found if tag == "img"]
    assert len(images) == 1 and images[0]["alt"]
    kind, data = images[0]["src"].split(",")
    assert kind == "data:image/png;base64" and b64decode(data) == PICTURE
    assert "<img" not in prediction_page_html(replace(content, picture=b""))


def test_nothing_is_loaded(content):
    page = prediction_page_html(content)
    elements = Elements(page).found
    assert not {tag for tag, _ in elements} & {"link", "iframe", "object", "embed", "audio", "video", "base"}
    places = [a[key] for _, a in elements for key in ("src", "href", "srcset") if key in a]
    assert len(places) == 1 and places[0].startswith("data:")
    style = re.search("<style>(.*?)</style>", page, re.DOTALL).group(1)
    assert "url(" not in style and "@import" not in style
    (policy,) = [a["content"] for _, a in elements if "http-equiv" in a]
    assert policy.startswith("default-src 'none'") and "http" not in policy


def test_the_view_has_points_and_estimates_and_no_truth(content):
    page = prediction_page_html(content)
    (figure,) = [json.loads(found) for found in re.findall(r'^draw\("[^"]+", (.*)\);$', page, re.M)]
    listed = [trace["name"] for trace in figure["data"] if trace.get("showlegend")]
    assert listed == ["points", "estimates"]
    assert page.count('class="plot"') == 1


def test_where_nothing_was_found_the_page_says_what_to_look_at(empty):
    page = prediction_page_html(empty)
    assert "TN34: nothing was found in 600 points" in words(page)
    assert "<h2>Nothing was found</h2>" in page and 'class="sheet' not in page
    for topic in ("Scale:", "Camera:", "Background:", "Post-processing:"):
        assert topic in words(page)


def test_hints_compare_the_cloud_with_the_part(untold, tn34):
    scale, _, background, _ = hints(untold, tn34)
    assert "the points span 156 × 36 × 16 mm, z from 590 to 606 mm" in scale
    assert "TN34 measures 24 to 36 mm, its longest side" in scale
    assert "600 points were looked at" in background


def test_without_points_the_only_hint_is_that(untold, flange, content, nothing):
    blind = replace(untold, points=untold.points[:0])
    assert [hint[:20] for hint in hints(blind, flange)] == ["There are no points:"]
    page = prediction_page_html(replace(content, scene=blind, detections=nothing))
    assert "near and far (0.3 and 1 m)" in words(page)


def test_hints_stand_only_where_nothing_was_found(content):
    assert "Nothing was found" not in prediction_page_html(content)


def test_a_cloud_has_no_camera():
    assert camera_text(None) == "none: a cloud"
    camera = Camera(1944, 1200, 1804.81234, 1804.8, 971, 599.5)
    assert camera_text(camera) == "1944 × 1200 pixels, fx 1804.81, fy 1804.8, cx 971, cy 599.5"


def test_the_file_is_written_whole(content, tmp_path):
    write_prediction_page(tmp_path / "bin.html", content)
    assert (tmp_path / "bin.html").read_text(encoding="utf-8") == prediction_page_html(content)
    assert [path.name for path in tmp_path.iterdir()] == ["bin.html"]
