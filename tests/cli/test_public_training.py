"""Trainings on public data sets in their authors' layouts, as the commands run them: Table II's protocol and
the paper's own data."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.conftest import load_part
from tests.data.public import ipa_writer, sileane_writer
from tests.data.public.conftest import take_picture
from tests.data.public.parametric_writer import make_pile, write_raw
from tests.data.public.parametric_writer import write_parameters as write_parametric

from pnet.engine.predictions import read_predictions
from pnet.geometry.camera import Camera
from pnet.metrics.sileane_results import score_folder

IPA = ipa_writer.window_camera(96, 72, 60, 90, 156.0)
SILEANE = Camera(96, 72, 156.0, 159.0, 48.9, 34.8, near=0.5, far=1.6)
LOOSE = ("postprocess.visibility_threshold=0", "postprocess.cluster.bandwidth=0.05")
SHORT = ("protocol=smoke", "trainer.threads=1", "data.batch_size=2")


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> Path:
    """Gears in IPA's layout, four cycles of two scenes, and in Siléane's, two cycles; a bin of nuts in the
    paper's."""
    root, gear = tmp_path_factory.mktemp("public"), load_part("gear")
    part = root / "ipa" / "Gear_part_1"
    ipa_writer.write_parameters(part, IPA)
    ipa_pictures = [take_picture(gear, IPA, bodies) for bodies in (3, 5)]
    for cycle in range(4):
        ipa_writer.write_depth(part, cycle, 0, IPA, ipa_pictures[0].floor)
        for p in ipa_pictures:
            ipa_writer.write_scene(part, cycle, len(p.t), IPA, p.depth, p.instance, p.R, p.t, p.occlusion)
    sileane_writer.write_camera(root / "sileane", SILEANE)
    for cycle in (1, 2):
        for bodies in (4, 6):
            p = take_picture(gear, SILEANE, bodies)
            name = f"gear_{cycle}_{bodies:03d}"
            sileane_writer.write_scene(
                root / "sileane", name, SILEANE, p.depth, p.instance, p.R, p.t, p.occlusion
            )
    for number, name in enumerate(("training_set", "training_set", "learning_test_set")):
        template = root / "parametric" / name / "TemplateNum06"
        pile = make_pile(load_part("tn06"), 4)
        write_parametric(template / "parameter.json", pile.camera)
        for drop in (2, 3, 4):
            write_raw(template, f"5_{drop:03d}", make_pile(load_part("tn06"), drop), cycle=number)
    return root


@pytest.fixture(scope="module")
def run(folders, run_process) -> Path:
    """A training on IPA with an evaluation on Siléane."""
    outcome = run_process(
        folders, "train", "part=gear", *SHORT, "data=ipa_sileane", "data.root=ipa", "data.test_root=sileane",
        "data.source.training.points=512", "data.source.tests.points=512",
        "data.source.training.val_cycles=1",
        "data.source.training.test_cycles=1", "evaluate=[test_l]", "run_dir=run", *LOOSE,
    )  # fmt: skip
    assert outcome.code == 0, outcome
    return folders / "run"


def test_training_on_one_set_and_testing_on_another_is_one_config(run):
    metrics = json.loads((run / "metrics.json").read_text())
    header, found = read_predictions(run / "evaluation" / "test_l" / "predictions.safetensors")
    assert header.scenes == [
        f"test_l/pile_000{cycle}_part_00/00{drop}" for cycle in (1, 2) for drop in (4, 6)
    ]
    assert len(found) == metrics["evaluations"]["test_l"]["scenes"] == 4
    manifest = json.loads((run / "dataset.json").read_text())
    assert manifest["training"]["source"] == "ipa" and manifest["tests"]["source"] == "sileane"
    assert manifest["training"]["scenes"] == {"test_l": 2, "train": 4, "val": 2}


def test_results_are_named_and_framed_as_the_benchmark_has_it(run, folders, run_here, tmp_path):
    outcome = run_here(folders, "evaluate", "run=run", f"results={tmp_path}", "threads=1")
    assert outcome.code == 0, outcome
    names = [f"gear_{cycle}_00{drop}.json" for cycle in (1, 2) for drop in (4, 6)]
    assert sorted(path.name for path in tmp_path.glob("*.json")) == names
    _, found = read_predictions(run / "evaluation" / "test_l" / "predictions.safetensors")
    assert sum(len(detections.score) for detections in found) > 0
    R, t = sileane_writer.camera_rotation(), np.array(sileane_writer.LOCATION)
    for name, detections in zip(names, found, strict=True):
        entries = json.loads((tmp_path / name).read_text())
        assert len(entries) == len(detections.score)
        for entry, own_R, own_t in zip(entries, detections.R, detections.t, strict=True):
            np.testing.assert_allclose(entry["R"], R @ own_R.numpy(), atol=1e-9)
            np.testing.assert_allclose(entry["t"], R @ own_t.numpy() + t, atol=1e-9)
    from pnet.data.poseutils import write_poseutils

    gear = load_part("gear")
    write_poseutils(tmp_path / "poseutils.txt", gear.pose_space(gear.part_object("L", 0)))
    scored = score_folder(folders / "sileane", tmp_path, tmp_path / "poseutils.txt")
    metrics = json.loads((run / "evaluation" / "test_l" / "metrics.json").read_text())
    assert scored["AP"] == pytest.approx(metrics["AP"], abs=1e-9)


def test_training_on_the_siléane_data_takes_splits_as_documented(folders, run_here):
    text = (Path(__file__).parents[2] / "docs" / "public_data.md").read_text(encoding="utf-8")
    documented = re.search(r"'(data\.source\.splits=[^']*)'", text)
    splits = documented.group(1).replace("[0]", "[1]", 2).replace("test_l: [1]", "test_l: [2]")
    outcome = run_here(
        folders, "train", "part=gear", *SHORT, "data=sileane", "data.root=sileane", "data.source.points=512",
        splits, "run_dir=sil",
    )  # fmt: skip
    assert outcome.code == 0, outcome
    assert json.loads((folders / "sil" / "dataset.json").read_text())["scenes"] == {
        "test_l": 2, "train": 2, "val": 2,
    }  # fmt: skip
    bundled = run_here(folders, "export", "run=sil", "output=sil.pnet")
    assert bundled.code == 0 and "camera kept" in bundled.out


def test_a_run_is_evaluated_and_reported_on_another_public_set(run, folders, run_here):
    words = (
        "data=sileane",
        "data.root=sileane",
        "data.source.points=512",
        "data.source.splits={test_l: [2]}",
    )
    outcome = run_here(folders, "evaluate", "run=run", *words, "threads=1")
    assert outcome.code == 0, outcome
    (folder,) = (run / "evaluation").glob("test_l_sileane_SileaneData-*")
    assert json.loads((folder / "metrics.json").read_text())["scenes"] == 2
    assert f"next: pnet-report run=run evaluation={folder.name} data=sileane" in outcome.out
    outcome = run_here(folders, "report", "run=run", f"evaluation={folder.name}", *words)
    assert outcome.code == 0 and (run / "report" / "report.html").is_file(), outcome
    error = run_here(folders, "report", "run=run", f"evaluation={folder.name}").error
    assert "is not the data that the predictions were made from" in error


def test_the_papers_data_trains_as_it_is_and_converted(folders, run_here):
    words = ("part=tn06", *SHORT, "data=parametric", "data.root=parametric", "data.source.points=512", *LOOSE)
    outcome = run_here(folders, "train", *words, "evaluate=[test_l]", "run_dir=raw")
    assert outcome.code == 0, outcome
    outcome = run_here(
        folders, "data", "convert", "part=tn06", "data=parametric", "data.root=parametric", "root=store",
        "data.source.points=512", "workers=0",
    )  # fmt: skip
    assert outcome.code == 0 and outcome.out.count("100% of the points fall on their own body") == 3, outcome
    outcome = run_here(
        folders,
        "train",
        "part=tn06",
        *SHORT,
        "data.root=store",
        "evaluate=[test_l]",
        "run_dir=stored",
        *LOOSE,
    )
    assert outcome.code == 0, outcome
    weights = [
        torch.load(folders / name / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]
        for name in ("raw", "stored")
    ]
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (("part=gear", "data=sileane", "data.root=sileane"), "split val has no cycles"),
        (("part=tn06", "data=ipa", "data.root=ipa"), "has 64 part objects"),
        (("part=gear", "data=ipa", "data.root=ipa", "views=random"), "use views=stored"),
        (("part=gear", "data=ipa", "data.root=ipa", "data.generate=[]"), "it needs data=stored"),
        (
            ("part=gear", "data=ipa", "data.root=ipa", "data.points=1024", "data.source.points=512"),
            "lower it",
        ),
    ],
)
def test_mistakes_are_told_in_one_line(folders, run_here, words, error):
    more = ("data.source.val_cycles=1", "data.source.test_cycles=1") if "data=ipa" in words else ()
    assert error in run_here(folders, "train", *SHORT, *words, *more, "run_dir=none").error
    assert not (folders / "none" / "checkpoints").exists()
