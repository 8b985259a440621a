"""What a run gives a bundle: points, camera, a CAD part's mesh."""

import numpy as np
import pytest
import torch
import trimesh

from pnet.cli.build import part_of
from pnet.cli.estimator import NEEDED, mesh_files, scenes_of, settings_of
from pnet.engine.bundle import Bundle, read_bundle, write_bundle
from pnet.geometry.camera import Camera

CAMERA = {"width": 4, "height": 3, "fx": 5.0, "fy": 6.0, "cx": 1.5, "cy": 1.0, "near": 0.2, "far": 2.0}


@pytest.mark.parametrize(
    ("manifest", "points"),
    [
        ({"protocol": {"points": 512}, "camera": {"_target_": "x", **CAMERA}}, 512),
        ({"protocol": {"points": 512, "by_part": {"gear": {"points": 64}}}, "camera": CAMERA}, 64),
        ({"source": "sileane", "points": 128, "camera": CAMERA}, 128),
        ({"training": {"points": 32, "camera": CAMERA}, "tests": {"points": 7, "camera": None}}, 32),
    ],
    ids=["generated", "own points", "public", "combined"],
)
def test_points_and_camera_are_those_of_the_training(manifest, points):
    found = scenes_of(manifest, "gear")
    assert found.points == points and found.camera == Camera(**CAMERA)


def test_what_a_manifest_does_not_tell_is_not_known():
    assert scenes_of({"source": "parametric", "points": 9, "camera": None}, "tn06").camera is None
    assert scenes_of({}, "tn06").points is None


def test_a_cad_parts_mesh_travels_with_the_bundle(tmp_path):
    mesh = tmp_path / "here" / "box.stl"
    mesh.parent.mkdir()
    trimesh.creation.box((20, 30, 40)).export(mesh)
    part = {"_target_": "pnet.parts.cad.CadPart", "name": "box", "mesh": str(mesh)}
    settings = {**{key: {} for key in NEEDED}, "part": part, "data": {}, "trainer": {}}
    files = mesh_files(settings)
    assert settings["part"]["mesh"] == "box.stl"
    write_bundle(tmp_path / "x.pnet", Bundle(settings, {"w": torch.zeros(1)}, 8, None, files))
    mesh.unlink()
    there = tmp_path / "there"
    there.mkdir()
    cfg = settings_of(read_bundle(tmp_path / "x.pnet"), tmp_path / "x.pnet", there)
    found = part_of(cfg)
    np.testing.assert_allclose(found.mesh(found.part_object("L", 0)).extents, [0.02, 0.03, 0.04])


def test_a_mesh_that_is_gone_is_told(tmp_path):
    with pytest.raises(FileNotFoundError, match="a bundle takes it along"):
        mesh_files({"part": {"mesh": str(tmp_path / "none.stl")}})


@pytest.mark.parametrize("name", ["../x.stl", "/x.stl", ".x", "a/b.stl"])
def test_files_with_paths_are_refused(tmp_path, name):
    with pytest.raises(ValueError, match="no plain name"):
        settings_of(Bundle({}, {}, 8, None, {name: b""}), tmp_path / "x.pnet", tmp_path)
