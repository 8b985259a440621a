"""pnet-predict and pnet-export on the small run: the same detections as pnet-evaluate, by every way in."""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

import pnet
from pnet.cli.app import config_dir
from pnet.cli.prediction_inputs import ahead, camera_words, find_inputs
from pnet.data.export.depth_view import EXACT
from pnet.data.source import StoredData
from pnet.engine.predictions import read_predictions

LOOSE = "+postprocess.visibility_threshold=0"  # a network of a few steps is sure of nothing


@pytest.fixture(scope="module")
def tn34_scenes(smoke, tn34):
    return StoredData(smoke.data).scenes("test_l", tn34)


@pytest.fixture(scope="module")
def depths(tn34_scenes, tn34):
    """The exact depth image of every scene of test_l."""
    return [EXACT.view(scene, tn34.mesh(scene.parameters[0])).exact for scene in tn34_scenes]


@pytest.fixture(scope="module")
def images(tmp_path_factory, depths) -> Path:
    """The images as .npy files."""
    folder = tmp_path_factory.mktemp("images")
    for i, depth in enumerate(depths):
        np.save(folder / f"{i}.npy", depth)
    return folder


def assert_same(found, expected, tolerance=0.0):
    assert len(found["score"]) == len(expected.score)
    for name in ("R", "t", "score", "parameters"):
        np.testing.assert_allclose(found[name], getattr(expected, name).numpy(), atol=tolerance)


def read_results(path, part):
    entries = json.loads(path.read_text())
    columns = {name: np.array([entry[name] for entry in entries]) for name in ("R", "t", "score")}
    sizes = [[entry["parameters"][name] for name in part.parameter_names] for entry in entries]
    return {**columns, "parameters": np.array(sizes)}


# the Python side


def test_three_lines_of_python_find_what_evaluation_finds(smoke, depths, tn34_scenes, tn34):
    _, evaluated = read_predictions(smoke.run / "evaluation" / "test_l" / "predictions.safetensors")
    estimator = pnet.Estimator.load(smoke.run)
    for depth, scene, expected in zip(depths, tn34_scenes, evaluated, strict=True):
        found = estimator.estimate(depth, scene.camera)
        np.testing.assert_array_equal(found.cloud.points, scene.points)
        own = {"R": found.R, "t": found.t, "score": found.score}
        sizes = np.stack([found.parameters[name] for name in tn34.parameter_names], -1)
        assert_same({**own, "parameters": sizes}, expected, 1e-9)
    assert estimator.camera == tn34_scenes[0].camera and estimator.points == 512


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        ({"device": "tpu"}, "device=tpu: choose auto, cpu, cuda"),
        ({"postprocess": {"visibilty_threshold": 0}}, "unknown key, did you mean visibility_threshold"),
    ],
)
def test_loading_refuses_wrong_settings(smoke, arguments, error):
    with pytest.raises(ValueError, match=error):
        pnet.Estimator.load(smoke.run, **arguments)


@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU is there")
def test_a_gpu_that_is_not_there_is_told(smoke):
    with pytest.raises(ValueError, match="torch finds no GPU"):
        pnet.Estimator.load(smoke.run, device="cuda")


# the command


def test_one_image_gives_json_csv_picture_page_and_a_table(smoke, images, run_here, tmp_path, tn34):
    outcome = run_here(
        smoke.folder, "predict", "run=outputs/run", f"input={images}/2.npy", f"output={tmp_path}", LOOSE
    )
    assert outcome.code == 0, outcome
    assert {path.name for path in tmp_path.iterdir()} == {"2.json", "2.csv", "2.png", "2.html"}
    found = read_results(tmp_path / "2.json", tn34)
    expected = pnet.Estimator.load(smoke.run, postprocess={"visibility_threshold": 0}).estimate(
        np.load(images / "2.npy")
    )
    assert len(expected) > 0
    np.testing.assert_array_equal(found["t"], expected.t)
    with (tmp_path / "2.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["x_mm"]) / 1000 for row in rows] == pytest.approx(expected.t[:, 0].tolist(), abs=1e-12)
    with Image.open(tmp_path / "2.png") as picture:
        assert min(picture.size) > 200
    for text in ("score", "network", "poses", "not background"):
        assert text in outcome.out


def test_a_folder_is_a_stream_that_goes_on_where_it_stopped(smoke, images, run_here, tmp_path):
    words = ("run=outputs/run", f"input={images}", f"output={tmp_path}", "picture=false", LOOSE, "batch=2")
    first = run_here(smoke.folder, "predict", *words)
    assert first.code == 0 and "3 images predicted" in first.out and "images/s; medians: " in first.out
    before = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.csv")}
    assert len(before) == 3
    (tmp_path / "1.json").unlink()
    again = run_here(smoke.folder, "predict", *words)
    assert "1 images predicted, 2 had results already" in again.out
    after = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.csv")}
    assert [name for name in after if after[name] != before[name]] == ["1.csv"]
    changed = run_here(smoke.folder, "predict", *words[:-2], "+postprocess.visibility_threshold=0.9")
    assert "3 images predicted" in changed.out and "had results" not in changed.out
    assert "3 images predicted" in run_here(smoke.folder, "predict", *words[:-2], "again=true").out


def test_a_bad_image_is_told_at_the_end_and_the_others_are_predicted(smoke, images, run_here, tmp_path):
    shutil.copytree(images, tmp_path / "in")
    (tmp_path / "in" / "0.npy").write_bytes(b"nothing")
    outcome = run_here(
        smoke.folder,
        "predict",
        "run=outputs/run",
        f"input={tmp_path}/in",
        f"output={tmp_path}/out",
        "picture=false",
    )
    assert outcome.code == 1
    assert f"1 of 3 inputs failed: {tmp_path}/in/0.npy: not readable" in outcome.err
    assert {path.stem for path in (tmp_path / "out").glob("*.csv")} == {"1", "2"}


def test_results_never_take_the_place_of_what_they_are_made_from(smoke, images, run_here, tmp_path):
    np.save(tmp_path / "0.npy", np.load(images / "0.npy"))
    depth = np.nan_to_num(np.load(images / "2.npy"))
    Image.fromarray(np.rint(1000 * depth).astype(np.uint16)).save(tmp_path / "bin.png")
    before = (tmp_path / "bin.png").read_bytes()
    for given in (tmp_path / "bin.png", tmp_path):
        outcome = run_here(
            smoke.folder, "predict", "run=outputs/run", f"input={given}", f"output={tmp_path}", "picture=true"
        )
        assert "bin.png would be written over; choose another folder" in outcome.error
    (tmp_path / "0.json").write_text(json.dumps(vars(pnet.Estimator.load(smoke.run).camera)))
    outcome = run_here(
        smoke.folder, "predict", "run=outputs/run", f"input={tmp_path}/0.npy", f"output={tmp_path}",
        f"camera={tmp_path}/0.json",
    )  # fmt: skip
    assert "0.json would be written over" in outcome.error
    assert (tmp_path / "bin.png").read_bytes() == before


def test_another_camera_in_the_same_file_makes_results_anew(smoke, images, run_here, tmp_path):
    camera = vars(pnet.Estimator.load(smoke.run).camera)
    words = (
        "run=outputs/run", f"input={images}", f"output={tmp_path}/out", f"camera={tmp_path}/camera.json"
    )  # fmt: skip
    for fx, made in (
        (375.0, "3 images predicted:"),
        (375.0, "3 had results"),
        (300.0, "3 images predicted:"),
    ):
        (tmp_path / "camera.json").write_text(json.dumps({**camera, "fx": fx}))
        assert made in run_here(smoke.folder, "predict", *words).out


def test_floating_point_images_are_metres_whatever_a_camera_file_says_of_integers(smoke, depths, tmp_path):
    from pnet.cli.prediction_inputs import DepthCoding, Reading
    from pnet.data.camera_files import read_camera

    (tmp_path / "camera_params.txt").write_text(
        "width 160\nheight 128\nfu 375\nfv 375\ncu 79.5\ncv 63.5\nclip_start 0.3\nclip_end 1\n"
    )
    file = read_camera(tmp_path / "camera_params.txt")
    coding = DepthCoding(file.depth_scale / 1000, file.depth_offset, of_integers=True)
    np.save(tmp_path / "metres.npy", depths[2])
    codes = np.rint((np.nan_to_num(depths[2], nan=1.0) - 0.3) / 0.7 * 65535).astype(np.uint16)
    np.save(tmp_path / "codes.npy", codes)
    estimator = pnet.Estimator.load(smoke.run)
    reading = Reading("depth", file.camera, coding, "m")
    one, two = (reading.prepare(tmp_path / f"{name}.npy", estimator).depth for name in ("metres", "codes"))
    np.testing.assert_array_equal(one, depths[2])
    np.testing.assert_allclose(two, depths[2], atol=0.7 / 65535)


def test_text_files_of_a_folder_are_clouds_only_where_that_is_said(tmp_path):
    for name in ("a.png", "README.txt", "empty.png", "b.xyz"):
        (tmp_path / name).touch()
    found = find_inputs(tmp_path, others=[tmp_path / "empty.png"])
    assert [path.name for path in found] == ["a.png", "b.xyz"]
    assert [path.name for path in find_inputs(tmp_path, "cloud")] == [
        "README.txt",
        "a.png",
        "b.xyz",
        "empty.png",
    ]


def test_an_empty_image_says_that_nothing_was_found(smoke, run_here, tmp_path):
    np.save(tmp_path / "empty.npy", np.full((128, 160), np.nan))
    outcome = run_here(
        smoke.folder, "predict", "run=outputs/run", f"input={tmp_path}/empty.npy", f"output={tmp_path}/out"
    )
    assert outcome.code == 0 and "nothing was found" in outcome.out
    assert json.loads((tmp_path / "out" / "empty.json").read_text()) == []


def test_integers_cameras_and_backgrounds_lead_to_the_same_parts(smoke, depths, run_here, tmp_path, tn34):
    """A 16-bit image in tenths of a millimetre before a floor, with the camera in a file."""
    depth = np.where(np.isfinite(depths[2]), depths[2], 0.72)
    Image.fromarray(np.rint(depth / 1e-4).astype(np.uint16)).save(tmp_path / "bin.png")
    camera = {"width": 160, "height": 128, "fx": 375, "fy": 375, "cx": 79.5, "cy": 63.5}
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    outcome = run_here(
        smoke.folder, "predict", "run=outputs/run", f"input={tmp_path}/bin.png", f"output={tmp_path}/out",
        f"camera={tmp_path}/camera.json", "depth.scale=1e-4", "background=limits", "background.z=[0.3,0.7]",
        "page=false", LOOSE,
    )  # fmt: skip
    assert outcome.code == 0, outcome
    kept = int(np.isfinite(depths[2]).sum())
    assert f"{depth.size:,} points measured, {kept:,} not background" in outcome.out
    exact = pnet.Estimator.load(smoke.run, postprocess={"visibility_threshold": 0}).estimate(depths[2])
    found = read_results(tmp_path / "out" / "bin.json", tn34)
    gap = np.linalg.norm(found["t"][:, None] - exact.t[None], axis=-1).min(1)
    assert np.median(gap) < 0.005


def test_a_cloud_is_found_like_its_image(smoke, tn34_scenes, run_here, tmp_path, tn34):
    trimesh.PointCloud(1000 * tn34_scenes[2].points.astype(float)).export(tmp_path / "cloud.ply")
    outcome = run_here(
        smoke.folder, "predict", "run=outputs/run", f"input={tmp_path}/cloud.ply", f"output={tmp_path}/out",
        "cloud.unit=mm", LOOSE,
    )  # fmt: skip
    assert outcome.code == 0, outcome
    assert len(read_results(tmp_path / "out" / "cloud.json", tn34)["score"]) > 0
    assert (tmp_path / "out" / "cloud.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (["input=none.npy"], "none.npy: no such file or folder; give input="),
        (["input=outputs/run/config.yaml"], "config.yaml: ends in .yaml, expected .png"),
        (["input=outputs/run"], "outputs/run: holds no depth image or cloud"),
        (
            ["input=outputs", "camera=ensenso_n53"],
            "camera=ensenso_n53: neither a file nor a choice, did you mean ensenso_n35",
        ),
        (["input=outputs", "threads=0"], "threads=0: expected a whole number of at least 1"),
        (["input=outputs", "picture=maybe"], "picture=maybe: expected true, false or null"),
        (["input=outputs", "batch=0"], "batch=0: expected a whole number of at least 1"),
        (["input=outputs", "kind=dept"], "kind=dept"),
        (["input=outputs", "device=gpu"], "device=gpu: choose auto, cpu, cuda"),
        (["input=outputs", "depth.scale=-1"], "depth.scale is -1"),
        (["input=outputs", "backgroud=plane"], "did you mean background"),
        (["input=outputs", "run=nowhere"], "nowhere: no such bundle"),
    ],
)
def test_mistakes_are_told_in_one_line(smoke, images, run_here, words, error, tmp_path):
    given = [
        word.replace("input=outputs", f"input={images}") if word == "input=outputs" else word
        for word in words
    ]
    run = [] if any(word.startswith("run=") for word in given) else ["run=outputs/run"]
    assert error in run_here(smoke.folder, "predict", *run, *given, f"output={tmp_path}").error


# bundles


@pytest.fixture(scope="module")
def bundle(smoke, tmp_path_factory, run_process) -> Path:
    path = tmp_path_factory.mktemp("bundle") / "flange.pnet"
    outcome = run_process(smoke.folder, "export", "run=outputs/run", f"output={path}")
    assert outcome.code == 0 and "tn34" in outcome.out, outcome
    return path


def test_a_bundle_alone_predicts_what_its_run_predicts(smoke, bundle, depths, tmp_path, monkeypatch):
    expected = pnet.Estimator.load(smoke.run, postprocess={"visibility_threshold": 0}).estimate(depths[2])
    alone = tmp_path / "elsewhere" / "x.pnet"
    alone.parent.mkdir()
    shutil.copy(bundle, alone)
    monkeypatch.chdir(alone.parent)
    found = pnet.Estimator.load(alone, postprocess={"visibility_threshold": 0}).estimate(depths[2])
    assert len(found) == len(expected) > 0
    for name in ("R", "t", "score"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert [path.name for path in alone.parent.iterdir()] == ["x.pnet"]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda s: s.update(part="x"), "part"),
        (lambda s: s.update(trainer={}), "precision"),
        (lambda s: s["backbone"].update(nonsense=1), "nonsense"),
        (lambda s: s["backbone"].update(_target_="os.system"), "not allowed"),
        (lambda s: s.pop("model"), "lack model"),
        (lambda s: s["model"].update(hidden=[7]), "do not fit"),
    ],
)
def test_a_bundle_of_other_settings_is_an_error_that_names_it(bundle, tmp_path, change, text):
    from pnet.engine.bundle import read_bundle, write_bundle

    spoilt = read_bundle(bundle)
    change(spoilt.settings)
    write_bundle(tmp_path / "x.pnet", spoilt)
    with pytest.raises(ValueError) as fault:
        pnet.Estimator.load(tmp_path / "x.pnet")
    assert "x.pnet" in str(fault.value) and text in str(fault.value), fault.value


def test_a_bundle_cannot_write_outside_of_its_folder(bundle, tmp_path):
    from dataclasses import replace

    from pnet.engine.bundle import read_bundle, write_bundle

    write_bundle(tmp_path / "x.pnet", replace(read_bundle(bundle), files={"../evil.stl": b"x"}))
    with pytest.raises(ValueError, match="no plain name"):
        pnet.Estimator.load(tmp_path / "x.pnet")


def test_a_bundle_takes_another_camera_along(smoke, run_here, tmp_path):
    outcome = run_here(
        smoke.folder, "export", "run=outputs/run", f"output={tmp_path}/x.pnet", "camera=realsense_d435"
    )
    assert outcome.code == 0, outcome
    assert pnet.Estimator.load(tmp_path / "x.pnet").camera.width == 848


def test_a_bundle_needs_its_ending(smoke, run_here, tmp_path):
    error = run_here(smoke.folder, "export", "run=outputs/run", f"output={tmp_path}/x.zip").error
    assert "has to end in .pnet" in error


# pieces


def test_a_camera_that_is_no_choice_is_a_file():
    assert camera_words(["camera=ensenso_n35", "camera=a b/c.json", "camera=null", "x=1"]) == [
        "camera=ensenso_n35", "+camera.file='a b/c.json'", "camera=null", "x=1",
    ]  # fmt: skip
    assert (config_dir() / "camera" / "ensenso_n35.yaml").is_file()


def test_two_inputs_of_one_name_are_refused(tmp_path):
    for name in ("a.png", "a.npy", "b.png"):
        (tmp_path / name).touch()
    with pytest.raises(ValueError, match="would have the same results"):
        find_inputs(tmp_path)
    (tmp_path / "a.npy").unlink()
    assert [path.name for path in find_inputs(tmp_path)] == ["a.png", "b.png"]


def test_reading_ahead_keeps_the_order_and_the_errors():
    def invert(x):
        return 1 / x

    results = []
    for item, future in ahead([1, 2, 0, 4], invert, 2):
        results.append(
            (item, future.exception().__class__.__name__ if future.exception() else future.result())
        )
    assert results == [(1, 1.0), (2, 0.5), (0, "ZeroDivisionError"), (4, 0.25)]
