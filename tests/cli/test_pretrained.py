"""The weights that come with pnet: found by the part's name, in a checkout and in an installed package."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import pnet
from pnet.cli import pretrained
from pnet.cli.pretrained import part_words, pretrained_bundle, pretrained_parts, weights_dir
from pnet.data.export.depth_view import EXACT
from pnet.data.source import StoredData
from pnet.engine.bundle import read_bundle, write_bundle

ROOT = Path(__file__).parents[2]
LOOSE = "+postprocess.visibility_threshold=0"  # a network of a few steps is sure of nothing


@pytest.fixture(scope="module")
def exported(smoke, tmp_path_factory, run_process) -> Path:
    """A folder of weights with one part."""
    folder = tmp_path_factory.mktemp("weights")
    (folder / "README.md").write_text("# Weights\n")
    outcome = run_process(
        smoke.folder, "export", "run=outputs/run", f"output={folder}/tn34.safetensors", "card=true"
    )
    assert outcome.code == 0, outcome
    return folder


@pytest.fixture
def weights(exported, tmp_path, monkeypatch) -> Path:
    """A copy of it to spoil, in place of pnet's own."""
    folder = tmp_path / "weights"
    shutil.copytree(exported, folder)
    monkeypatch.setattr(pretrained, "weights_dir", lambda: folder)
    return folder


@pytest.fixture(scope="module")
def image(smoke, tn34, tmp_path_factory) -> Path:
    """The exact depth image of a full bin."""
    scenes = StoredData(smoke.data).scenes("test_l", tn34)
    scene = scenes[len(scenes) - 1]
    path = tmp_path_factory.mktemp("image") / "bin.npy"
    np.save(path, EXACT.view(scene, tn34.mesh(scene.parameters[0])).exact)
    return path


# finding


def test_a_checkout_has_its_weights_at_the_top():
    assert weights_dir() == ROOT / "weights"


@pytest.mark.parametrize(("module", "weights"), [("lib/pnet", "lib/pnet"), ("src/pnet", "")])
def test_weights_are_found_in_a_package_and_in_a_checkout(tmp_path, monkeypatch, module, weights):
    (tmp_path / module / "cli").mkdir(parents=True)
    folder = tmp_path / weights / "weights"
    folder.mkdir()
    monkeypatch.setattr(pretrained, "__file__", str(tmp_path / module / "cli" / "pretrained.py"))
    with pytest.raises(FileNotFoundError, match="install pnet again"):
        weights_dir()
    (folder / "README.md").touch()
    assert weights_dir() == folder and pretrained_parts() == []
    with pytest.raises(ValueError, match=r"part=tn34: no weights .* this copy of pnet holds none"):
        pretrained_bundle("tn34")
    (folder / "tn34.safetensors").touch()
    assert pretrained_parts() == ["tn34"] and pretrained_bundle("tn34") == folder / "tn34.safetensors"


def test_a_parts_name_is_a_plain_value():
    words = ["part=tn34", "input=part=1", "camera=x", "part.name=a"]
    assert part_words(words) == ["part.name=tn34", "input=part=1", "camera=x", "part.name=a"]


# predicting


def test_a_part_predicts_what_its_run_predicts(smoke, weights, image, run_here, tmp_path):
    given = (f"input={image}", LOOSE, "page=true")
    for name, word in (("run", "run=outputs/run"), ("part", "part=tn34")):
        outcome = run_here(smoke.folder, "predict", word, f"output={tmp_path}/{name}", *given)
        assert outcome.code == 0, outcome
    by_run, by_part = (json.loads((tmp_path / name / "bin.json").read_text()) for name in ("run", "part"))
    assert by_run == by_part and len(by_part) > 0
    assert "tn34.safetensors" in (tmp_path / "part" / "bin.html").read_text()


def test_a_folder_goes_on_until_the_weights_change(smoke, weights, image, run_here, tmp_path):
    words = ("part=tn34", f"input={image.parent}", f"output={tmp_path}/out", "picture=false")
    assert "1 images predicted:" in run_here(smoke.folder, "predict", *words).out
    assert "1 had results" in run_here(smoke.folder, "predict", *words).out
    by_path = (f"run={weights}/tn34.safetensors", *words[1:])
    assert "1 had results" in run_here(smoke.folder, "predict", *by_path).out
    bundle = read_bundle(weights / "tn34.safetensors")
    next(iter(bundle.weights.values())).mul_(1.5)
    write_bundle(weights / "tn34.safetensors", bundle)
    assert "1 images predicted:" in run_here(smoke.folder, "predict", *words).out


def test_python_names_a_part_too(smoke, weights, image):
    options = {"postprocess": {"visibility_threshold": 0}, "device": "cpu"}
    found = pnet.Estimator.pretrained("tn34", **options).estimate(np.load(image))
    expected = pnet.Estimator.load(smoke.run, **options).estimate(np.load(image))
    assert len(found) == len(expected) > 0
    np.testing.assert_array_equal(found.t, expected.t)
    np.testing.assert_array_equal(found.R, expected.R)
    with pytest.raises(ValueError, match="no weights for it come with pnet, did you mean tn34"):
        pnet.Estimator.pretrained("tn35")
    with pytest.raises(ValueError, match="device=tpu"):
        pnet.Estimator.pretrained("tn34", device="tpu")


@pytest.mark.parametrize(
    ("words", "error"),
    [
        ([], "run and part are missing: give part=NAME for weights that come with pnet (there are tn34)"),
        (["part=null"], "run and part are missing"),
        (["part=tn34", "run=outputs/run"], "run=outputs/run and part=tn34: give one of them"),
        (["part=gear"], "part=gear: no weights for it come with pnet; there are tn34; train a network"),
        (["part=tn43"], "part=tn43: no weights for it come with pnet, did you mean tn34?; there are tn34"),
        (["part=../weights/tn34"], "part=../weights/tn34: no weights for it"),
        (["part=34"], "part=34: no weights for it"),
        (["part={name:tn34}"], "no weights for it"),
        (["part.nam=tn34"], "part.nam: unknown key, did you mean part.name"),
        (["part=tn34", "+postprocess.visibilty=0"], "postprocess.visibilty: unknown key"),
    ],
)
def test_mistakes_are_told_in_one_line(smoke, weights, image, run_here, tmp_path, words, error):
    given = (f"input={image}", f"output={tmp_path}/out")
    assert error in run_here(smoke.folder, "predict", *words, *given).error


def test_without_any_weights_the_error_says_so(smoke, weights, image, run_here):
    (weights / "tn34.safetensors").unlink()
    error = run_here(smoke.folder, "predict", f"input={image}").error
    assert "(this copy of pnet holds none), or run=FOLDER|FILE" in error


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda s: s["backbone"].update(_target_="os.system"), "not allowed"),
        (lambda s: s["part"].update(_target_="pnet.cli.export.export"), "not allowed"),
        (lambda s: s["model"].update(hidden=[7]), "do not fit"),
    ],
)
def test_pnets_own_weights_are_believed_no_more_than_others(weights, change, text):
    spoilt = read_bundle(weights / "tn34.safetensors")
    change(spoilt.settings)
    write_bundle(weights / "tn34.safetensors", spoilt)
    with pytest.raises(ValueError) as fault:
        pnet.Estimator.pretrained("tn34")
    assert "tn34.safetensors" in str(fault.value) and text in str(fault.value), fault.value
