"""Bundles: what goes in comes out, and nothing else is believed."""

import json
import os
import shutil

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from tests.mutations import mutate_folder

from pnet.engine.bundle import FORMAT, Bundle, read_bundle, write_bundle
from pnet.geometry.camera import Camera

MUTATIONS = int(os.environ.get("PNET_MUTATIONS", "200"))
CAMERA = Camera(160, 128, 375.0, 376.0, 79.5, 63.5, 0.3, 1.0)


def some_bundle():
    weights = {"a.weight": torch.arange(6.0).reshape(2, 3), "b": torch.tensor([1, 2])}
    settings = {"part": {"_target_": "pnet.parts.tn34.TN34", "mesh": "x.stl"}, "seed": 0}
    return Bundle(settings, weights, 4096, CAMERA, {"x.stl": b"\x00solid\xff"}, {"steps": 3})


def test_a_bundle_is_read_as_it_was_written(tmp_path):
    path, bundle = tmp_path / "new" / "part.pnet", some_bundle()
    write_bundle(path, bundle)
    found = read_bundle(path)
    assert found.settings == bundle.settings and found.points == 4096 and found.camera == CAMERA
    assert found.files == {"x.stl": b"\x00solid\xff"} and found.about == {"steps": 3}
    assert set(found.weights) == {"a.weight", "b"}
    assert all(torch.equal(found.weights[name], value) for name, value in bundle.weights.items())
    assert found.weights["b"].dtype == torch.int64
    assert [p.name for p in path.parent.iterdir()] == ["part.pnet"]


def test_equal_bundles_have_equal_bytes(tmp_path):
    for name in ("a", "b"):
        write_bundle(tmp_path / name, some_bundle())
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_a_bundle_may_know_no_camera_and_have_no_files(tmp_path):
    write_bundle(tmp_path / "x.pnet", Bundle({}, {"w": torch.zeros(1)}, 1, None))
    found = read_bundle(tmp_path / "x.pnet")
    assert found.camera is None and found.files == {} and found.about == {}


def header(**changes):
    whole = {"version": 1, "settings": {}, "points": 8, "camera": None, "about": {}, **changes}
    return {FORMAT: json.dumps({key: value for key, value in whole.items() if value is not ...})}


@pytest.mark.parametrize(
    ("metadata", "text"),
    [
        (None, "pnet-bundle"),
        ({FORMAT: "{"}, "Expecting property name"),
        (header(version=2), "it has version 2, this pnet reads 1"),
        (header(points=0), "its number of points is 0"),
        (header(points=10**10), "its number of points is 10000000000, expected 1 to"),
        (header(points="8"), "its number of points is '8'"),
        (header(points=...), "'points'"),
        (header(camera={"width": 3}), "missing 5 required"),
        (header(camera={**vars(CAMERA), "fx": -1}), "must be positive"),
        (header(camera={**vars(CAMERA), "cx": float("nan")}), "NaN or infinite"),
        (header(camera={**vars(CAMERA), "width": 10**9, "height": 10**9}), "its camera has 1000000000 x"),
        (header(settings={"a": ["${oc.env:HOME}"]}), "its settings refer to others"),
        ({FORMAT: "[" * 200_000}, "recursion"),
        (header(settings=[1]), "cannot convert"),
    ],
)
def test_what_is_no_bundle_is_refused_with_its_name_and_the_reason(tmp_path, metadata, text):
    path = tmp_path / "x.pnet"
    save_file({"weight/w": torch.zeros(2)}, path, metadata)
    with pytest.raises(ValueError) as fault:
        read_bundle(path)
    assert str(path) in str(fault.value) and text in str(fault.value), fault.value
    assert "export it again" in str(fault.value)


def test_weights_that_are_no_numbers_are_refused(tmp_path):
    save_file({"weight/w": torch.tensor([1.0, torch.nan])}, tmp_path / "x.pnet", header())
    with pytest.raises(ValueError, match="weight w is NaN or infinite"):
        read_bundle(tmp_path / "x.pnet")


def test_a_missing_bundle_says_how_to_make_one(tmp_path):
    with pytest.raises(FileNotFoundError, match="pnet-export run=… output="):
        read_bundle(tmp_path / "none.pnet")


def test_a_pickle_is_not_unpickled(tmp_path):
    class Evil:
        def __reduce__(self):
            return (open, (str(tmp_path / "ran"), "w"))

    torch.save(Evil(), tmp_path / "evil.pnet")
    with pytest.raises(ValueError, match="not a bundle"):
        read_bundle(tmp_path / "evil.pnet")
    assert not (tmp_path / "ran").exists()


def test_damaged_bundles_are_refused_or_whole(tmp_path):
    good = some_bundle()
    for seed in range(MUTATIONS):
        folder = tmp_path / str(seed)
        write_bundle(folder / "x.pnet", good)
        done = mutate_folder(folder, np.random.default_rng(seed))
        try:
            found = read_bundle(folder / "x.pnet")
        except (ValueError, OSError):
            shutil.rmtree(folder)
            continue
        assert all(bool(torch.isfinite(weight).all()) for weight in found.weights.values()), done
        shutil.rmtree(folder)
        assert isinstance(found.settings, dict) and found.points >= 1, done
