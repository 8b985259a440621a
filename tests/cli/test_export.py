"""pnet-export: the file, its card, and what is refused."""

import json
import re
import shutil
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import pytest

from pnet.cli.bundle_notes import about, evaluations
from pnet.cli.settings import read_run
from pnet.engine.bundle import read_bundle, write_bundle
from pnet.engine.predictions import read_predictions, write_predictions
from pnet.reporting.model_card import TITLE
from pnet.scenes.manifest import settings_fingerprint


@pytest.fixture(scope="module")
def made(smoke, tmp_path_factory, run_process) -> Path:
    folder = tmp_path_factory.mktemp("made")
    outcome = run_process(
        smoke.folder, "export", "run=outputs/run", f"output={folder}/tn34.safetensors", "card=true"
    )
    assert outcome.code == 0 and f"its card: {folder}/tn34.md" in outcome.out, outcome
    return folder


def rows(card):
    """First cell → second cell of every table's row."""
    return dict(re.findall(r"^\| ([^|]+) \| ([^|]+) \|", card, re.MULTILINE))


def test_the_card_tells_of_the_file_and_of_its_run(smoke, made):
    assert sorted(path.name for path in made.iterdir()) == ["tn34.md", "tn34.safetensors"]
    card, bundle = (made / "tn34.md").read_text(), read_bundle(made / "tn34.safetensors")
    found, metrics = rows(card), json.loads((smoke.run / "metrics.json").read_text())
    assert card.startswith(f"{TITLE}TN34\n")
    assert found["SHA-256"] == f"`{sha256((made / 'tn34.safetensors').read_bytes()).hexdigest()}`"
    assert found["learnt parameters"] == f"{metrics['network']['parameters']:,}"
    assert found["numbers in the file"] == f"{sum(w.numel() for w in bundle.weights.values()):,}"
    assert found["points of a scene"] == "512" and found["protocol"] == "smoke"
    assert found["scenes"] == "train 12, val 3, test_l 3, test_g 3"
    assert found["camera"] == "160 × 128 pixels, fx 375, fy 375, cx 79.5, cy 63.5"
    assert found["steps"] == "4" and found["scenes drawn in all"] == f"{4 * batch_size(smoke):,}"
    assert found["seed"] == "0" and found["precision"] == metrics["precision"]


def batch_size(smoke):
    return read_run(smoke.run).data.batch_size


def test_the_figures_are_those_of_the_evaluation(smoke, made):
    scored = json.loads((smoke.run / "evaluation" / "test_l" / "metrics.json").read_text())
    scored.pop("predictions")
    data = settings_fingerprint(json.loads((smoke.data / "dataset.json").read_text()))
    expected = {"test_l": {"split": "test_l", "data": data, **scored}}
    assert read_bundle(made / "tn34.safetensors").about["evaluations"] == expected
    found = rows((made / "tn34.md").read_text())
    assert found["Scenes"] == "3" and found["Bodies to find"] == str(round(scored["truths_to_find"]))


@pytest.mark.parametrize("file", ["metrics.json", "predictions.safetensors"])
def test_figures_of_other_predictions_are_not_told(smoke_copy, file):
    cfg, folder = read_run(smoke_copy.run), smoke_copy.run / "evaluation" / "test_l"
    assert set(evaluations(smoke_copy.run, cfg)) == {"test_l"}
    header, found = read_predictions(folder / "predictions.safetensors")
    if file == "metrics.json":
        (folder / file).write_text(json.dumps({"AP": 1, "predictions": "0" * 16}))
    else:  # scored, but of weights that the run had before
        write_predictions(folder / file, replace(header, weights="0" * 16), found)
        digest = sha256((folder / file).read_bytes()).hexdigest()[:16]
        (folder / "metrics.json").write_text(json.dumps({"AP": 1, "predictions": digest}))
    assert evaluations(smoke_copy.run, cfg) == {}


def test_what_training_noted_of_an_evaluation_is_kept_beside(smoke_copy):
    path = smoke_copy.run / "metrics.json"
    noted = {"test_g": {"AP": 0.25}, "test_l": {"AP": 0.5}}
    path.write_text(json.dumps({**json.loads(path.read_text()), "evaluations": noted}))
    scored = json.loads((smoke_copy.run / "evaluation" / "test_l" / "metrics.json").read_text())
    found = about(smoke_copy.run, read_run(smoke_copy.run))["evaluations"]
    assert found["test_g"] == {"AP": 0.25} and found["test_l"]["AP"] == scored["AP"]


def test_the_bundle_keeps_what_the_card_needs_and_no_paths(smoke, made):
    about = read_bundle(made / "tn34.safetensors").about
    manifest = json.loads((smoke.run / "dataset.json").read_text())
    assert {key: manifest[key] for key in about["data"]} == about["data"]
    assert about["training"]["data.batch_size"] == batch_size(smoke)
    assert set(about["data"]) >= {"protocol", "camera", "bin", "physics", "noise", "view", "files"}
    assert str(smoke.folder) not in json.dumps(dict(about)) and "root" not in json.dumps(dict(about))


def test_a_bundle_is_exported_again_to_the_byte_and_with_the_same_card(smoke, made, run_here, tmp_path):
    given = (f"run={made}/tn34.safetensors", f"output={tmp_path}/tn34.safetensors", "card=true")
    for _ in range(2):  # a card may be written over
        assert run_here(smoke.folder, "export", *given).code == 0
    for path in made.iterdir():
        assert (tmp_path / path.name).read_bytes() == path.read_bytes()


def test_a_bundle_of_before_has_a_card_with_fewer_lines(smoke, made, run_here, tmp_path):
    bundle = read_bundle(made / "tn34.safetensors")
    write_bundle(tmp_path / "old.pnet", replace(bundle, about={"steps": 7}))
    given = (f"run={tmp_path}/old.pnet", f"output={tmp_path}/new.pnet", "card=true", "licence=MIT")
    assert run_here(smoke.folder, "export", *given).code == 0
    card = (tmp_path / "new.md").read_text()
    assert rows(card)["steps"] == "7" and card.endswith("## Licence\n\nMIT.\n")
    assert "## Figures" not in card and "## Training data" not in card and "None" not in card


def test_another_camera_is_told_beside_the_trainings_own(smoke, made, run_here, tmp_path):
    given = (f"run={made}/tn34.safetensors", f"output={tmp_path}/x.safetensors", "card=true")
    assert run_here(smoke.folder, "export", *given, "camera=realsense_d435").code == 0
    card = (tmp_path / "x.md").read_text()
    assert "Without a camera: 848 × 480 pixels" in card
    assert rows(card)["camera"].startswith("160 × 128 pixels")
    assert "pnet-predict run=x.safetensors" in card and "part=tn34" not in card


def test_a_refinement_goes_into_the_file_and_the_figures_are_those_with_it(smoke_copy, run_here, tmp_path):
    fit = ("refine=surface", "postprocess.refine.sizes=[]", "postprocess.refine.steps=2")
    given = ("run=outputs/run", f"output={tmp_path}/x.safetensors", "card=true", *fit)
    folder = smoke_copy.folder
    assert run_here(folder, "export", *given).code == 0
    own = read_bundle(tmp_path / "x.safetensors").about["evaluations"]
    assert set(own) == {"test_l, not refined"}
    assert run_here(folder, "evaluate", "run=outputs/run", "split=test_l", *fit).code == 0
    assert run_here(folder, "export", *given).code == 0
    bundle = read_bundle(tmp_path / "x.safetensors")
    assert bundle.settings["postprocess"]["refine"]["steps"] == 2
    assert read_run(smoke_copy.run).postprocess.refine is None
    scored = [path for path in (smoke_copy.run / "evaluation").iterdir() if path.name != "test_l"]
    fitted, voted = (
        json.loads((path / "metrics.json").read_text())
        for path in (*scored, smoke_copy.run / "evaluation" / "test_l")
    )
    about = bundle.about["evaluations"]
    assert set(about) == {"test_l", "test_l, not refined"}
    assert fitted["mAP"] == about["test_l"]["mAP"] and voted["mAP"] == about["test_l, not refined"]["mAP"]
    card = (tmp_path / "x.md").read_text()
    assert rows(card)["refinement"] == "SurfaceFit" and "|  | test_l | test_l, not refined |" in card
    again = (f"run={tmp_path}/x.safetensors", f"output={tmp_path}/y.safetensors")
    assert run_here(folder, "export", *again).code == 0
    assert (tmp_path / "y.safetensors").read_bytes() == (tmp_path / "x.safetensors").read_bytes()
    assert "x.safetensors: refine= changes what" in run_here(folder, "export", *again, "refine=none").error


def test_without_card_there_is_none(smoke, run_here, tmp_path):
    assert run_here(smoke.folder, "export", "run=outputs/run", f"output={tmp_path}/x.pnet").code == 0
    assert [path.name for path in tmp_path.iterdir()] == ["x.pnet"]


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (["output=x.onnx"], "output=x.onnx: the file's name has to end in .pnet or .safetensors"),
        (["output=x.pnet", "card=maybe"], "card=maybe: expected true or false"),
        (["output=x.pnet", "card=true", "licence=null"], "licence=None: expected the name of a licence"),
        (["output=x.pnet", "run=nowhere"], "nowhere: no such bundle"),
        (["output=x.pnet", "carte=true"], "carte: unknown key"),
        (["output=x.pnet", "+postprocess.trust=null"], "postprocess.trust: pnet-export takes refine= alone"),
    ],
)
def test_mistakes_are_told_in_one_line(smoke_copy, run_here, words, error):
    run = [] if any(word.startswith("run=") for word in words) else ["run=outputs/run"]
    assert error in run_here(smoke_copy.folder, "export", *run, *words).error
    assert not list(smoke_copy.folder.glob("x.*"))


def test_a_page_that_is_no_card_is_not_written_over(smoke, run_here, tmp_path):
    (tmp_path / "README.md").write_text("# Mine\n")
    given = ("run=outputs/run", f"output={tmp_path}/README.safetensors", "card=true")
    assert (
        "README.md would be written over and is no model card"
        in run_here(smoke.folder, "export", *given).error
    )
    assert [path.name for path in tmp_path.iterdir()] == ["README.md"]


def test_a_run_whose_metrics_are_no_metrics_makes_no_card(smoke_copy, run_here, tmp_path):
    path = smoke_copy.run / "metrics.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "steps": "many"}))
    given = ("run=outputs/run", f"output={tmp_path}/x.pnet", "card=true")
    error = run_here(smoke_copy.folder, "export", *given).error
    assert "x.pnet: what it says of its training is not as pnet writes it" in error


def test_a_run_of_before_without_some_settings_is_exported(smoke_copy, run_here, tmp_path):
    """No evaluation, no notes of precision, costs and machine."""
    metrics = json.loads((smoke_copy.run / "metrics.json").read_text())
    for key in ("precision", "network"):
        metrics.pop(key)
    (smoke_copy.run / "metrics.json").write_text(json.dumps(metrics))
    (smoke_copy.run / "provenance.json").write_text("{}")
    shutil.rmtree(smoke_copy.run / "evaluation")
    given = ("run=outputs/run", f"output={tmp_path}/x.pnet", "card=true")
    assert run_here(smoke_copy.folder, "export", *given).code == 0
    card = (tmp_path / "x.md").read_text()
    assert "From the last validation in the training" in card and "machine" not in rows(card)
    assert rows(card)["precision"] == str(read_run(smoke_copy.run).trainer.precision)
    assert "learnt parameters" not in rows(card)
