"""pnet-data's conversion and exports, and results for benchmarks, on the small run."""

import json
from pathlib import Path

import numpy as np
import pytest

from pnet.data.source import StoredData
from pnet.metrics.sileane_results import score_folder

ONE_SIZE = ("part=tn34", "part.learning={r: [12], h: [10]}", "part.generalization=null")


@pytest.fixture(scope="module")
def exported(smoke, tmp_path_factory, run_process) -> Path:
    """The Siléane folder of the small run's test_l."""
    folder = tmp_path_factory.mktemp("exported")
    outcome = run_process(
        smoke.folder, "data", "export", f"root={smoke.data}", "split=test_l", f"output={folder}"
    )
    assert outcome.code == 0 and "3 scenes: " in outcome.out, outcome
    return folder / "test_l" / "tn34_0"


def test_an_export_holds_the_bin_and_every_scene(exported):
    assert {path.name for path in exported.iterdir()} >= {
        "depth", "depth_gt", "segmentation", "gt", "mesh.ply", "poseutils.json", "camera_params.txt",
    }  # fmt: skip
    names = sorted(path.stem for path in (exported / "depth").iterdir())
    assert names == [f"tn34_2_00{i}" for i in range(4)]
    assert sorted(path.stem for path in (exported / "gt").iterdir()) == names[1:]


def test_what_was_exported_is_converted_back(smoke, exported, run_here, tmp_path, tn34):
    size = json.loads((exported / "parameters.json").read_text())
    one = f"part.learning={{r: [{1000 * size['r']:g}], h: [{1000 * size['h']:g}]}}"
    words = (
        "convert", "part=tn34", one, "part.generalization=null", "data=sileane", f"data.root={exported}",
        "data.source.points=512", f"root={tmp_path}/store", "workers=0",
    )  # fmt: skip
    outcome = run_here(tmp_path, "data", *words)
    assert outcome.code == 0, outcome
    assert "3 scenes written" in outcome.out and "100% of the points fall on their own body" in outcome.out
    first = StoredData(smoke.data).scenes("test_l", tn34)
    again = StoredData(tmp_path / "store").scenes("test_l", tn34)
    for one, two in zip(first, again, strict=True):
        np.testing.assert_allclose(one.R, two.R, atol=1e-12)
        np.testing.assert_allclose(one.t, two.t, atol=1e-12)
        np.testing.assert_allclose(one.visibility, two.visibility)
        np.testing.assert_allclose(one.parameters, two.parameters, atol=1e-12)
    assert "0 scenes written" in run_here(tmp_path, "data", *words).out
    outcome = run_here(tmp_path, "data", f"root={tmp_path}/store", "action=verify")
    assert outcome.code == 0 and "0 piles checked" in outcome.out and "no fault" in outcome.out
    assert "converted" in run_here(tmp_path, "data", f"root={tmp_path}/store").out
    assert "was converted" in run_here(tmp_path, "data", f"root={tmp_path}/store", "action=repair").error


def test_a_bop_export_numbers_scenes_and_objects(smoke, run_here, tmp_path):
    outcome = run_here(
        smoke.folder,
        "data",
        "export",
        f"root={smoke.data}",
        "layout=bop",
        f"output={tmp_path}",
    )
    assert outcome.code == 0, outcome
    assert sorted(path.name for path in tmp_path.iterdir() if path.is_dir()) == [
        "models", "test_g", "test_l", "train", "val",
    ]  # fmt: skip
    assert (tmp_path / "test_g" / "test_g" / "000000" / "scene_gt.json").is_file()
    truth = json.loads((tmp_path / "test_l" / "000002" / "scene_gt.json").read_text())
    assert [len(truth[str(i)]) for i in (1, 2, 3)] == [1, 2, 3] and truth["1"][0]["obj_id"] == 1
    assert (tmp_path / "models" / "obj_000001.ply").is_file()


def test_results_of_an_evaluation_score_the_same_as_in_pnet(smoke_copy, exported, run_here, tmp_path):
    outcome = run_here(smoke_copy.folder, "evaluate", "run=outputs/run", f"results={tmp_path}", "threads=1")
    assert outcome.code == 0, outcome
    metrics = json.loads((smoke_copy.run / "evaluation" / "test_l" / "metrics.json").read_text())
    scored = score_folder(exported, tmp_path / "tn34_0", exported / "poseutils.json")
    for name in ("AP", "MAP", "F1"):
        assert scored[name] == pytest.approx(metrics[name], abs=1e-9)
    rows = (tmp_path / "bop.csv").read_text().splitlines()
    assert rows[0] == "scene_id,im_id,obj_id,score,R,t,time" and len(rows) == 1 + metrics["results"]


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (["convert", "root=x"], "action=convert needs part="),
        (["convert", "root=x", *ONE_SIZE, "data=sileane"], "data.root is missing: give data.root="),
        (["convert", "root=x", *ONE_SIZE, "data=sileane", "data.root=nowhere"], "nowhere"),
        (["convert", "root=x", *ONE_SIZE, "data=ipa", "data.root=nowhere"], "nowhere"),
        (["convert", "root=x", "part=tn06", "data=parametric", "data.root=nowhere"], "nowhere"),
        (["export", "root={data}"], "action=export needs output="),
        (
            ["export", "root={data}", "output=y", "layout=bob"],
            "layout=bob: no such layout, did you mean bop?",
        ),
        (["export", "root={data}", "output=y", "split=test"], "split=test: "),
        (["converted", "root={data}"], "converted"),
    ],
)
def test_mistakes_are_told_in_one_line(smoke, run_here, tmp_path, words, error):
    outcome = run_here(
        tmp_path, "data", *[word.format(data=smoke.data) if "{data}" in word else word for word in words]
    )
    assert outcome.code != 0 and error in outcome.err
    assert "Traceback" not in outcome.err
    assert not (tmp_path / "x").exists() and not (tmp_path / "y").exists()


@pytest.mark.parametrize("data", ["sileane", "ipa", "parametric"])
def test_training_names_the_missing_folder(hydra_app, run_here, tmp_path, data):
    part = "tn06" if data == "parametric" else "gear"
    outcome = run_here(
        tmp_path, "train", f"part={part}", "protocol=smoke", f"data={data}", "data.root=nowhere"
    )
    assert "nowhere" in outcome.error
    assert "data.root is missing" in run_here(tmp_path, "train", f"data={data}", "protocol=smoke").error
