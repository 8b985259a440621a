"""Cameras of five layouts, and files that are none."""

import json
import os

import numpy as np
import pytest
from omegaconf import OmegaConf
from tests.conftest import CONF
from tests.mutations import mutate_folder

from pnet.data.camera_files import CameraFile, read_camera
from pnet.geometry.camera import Camera

MUTATIONS = int(os.environ.get("PNET_MUTATIONS", "200"))

PNET = "width: 640\nheight: 512\nfx: 1500.0\nfy: 1501.0\ncx: 319.5\ncy: 255.5\nnear: 0.3\nfar: 1.0\n"
SILEANE = """# a simulated camera
width 506
height 474
fu 1152.0
fv 1153.5   # pixels
cu 252.5
cv 236.5
clip_start 0.87
clip_end 1.88
location 0 0 1.5
rotation 0 1 0 0
"""
BOP = {
    "width": 720,
    "height": 540,
    "fx": 1075.7,
    "fy": 1073.9,
    "cx": 367.1,
    "cy": 247.6,
    "depth_scale": 0.1,
}
ROS = """image_width: 1280
image_height: 720
camera_name: depth
camera_matrix:
  rows: 3
  cols: 3
  data: [921.2, 0.0, 640.3, 0.0, 922.1, 360.4, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0, 0, 0, 0, 0.0]
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
"""
OPEN3D = {"width": 640, "height": 480, "intrinsic_matrix": [525.0, 0, 0, 0, 526.0, 0, 319.5, 239.5, 1]}


def write(folder, name, content):
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


LAYOUTS = {
    "pnet.yaml": (PNET, CameraFile(Camera(640, 512, 1500.0, 1501.0, 319.5, 255.5, 0.3, 1.0))),
    "sileane.txt": (
        SILEANE,
        CameraFile(
            Camera(506, 474, 1152.0, 1153.5, 252.5, 236.5, 0.87, 1.88),
            pytest.approx(1010 / 65535, rel=1e-12),
            depth_offset=0.87,
        ),
    ),
    "bop.json": (BOP, CameraFile(Camera(720, 540, 1075.7, 1073.9, 367.1, 247.6), 0.1)),
    "ros.yml": (ROS, CameraFile(Camera(1280, 720, 921.2, 922.1, 640.3, 360.4))),
    "open3d.json": (OPEN3D, CameraFile(Camera(640, 480, 525.0, 526.0, 319.5, 239.5))),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_every_layout_is_known_by_its_keys(tmp_path, name):
    content, expected = LAYOUTS[name]
    assert read_camera(write(tmp_path, name, content)) == expected


@pytest.mark.parametrize("path", sorted((CONF / "camera").glob("*.yaml")), ids=lambda path: path.stem)
def test_every_camera_of_the_configs_reads_as_it_is_built(path):
    fields = OmegaConf.to_container(OmegaConf.load(path))
    assert fields.pop("_target_") == "pnet.geometry.camera.Camera"
    assert read_camera(path).camera == Camera(**fields)


def test_without_clip_planes_nothing_is_said_of_depth(tmp_path):
    text = "\n".join(line for line in SILEANE.splitlines() if not line.startswith("clip"))
    found = read_camera(write(tmp_path, "a.txt", text))
    assert found == CameraFile(Camera(506, 474, 1152.0, 1153.5, 252.5, 236.5, 0.1, 10.0))


def test_a_pnet_camera_reads_from_json_too(tmp_path):
    camera = Camera(8, 6, 10.0, 11.0, 3.5, 2.5, 0.2, 3.0)
    assert read_camera(write(tmp_path, "a.json", camera.to_dict())) == CameraFile(camera)


def test_a_lens_distortion_is_reported(tmp_path):
    assert read_camera(write(tmp_path, "a.yaml", ROS.replace("0, 0.0]", "0.1, 0.0]"))).distorted
    assert not read_camera(write(tmp_path, "b.yaml", ROS)).distorted


def test_a_byte_order_mark_is_no_part_of_a_key(tmp_path):
    path = tmp_path / "a.txt"
    path.write_bytes(b"\xef\xbb\xbf" + SILEANE.split("\n", 1)[1].replace("\n", "\r\n").encode())
    assert read_camera(path).camera.width == 506


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (
            "a.yaml",
            PNET.replace("fx: 1500.0\n", ""),
            "keys found: cx, cy, far, fy, height, near, width; expec",
        ),
        ("a.yaml", PNET.replace("cy: 255.5\n", ""), "key 'cy' is missing"),
        ("a.yaml", PNET.replace("640", "640.5"), "key 'width' is 640.5, expected a whole number"),
        ("a.yaml", PNET.replace("640", "0"), "key 'width' is 0, expected a whole number"),
        ("a.yaml", PNET.replace("640", "640000"), "claims 640000 x 512 pixels"),
        ("a.yaml", PNET.replace("1500.0", ".nan"), "key 'fx' holds NaN or infinity"),
        ("a.yaml", PNET.replace("1500.0", "0.93"), "key 'fx' is 0.93, expected 1 to 1,000,000 pixels"),
        ("a.yaml", PNET.replace("1500.0", "'1500'"), "key 'fx' does not hold numbers"),
        ("a.yaml", PNET.replace("0.3", "3"), "near .3.0. must be positive and below far .1.0."),
        ("a.yaml", "- 1\n- 2\n", "holds a list"),
        ("a.yaml", "", "holds a NoneType"),
        ("a.yaml", "a: &a [1, 2]\nfx: *a\n", "has an alias"),
        ("a.yaml", "fx: !!python/name:os.system ''\n", "not valid YAML"),
        ("a.yaml", "[" * 5_000, "not valid YAML"),
        ("a.yaml", "# " + "x" * 100_000, "has 100,002 bytes, expected 100,000 at most"),
        ("a.json", "{", "not valid JSON"),
        ("a.json", BOP | {"depth_scale": 0}, "key 'depth_scale' is 0, expected more than 0"),
        ("a.json", {"0": {"cam_K": []}}, "no camera that is known here; keys found: 0; expected width"),
        ("a.json", OPEN3D | {"intrinsic_matrix": [525, 0, 319, 0, 525, 239, 0, 0, 1]}, "column by column"),
        ("a.json", OPEN3D | {"intrinsic_matrix": [525, 0, 0, 2, 525, 0, 319, 239, 1]}, "is no camera matrix"),
        ("a.json", OPEN3D | {"intrinsic_matrix": [525]}, r"has shape \(1,\), expected \(9,\)"),
        ("a.yaml", ROS.replace("data: [921.2,", "data: [1, 921.2,"), r"camera_matrix: key 'data' has shape"),
        ("a.yaml", "camera_matrix: [1, 2]\n", "key 'camera_matrix' holds no keys"),
        ("a.txt", SILEANE.replace("fu 1152.0", "fu many"), "key 'fu' does not hold numbers"),
        ("a.txt", SILEANE.replace("clip_end 1.88", "clip_end 0.5"), "must be positive and below far"),
        ("a.txt", SILEANE + "cu 252\n", "key 'cu' stands there twice"),
        ("a.xml", "", r"ends in .xml, expected one of .json, .yaml, .yml, .txt"),
    ],
)
def test_what_is_no_camera_is_an_error_that_names_file_and_key(tmp_path, name, content, message):
    path = write(tmp_path, name, content)
    with pytest.raises(ValueError, match=message) as fault:
        read_camera(path)
    assert str(fault.value).startswith(str(path))
    assert len(str(fault.value)) < len(str(path)) + 600


def test_a_missing_file_is_an_error_that_names_it(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"a\.yaml: no such camera file"):
        read_camera(tmp_path / "a.yaml")


def test_damaged_files_give_a_valid_camera_or_one_error(tmp_path):
    rng = np.random.default_rng(int(os.environ.get("PNET_MUTATIONS_SEED", "0")))
    read = 0
    for number in range(MUTATIONS):
        folder = tmp_path / str(number)
        folder.mkdir()
        for name, (content, _) in LAYOUTS.items():
            write(folder, name, content)
        done = mutate_folder(folder, rng)
        path = folder / done.split(":")[0]
        try:
            found = read_camera(path)
        except (ValueError, OSError) as fault:
            assert str(path) in str(fault), done
            continue
        read += 1
        camera = found.camera
        assert np.isfinite(list(camera.to_dict().values())).all(), done
        assert isinstance(camera.width, int) and 1 <= camera.width * camera.height <= 64_000_000, done
        assert camera.fx >= 1 and camera.fy >= 1 and 0 < camera.near < camera.far, done
        assert found.depth_scale is None or 0 < found.depth_scale < np.inf, done
    assert 0 < read < MUTATIONS
