"""Cycle files: scenes come back exactly, and a header that does not fit is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pnet.geometry.camera import Camera
from pnet.records import Scene, SceneId
from pnet.scenes.store import CycleFile, CycleHeader, write_cycle

CAMERA = Camera(64, 48, 100.0, 101.5, 31.5, 23.5, 0.1, 1.0)
HEADER = CycleHeader("0123abcd", "tn34", CAMERA, "train", "pile", 3, 5, (1, 2, 3), 4, 1, 2)
TYPES = {
    **dict.fromkeys(("R", "t", "parameters", "visibility", "occlusion"), np.float64),
    **{"points": np.float32, "instance": np.int64, "incidence": np.uint8, "edge": np.uint8},
}


def make_scene(d: int, seed: int = 0) -> Scene:
    rng = np.random.default_rng([d, seed])
    return Scene(
        points=rng.normal(size=(16, 3)).astype(np.float32),
        instance=rng.integers(0, d, 16),
        R=rng.normal(size=(d, 3, 3)),
        t=rng.normal(size=(d, 3)),
        parameters=rng.random((d, 2)),
        visibility=rng.random(d),
        occlusion=rng.random(d),
        camera=CAMERA,
        part="tn34",
        id=SceneId("train", "pile", 3, 5, d),
        incidence=rng.integers(0, 256, 16).astype(np.uint8),
        edge=rng.integers(0, 256, 16).astype(np.uint8),
    )


SCENES = [make_scene(d) for d in (1, 2, 3)]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "pile_0003_part_05.safetensors"


@pytest.fixture
def whole(path) -> bytes:
    write_cycle(path, HEADER, SCENES)
    return path.read_bytes()


def edit_header(whole: bytes, **changes) -> bytes:
    """The file with other header entries, under a checksum of their own."""
    from pnet.scenes.record_file import _header_checksum

    length = int.from_bytes(whole[:8], "little")
    top = json.loads(whole[8 : 8 + length])
    content = {**json.loads(top["__metadata__"]["pnet-cycle"]), **changes}
    content["header_crc32"] = _header_checksum(content)
    top["__metadata__"]["pnet-cycle"] = json.dumps(content)
    header = json.dumps(top).encode()
    return len(header).to_bytes(8, "little") + header + whole[8 + length :]


def test_scenes_come_back_exactly_and_in_any_order(path, whole):
    file = CycleFile(path)
    assert file.header == HEADER and len(file) == 3 and file.points_per_scene == 16
    for i in (2, 0, 2, 1):
        scene = file.scene(i)
        for name, kind in TYPES.items():
            array = getattr(scene, name)
            assert array.dtype == kind
            np.testing.assert_array_equal(array, getattr(SCENES[i], name))
        assert scene.camera == CAMERA and scene.part == "tn34"
        assert scene.id == file.scene_id(i) == SceneId("train", "pile", 3, 5, i + 1)


def test_a_scene_without_incidence_and_edges_has_none_when_it_comes_back(path):
    write_cycle(path, HEADER, [replace(scene, incidence=None, edge=None) for scene in SCENES])
    scene = CycleFile(path).scene(1)
    assert scene.incidence is None and scene.edge is None
    np.testing.assert_array_equal(scene.points, SCENES[1].points)


def test_equal_scenes_give_equal_bytes(tmp_path, whole):
    write_cycle(tmp_path / "again", HEADER, [make_scene(d) for d in (1, 2, 3)])
    assert (tmp_path / "again").read_bytes() == whole
    write_cycle(tmp_path / "other", HEADER, [make_scene(d, seed=1) for d in (1, 2, 3)])
    assert (tmp_path / "other").read_bytes() != whole


def test_a_cycle_without_scenes_can_be_written_and_read(path):
    header = replace(HEADER, drops=(), empty=3)
    write_cycle(path, header, [])
    file = CycleFile(path)
    assert len(file) == 0 and file.header == header and file.points_per_scene == 0


def test_a_header_with_a_right_checksum_is_read(path, whole):
    """So that what is refused below is refused for what it says."""
    path.write_bytes(edit_header(whole, part="tn06"))
    assert CycleFile(path).header == replace(HEADER, part="tn06")


@pytest.mark.parametrize(
    "changes",
    [
        {"drops": [1, 2]},
        {"drops": None},
        {"crc32": [0, 0]},
        {"crc32": None},
        {"camera": {"width": 3}},
        {"camera": {**CAMERA.to_dict(), "near": -1.0}},
        {"camera": None},
    ],
)
def test_a_header_that_disagrees_with_the_arrays_is_refused(path, whole, changes):
    path.write_bytes(edit_header(whole, **changes))
    with pytest.raises(ValueError, match=f"{path}: not a whole cycle file"):
        CycleFile(path)


def test_a_scene_of_another_checksum_is_refused_and_the_others_are_read(path, whole):
    crc32 = CycleFile(path)._file.header["crc32"]
    path.write_bytes(edit_header(whole, crc32=[crc32[0], crc32[1] ^ 1, crc32[2]]))
    file = CycleFile(path)
    np.testing.assert_array_equal(file.scene(2).points, SCENES[2].points)
    with pytest.raises(ValueError, match=f"{path}: not a whole cycle file .record 1 does not match"):
        file.scene(1)


def test_a_flipped_bit_in_the_data_is_found(path, whole):
    start = 8 + int.from_bytes(whole[:8], "little")
    for place in np.random.default_rng(0).integers(start, len(whole), 60):
        garbled = bytearray(whole)
        garbled[place] ^= 1 << place % 8
        path.write_bytes(garbled)
        with pytest.raises(ValueError, match=f"{path}: not a whole cycle file"):
            [CycleFile(path).scene(i) for i in range(3)]


def test_a_missing_file_is_named(path):
    with pytest.raises(FileNotFoundError, match=f"{path}: no such cycle file; run pnet-generate"):
        CycleFile(path)
