"""Cycle files: exact, repeatable, and never read wrongly."""

import errno
import json
import os
from dataclasses import replace

import numpy as np
import pytest
from safetensors.numpy import save

from pnet.geometry.camera import Camera
from pnet.records import Scene, SceneId
from pnet.scenes.store import CycleFile, CycleHeader, write_atomically, write_cycle

CAMERA = Camera(64, 48, 100.0, 101.5, 31.5, 23.5, 0.1, 1.0)
HEADER = CycleHeader("0123abcd", "tn34", CAMERA, "train", "pile", 3, 5, (1, 2, 3), 4, 1, 2)
ARRAYS = ("points", "instance", "R", "t", "parameters", "visibility", "occlusion")


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
    )


SCENES = [make_scene(d) for d in (1, 2, 3)]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "pile_0003_part_05.safetensors"


@pytest.fixture
def whole(path) -> bytes:
    write_cycle(path, HEADER, SCENES)
    return path.read_bytes()


def is_unchanged(path) -> bool:
    """Whether the file reads as what was written."""
    file = CycleFile(path)
    scenes = [file.scene(i) for i in range(len(file))]
    same = [
        np.array_equal(getattr(a, n), getattr(b, n)) and getattr(a, n).dtype == getattr(b, n).dtype
        for a, b in zip(scenes, SCENES, strict=True)
        for n in ARRAYS
    ]
    return file.header == HEADER and all(same) and [s.id for s in scenes] == [s.id for s in SCENES]


def refused_or_unchanged(path) -> bool:
    """True where the file is refused with its name, False where it reads as what was written."""
    try:
        assert is_unchanged(path), "read as something else"
    except ValueError as fault:
        assert str(path) in str(fault)
        return True
    return False


def edit_header(whole: bytes, **changes) -> bytes:
    """The file with other header entries and no checksum of the header."""
    length = int.from_bytes(whole[:8], "little")
    top = json.loads(whole[8 : 8 + length])
    content = json.loads(top["__metadata__"]["pnet-cycle"])
    del content["header_crc32"]
    content.update(changes)
    top["__metadata__"]["pnet-cycle"] = json.dumps(content)
    header = json.dumps(top).encode()
    return len(header).to_bytes(8, "little") + header + whole[8 + length :]


def test_scenes_come_back_exactly(path, whole):
    assert is_unchanged(path)
    file = CycleFile(path)
    assert len(file) == 3 and file.points_per_scene == 16
    assert file.scene(1).camera == CAMERA and file.scene(1).part == "tn34"
    assert file.scene_id(2) == SceneId("train", "pile", 3, 5, 3)


def test_scenes_can_be_read_in_any_order(path, whole):
    file = CycleFile(path)
    for i in (2, 0, 2, 1):
        np.testing.assert_array_equal(file.scene(i).R, SCENES[i].R)


def test_equal_scenes_give_equal_bytes(tmp_path, whole):
    write_cycle(tmp_path / "again", HEADER, [make_scene(d) for d in (1, 2, 3)])
    assert (tmp_path / "again").read_bytes() == whole
    write_cycle(tmp_path / "other", HEADER, [make_scene(d, seed=1) for d in (1, 2, 3)])
    assert (tmp_path / "other").read_bytes() != whole


def test_a_cycle_without_scenes_can_be_written_and_read(path):
    header = replace(HEADER, drops=(), empty=3)
    write_cycle(path, header, [])
    file = CycleFile(path)
    assert len(file) == 0 and file.header == header


@pytest.mark.parametrize("share", [0.0, 0.001, 0.01, 0.2, 0.4, 0.5, 0.9, 0.9999])
def test_a_truncated_file_is_refused(path, whole, share):
    path.write_bytes(whole[: int(share * len(whole))])
    assert refused_or_unchanged(path)


def test_a_file_with_something_behind_is_refused(path, whole):
    path.write_bytes(whole + b"\0")
    assert refused_or_unchanged(path)


def test_a_flipped_bit_in_the_data_is_found(path, whole):
    data = 8 + int.from_bytes(whole[:8], "little")
    rng = np.random.default_rng(0)
    for place in rng.integers(data, len(whole), 150):
        garbled = bytearray(whole)
        garbled[place] ^= 1 << rng.integers(8)
        path.write_bytes(garbled)
        assert refused_or_unchanged(path)


def test_a_garbled_header_is_never_read_as_other_data(path, whole):
    data = 8 + int.from_bytes(whole[:8], "little")
    rng, refused = np.random.default_rng(1), 0
    for _ in range(400):
        garbled = bytearray(whole)
        for place in rng.integers(0, data, rng.choice([1, 1, 3])):
            garbled[place] = rng.integers(256)
        path.write_bytes(garbled)
        refused += refused_or_unchanged(path)
    assert refused > 380  # a byte may be replaced by itself


def test_every_digit_of_the_header_counts(path, whole):
    """A digit for another: the file stays well-formed, only the checksums can tell."""
    data = 8 + int.from_bytes(whole[:8], "little")
    digits = [place for place in range(8, data) if whole[place : place + 1].isdigit()]
    refused = 0
    for place in digits:
        garbled = bytearray(whole)
        garbled[place] = ord("0") + (garbled[place] - ord("0") + 1) % 10
        path.write_bytes(garbled)
        refused += refused_or_unchanged(path)
    assert refused == len(digits) > 100


def test_another_array_type_of_the_same_size_is_refused(path, whole):
    for old, new in ((b'"F64"', b'"I64"'), (b'"F32"', b'"I32"'), (b'"I16"', b'"U16"')):
        assert old in whole
        path.write_bytes(whole.replace(old, new))
        assert refused_or_unchanged(path)


@pytest.mark.parametrize(
    "content",
    [b"", b"\0" * 8, b"not a cycle", b"\xff" * 100, b"{}", save({"points": np.zeros(3)})],
    ids=["empty", "zeros", "text", "ones", "json", "other safetensors"],
)
def test_a_file_of_another_kind_is_refused(path, content):
    path.write_bytes(content)
    with pytest.raises(ValueError, match=f"{path}: not a whole cycle file"):
        CycleFile(path)


@pytest.mark.parametrize("content", ["[]", '"text"', "3", "null", "{}", '{"version": "1"}', "{"])
def test_a_header_of_another_shape_is_refused(path, content):
    path.write_bytes(save({"points": np.zeros(3)}, {"pnet-cycle": content}))
    with pytest.raises(ValueError, match=f"{path}: not a whole cycle file"):
        CycleFile(path)


def test_a_newer_version_asks_for_an_update(path, whole):
    path.write_bytes(edit_header(whole, version=99))
    with pytest.raises(ValueError, match=f"{path}: written by a newer pnet .format 99.*update pnet"):
        CycleFile(path)


@pytest.mark.parametrize(
    "changes",
    [
        {"drops": [1, 2]},
        {"crc32": [0, 0]},
        {"crc32": None},
        {"camera": {"width": 3}},
        {"camera": {**CAMERA.to_dict(), "near": -1.0}},
        {"drops": None},
    ],
)
def test_a_header_that_disagrees_with_the_arrays_is_refused(path, whole, changes):
    path.write_bytes(edit_header(whole, **changes))
    with pytest.raises(ValueError, match=f"{path}: not a whole cycle file"):
        CycleFile(path)


def test_a_header_without_its_checksum_is_refused(path, whole):
    path.write_bytes(edit_header(whole))
    with pytest.raises(ValueError, match=f"{path}: not a whole cycle file"):
        CycleFile(path)


def test_a_missing_file_is_named(path):
    with pytest.raises(FileNotFoundError, match=f"{path}: no such cycle file; run pnet-generate"):
        CycleFile(path)


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_nothing_appears_when_writing_fails_midway(path, monkeypatch, step):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, step, full)
    with pytest.raises(OSError, match="No space left"):
        write_cycle(path, HEADER, SCENES)
    assert list(path.parent.iterdir()) == []


def test_a_failed_rewrite_leaves_the_old_file(path, whole, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, b"new")
    assert path.read_bytes() == whole and list(path.parent.iterdir()) == [path]


def test_an_atomic_write_replaces_the_file(path, whole):
    write_atomically(path, b"new")
    assert path.read_bytes() == b"new" and list(path.parent.iterdir()) == [path]


def test_writing_into_a_missing_folder_names_it(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        write_atomically(tmp_path / "nowhere" / "file", b"new")
