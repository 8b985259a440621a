"""The whole job at protocol=smoke: what every command leaves behind, and what it refuses."""

import errno
import json
import os
import re
import shutil
import signal
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

from pnet.cli.evaluate import Evaluation, is_current
from pnet.cli.settings import read_run
from pnet.data.scene_folder import SceneFolder
from pnet.engine.checkpoints import read_checkpoint
from pnet.engine.predictions import read_predictions

METRICS = {
    *("AP", "MAP", "mAP", "F1", "recall_at_precision_99"),
    *("position_error_mm", "axis_error_deg", "parameter_error_mm"),
    *("true_positives", "false_positives", "truths_to_find", "results", "scenes"),
    *("network_seconds", "postprocess_seconds"),
}
TRAIN = ("protocol=smoke", "trainer.threads=1")


def making() -> tuple[str, ...]:
    """The settings of the small run's data."""
    return ("protocol=smoke", "camera.width=160", "camera.height=128", "camera.fx=375", "camera.fy=375",
            "camera.cx=79.5", "camera.cy=63.5")  # fmt: skip


def left_overs(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.name.endswith(".part")]


def snapshot(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


# what is there afterwards


def test_generate_made_every_cycle(smoke):
    files = {str(path.relative_to(smoke.data)) for path in smoke.data.rglob("*") if path.is_file()}
    made = {
        "dataset.json",
        *(f"train/{kind}_0000_part_{i:02d}.safetensors" for kind in ("pile", "clutter") for i in (0, 5)),
        "val/pile_0001_part_00.safetensors",
        "test_l/pile_0002_part_00.safetensors",
        "test_g/pile_0000_part_00.safetensors",
    }
    assert files == made | {f"piles/{name}" for name in made}
    assert json.loads((smoke.data / "dataset.json").read_text())["camera"]["width"] == 160
    out = smoke.outcomes["generate"].out
    assert "7 cycles made, 0 were there" in out and "scenes/s" in out


def test_scenes_are_as_the_protocol_says(smoke):
    scenes = SceneFolder(smoke.data, "test_l", "tn34")
    assert [scene_id.drop for scene_id in scenes.ids] == [1, 2, 3]
    assert all(scene.points.shape == (512, 3) for scene in scenes)


def test_generating_again_makes_nothing_anew(smoke, run_here):
    before = snapshot(smoke.data)
    outcome = run_here(smoke.folder, "generate", *making(), "workers=0")
    assert outcome.code == 0 and "0 cycles made, 7 were there" in outcome.out
    assert snapshot(smoke.data) == before


def test_a_run_keeps_its_settings_resolved_and_as_they_were_given(smoke):
    given, resolved = ((smoke.run / name).read_text() for name in ("config.yaml", "resolved.yaml"))
    assert "${" in given and "${" not in resolved
    cfg = OmegaConf.create(resolved)
    assert cfg.seed == 0 and cfg.trainer.steps == 4 and cfg.data.root == "outputs/data/tn34_smoke"


def test_a_run_keeps_its_provenance_and_metrics(smoke):
    state = json.loads((smoke.run / "provenance.json").read_text())
    assert state["seed"] == 0 and {"git", "packages", "python"} <= set(state)
    metrics = json.loads((smoke.run / "metrics.json").read_text())
    assert metrics["steps"] == 4 and metrics["scenes_per_second"] > 0
    assert 0 <= metrics["validation"]["AP"] <= 1 and metrics["validation"]["loss"] > 0


def test_metrics_are_written_last(smoke):
    written = (smoke.run / "metrics.json").stat().st_mtime_ns
    others = [p for p in smoke.run.rglob("*") if p.is_file() and not {"evaluation", "report"} & set(p.parts)]
    assert written == max(path.stat().st_mtime_ns for path in others)


def test_the_checkpoint_says_what_it_belongs_to(smoke):
    content = read_checkpoint(smoke.run / "checkpoints" / "last.ckpt")
    assert content["global_step"] == 4 and content["pnet"]["part"] == "tn34"
    assert "PointNet2" in content["pnet"]["backbone"]


def test_tensorboard_holds_what_is_watched(smoke):
    folders = {path.parent for path in (smoke.run / "tensorboard").rglob("events.*")}
    books = [EventAccumulator(str(folder)) for folder in folders]
    tags: dict[str, set[str]] = {}
    for book in books:
        book.Reload()
        for kind, names in book.Tags().items():
            if isinstance(names, list):
                tags.setdefault(kind, set()).update(names)
    scalars = tags["scalars"]
    for stage in ("train", "val"):
        assert f"{stage}/loss" in scalars
        assert {
            f"{stage}_loss/{term}" for term in ("centroid", "keypoints", "parameters", "visibility")
        } <= scalars
    assert {"val/AP", "val/MAP", "val/mAP", "val/F1", "final/AP_val", "train/scenes_per_second"} <= scalars
    assert any(name.startswith("lr") for name in scalars)
    assert "val/precision_recall" in tags["images"]
    assert any(name.startswith("val/points") for name in tags["tensors"])  # the mesh plugin's
    assert {"settings/text_summary", "precision_recall/tn34"} <= tags["tensors"]
    (book,) = books  # one folder: TensorBoard lists a run once
    start = book.summary_metadata["_hparams_/session_start_info"].plugin_data.content
    chosen = HParamsPluginData.FromString(start).session_start_info.hparams
    assert chosen["part"].string_value == "TN34" and chosen["steps"].number_value == 4
    assert chosen["visibility_module"].bool_value and chosen["learn"].string_value == "1"


def test_evaluation_leaves_predictions_curve_and_metrics(smoke):
    folder = smoke.run / "evaluation" / "test_l"
    metrics, curve = (json.loads((folder / name).read_text()) for name in ("metrics.json", "curve.json"))
    each = {"parameter_error_mm/r", "parameter_error_mm/h"}  # where anything was found
    assert set(metrics) - each == METRICS | {"predictions"} and metrics["scenes"] == 3
    assert (
        curve["recall"][0] == 0
        and curve["precision"][0] == 1
        and len(curve["recall"]) == len(curve["precision"])
    )
    header, found = read_predictions(folder / "predictions.safetensors")
    assert header.split == "test_l" and header.part == "tn34" and len(found) == len(header.scenes) == 3
    assert "AP" in smoke.outcomes["evaluate"].out


def test_a_score_of_other_predictions_is_not_current(smoke, tmp_path, monkeypatch):
    """As it is left where an evaluation ends between its two steps."""
    monkeypatch.chdir(smoke.folder)
    run = tmp_path / "run"
    shutil.copytree(smoke.run, run)
    evaluation, trained = Evaluation("test_l"), read_run(run)
    assert is_current(evaluation, run, trained)
    path = run / "evaluation" / "test_l" / "metrics.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "predictions": "0" * 16}))
    assert not is_current(evaluation, run, trained)


def test_the_report_is_one_page_that_loads_nothing(smoke):
    page = (smoke.run / "report" / "report.html").read_text()
    loads = re.findall(
        r"""<(?:script|link|img|iframe)[^>]*(?:src|href)\s*=\s*["']?(?!data:)([^"'\s>]+)""", page
    )
    assert not loads
    assert not re.findall(r"@import|url\(\s*['\"]?http", page)
    assert "Scatter3d" in page or "scatter3d" in page or "mesh3d" in page
    assert (smoke.run / "report" / "scene.png").read_bytes().startswith(b"\x89PNG")
    assert "report.html" in smoke.outcomes["report"].out


def test_nothing_half_written_is_left(smoke):
    assert not left_overs(smoke.folder)


# the two steps of evaluation


def test_scoring_again_gives_the_same_and_refuses_other_weights(smoke_copy, run_here):
    folder = smoke_copy.run / "evaluation" / "test_l"
    before = (folder / "metrics.json").read_bytes()
    assert run_here(smoke_copy.folder, "evaluate", "run=outputs/run", "stage=score").code == 0
    assert (folder / "metrics.json").read_bytes() == before
    path = smoke_copy.run / "checkpoints" / "last.ckpt"
    path.write_bytes(path.read_bytes() + b"\0")
    error = run_here(smoke_copy.folder, "evaluate", "run=outputs/run", "stage=score").error
    assert "its weights is" in error and "predict again with stage=all" in error


def test_other_settings_of_post_processing_lie_beside(smoke_copy, run_here):
    changes = ("run=outputs/run", "+postprocess.visibility_threshold=1.1", "split=val", "threads=1")
    assert run_here(smoke_copy.folder, "evaluate", *changes).code == 0
    folder = smoke_copy.run / "evaluation" / "val_visibility_threshold-1.1"
    assert json.loads((folder / "metrics.json").read_text())["results"] == 0
    error = run_here(smoke_copy.folder, "evaluate", "run=outputs/run", "+postprocess.visibility=1").error
    assert "visibility" in error


# what is refused: one line, exit code 1, nothing written

BAD_TRAINING = [
    (("data.points=1000",), "data.points is 1000, the stored scenes have 512"),
    (("data.root=nowhere",), "nowhere"),
    (("part=tn06", "data.root=outputs/data/tn34_smoke"), "shows tn34, not tn06; set part=tn34"),
    (("part.learning.r=[-1]",), "parameters must be positive"),
    (("trainer.precision=16",), "choose 32, tf32, bf16 or auto"),
    (("trainer.validate_every=3",), "must be a multiple of trainer.checkpoint_every"),
    (("trainer.steps=5",), "must be a multiple of trainer.checkpoint_every"),
    (("loss.norm=cubic",), "cubic"),
    (("data.batch_size=0",), "data.batch_size is 0"),
    (("data.targets.direction=[0,0,0]",), "targets.direction"),
    (("ckpt=last",), "there is no checkpoint"),
    (("ckpt=nowhere.ckpt",), "there is no checkpoint nowhere.ckpt"),
    (("backbone._target_=os.system",), "os.system is not allowed"),
]


@pytest.mark.parametrize(("overrides", "message"), BAD_TRAINING, ids=[" ".join(o) for o, _ in BAD_TRAINING])
def test_training_refuses_and_writes_nothing(smoke, run_here, tmp_path, overrides, message):
    outcome = run_here(smoke.folder, "train", *TRAIN, f"run_dir={tmp_path / 'bad'}", *overrides)
    assert message in outcome.error
    assert not (tmp_path / "bad").exists()


def test_an_empty_data_folder_is_named(smoke, run_here, tmp_path):
    (tmp_path / "empty" / "train").mkdir(parents=True)
    outcome = run_here(tmp_path, "train", *TRAIN, "data.root=empty", "run_dir=bad")
    assert "no scenes there; run pnet-generate" in outcome.error
    assert not (tmp_path / "bad").exists()


def test_a_begun_run_is_not_overwritten(smoke, run_here):
    before = snapshot(smoke.run)
    assert "add ckpt=last" in run_here(smoke.folder, "train", *TRAIN, "run_dir=outputs/run").error
    assert snapshot(smoke.run) == before


def test_going_on_with_another_backbone_is_refused_and_leaves_the_run_as_it_is(smoke_copy, run_here):
    before = snapshot(smoke_copy.run)
    changes = ("run_dir=outputs/run", "ckpt=last", "trainer.steps=8", "backbone=range_unet")
    assert "the checkpoint's backbone is" in run_here(smoke_copy.folder, "train", *TRAIN, *changes).error
    assert snapshot(smoke_copy.run) == before


def test_a_finished_run_is_left_alone_and_other_settings_are_named(smoke_copy, run_here):
    before = snapshot(smoke_copy.run)
    again = run_here(smoke_copy.folder, "train", *TRAIN, "run_dir=outputs/run", "ckpt=auto")
    assert again.code == 0 and "4 steps" in again.out
    other = run_here(smoke_copy.folder, "train", *TRAIN, "run_dir=outputs/run", "ckpt=auto", "seed=1")
    assert "holds a training with other settings: seed was 0, now 1" in other.error
    assert snapshot(smoke_copy.run) == before


def test_going_on_with_other_labels_or_data_is_refused(smoke_copy, run_here):
    going_on = ("train", *TRAIN, "run_dir=outputs/run", "ckpt=last", "trainer.steps=8")
    labels = run_here(smoke_copy.folder, *going_on, "data.targets.rule=canonical")
    assert "the checkpoint's targets is" in labels.error
    manifest = smoke_copy.data / "dataset.json"
    manifest.write_text(manifest.read_text().replace('"seed": 0', '"seed": 1'))
    assert "the checkpoint's data is" in run_here(smoke_copy.folder, *going_on).error


def test_a_run_killed_before_its_metrics_gets_them_when_it_goes_on(smoke_copy, run_here):
    metrics = smoke_copy.run / "metrics.json"
    before = json.loads(metrics.read_text())["validation"]
    metrics.unlink()
    outcome = run_here(smoke_copy.folder, "train", *TRAIN, "run_dir=outputs/run", "ckpt=last")
    assert outcome.code == 0
    after = json.loads(metrics.read_text())["validation"]
    assert after["loss"] == pytest.approx(before["loss"], rel=1e-6) and after["AP"] == before["AP"]


def test_half_generated_data_is_refused(smoke_copy, run_here):
    (smoke_copy.data / "train" / "pile_0000_part_05.safetensors").unlink()
    error = run_here(smoke_copy.folder, "train", *TRAIN, "run_dir=outputs/new").error
    assert "train: only 3 of 4 cycles are there; run pnet-generate again" in error
    assert not (smoke_copy.folder / "outputs" / "new").exists()


def test_the_first_step_alone_writes_predictions_only(smoke_copy, run_here):
    arguments = ("run=outputs/run", "split=test_g", "stage=predict", "threads=1")
    assert run_here(smoke_copy.folder, "evaluate", *arguments).code == 0
    folder = smoke_copy.run / "evaluation" / "test_g"
    assert [path.name for path in folder.iterdir()] == ["predictions.safetensors"]


def test_a_misspelt_post_processing_key_is_answered_with_close_ones(smoke, run_here):
    arguments = ("run=outputs/run", "+postprocess.trusty=0.1")
    error = run_here(smoke.folder, "evaluate", *arguments).error
    assert "postprocess.trusty: unknown key, did you mean trust" in error


@pytest.mark.parametrize("content", [b"", b"garble", None])
def test_a_damaged_checkpoint_is_named(smoke_copy, run_here, content):
    path = smoke_copy.run / "checkpoints" / "last.ckpt"
    path.write_bytes(path.read_bytes()[:-500] if content is None else content)
    for command, *arguments in (
        ("train", *TRAIN, "run_dir=outputs/run", "ckpt=last", "trainer.steps=8"),
        ("evaluate", "run=outputs/run"),
    ):
        assert (
            "last.ckpt: not a readable checkpoint" in run_here(smoke_copy.folder, command, *arguments).error
        )


def test_a_checkpoint_of_another_backbone_is_not_evaluated(smoke_copy, run_here):
    path = smoke_copy.run / "resolved.yaml"
    cfg = OmegaConf.load(path)
    cfg.backbone.levels[0].neighbours = 8
    OmegaConf.save(cfg, path)
    error = run_here(smoke_copy.folder, "evaluate", "run=outputs/run").error
    assert "last.ckpt: the checkpoint's backbone is" in error


def test_data_of_other_settings_is_not_mixed(smoke_copy, run_here):
    before = snapshot(smoke_copy.data)
    error = run_here(smoke_copy.folder, "generate", *making(), "workers=0", "seed=1").error
    assert "tn34_smoke/dataset.json" in error and "seed was 0, now 1" in error
    assert "Choose another data.root" in error
    error = run_here(smoke_copy.folder, "generate", *making(), "workers=0", "camera.near=0.2").error
    assert "camera.near was 0.3, now 0.2" in error and "Choose another data.root" in error
    assert snapshot(smoke_copy.data) == before


# two stages, several machines


def test_stages_and_shards_together_make_the_same_data(smoke, run_here, tmp_path, monkeypatch):
    """Piles first; then two machines render a half each, without a physics engine."""
    data, whole = tmp_path / "outputs" / "data" / "tn34_smoke", snapshot(smoke.data)
    error = run_here(tmp_path, "generate", *making(), "stage=render").error
    assert "piles/dataset.json: no data set there; run pnet-generate stage=simulate first" in error
    assert not list(tmp_path.rglob("*.json"))
    outcome = run_here(tmp_path, "generate", *making(), "workers=0", "stage=simulate")
    assert "7 cycles made, 0 were there; piles in" in outcome.out and "scenes/s" in outcome.out
    piles = {name: content for name, content in whole.items() if name.startswith("piles/")}
    assert finished(data) == piles

    monkeypatch.setattr("pnet.scenes.bullet.connect", None)
    made = 0
    for shard, cycles in (("1/2", 4), ("2/2", 3)):
        outcome = run_here(tmp_path, "generate", *making(), "workers=0", "stage=render", f"shard={shard}")
        assert f"{cycles} cycles made, 0 were there; data set in" in outcome.out, outcome
        made += cycles
        assert len(finished(data)) == len(piles) + 1 + made
    assert finished(data) == whole


def finished(folder: Path) -> dict[str, bytes]:
    """The files without locks."""
    return {name: content for name, content in snapshot(folder).items() if not name.endswith(".lock")}


def test_another_sets_piles_are_rendered_again_and_stay_as_they_are(smoke, run_here, tmp_path, monkeypatch):
    monkeypatch.setattr("pnet.scenes.bullet.connect", None)
    before = snapshot(smoke.data)
    again = (
        *making(),
        "workers=0",
        "data.root=near",
        f"data.piles={smoke.data}/piles",
        "view.distance=[0.6,0.6]",
    )
    outcome = run_here(tmp_path, "generate", *again)
    assert outcome.code == 0 and "the piles of 7 of these cycles were there" in outcome.out
    scenes, others = SceneFolder(tmp_path / "near", "train", "tn34"), SceneFolder(smoke.data, "train", "tn34")
    np.testing.assert_allclose(others[0].t - scenes[0].t, [[0, 0, 0.05]], atol=1e-12)
    assert snapshot(smoke.data) == before and not (tmp_path / "near" / "piles").exists()
    error = run_here(tmp_path, "generate", *again, "data.root=other", "clutter.spacing=0.7").error
    assert "clutter.spacing was 0.8, now 0.7" in error and "Choose another data.piles" in error


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("stage=both",), "stage=both: choose simulate, render, all"),
        (("shard=3/2",), "shard=3/2: expected a number and a count, from 1/8 to 8/8"),
        (("shard=2",), "shard=2: expected a number and a count"),
        (("noise_in=[train,test]",), "noise_in is ['train', 'test'], expected a list out of train, val"),
        (("noise_in=train",), "noise_in is train, expected a list out of train, val"),
        (("noise_in=null",), "noise_in is None, expected a list"),
        (("seed=-1",), "seed is -1, expected at least 0"),
        (("workers=abc",), "workers is 'abc', expected at least 0"),
        (("view.distance=0.65",), "view.distance is 0.65, expected [smallest, largest]"),
        (("clutter.spacing=abc",), "clutter.spacing is 'abc', expected at least 0"),
        (("noise=gaussian", "noise.sigma=null"), "noise.sigma is None, expected at least 0"),
        (("data.root=one", "data.piles=one"), "data.piles and data.root are both one"),
        (
            ("protocol=paper", "part=tless20", "protocol.drop_limit=5"),
            "for tless20 this protocol has its own; set protocol.by_part.tless20.drop_limit",
        ),
        (("protocol.dropping=twice",), "dropping is 'twice', choose one_by_one or anew"),
        (("physics.collision=mesh",), "physics.collision is 'mesh', choose filled, exact, hull"),
        (("view.tilt=[30,10]",), "view.tilt is [30, 10], expected [smallest, largest]"),
        (("clutter.density=0",), "clutter.density is 0, expected more than 0"),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_generation_refuses_and_writes_nothing(run_here, tmp_path, overrides, message):
    assert message in run_here(tmp_path, "generate", *making(), "workers=0", *overrides).error
    assert not list(tmp_path.iterdir())


def test_a_folder_of_scenes_is_not_taken_for_piles(smoke, run_here, tmp_path):
    before = snapshot(smoke.data)
    arguments = (*making(), "workers=0", "data.root=near", f"data.piles={smoke.data}")
    error = run_here(tmp_path, "generate", *arguments).error
    assert f"holds scenes; its piles are in {smoke.data}/piles" in error
    assert snapshot(smoke.data) == before and not (tmp_path / "near").exists()


def test_rendering_does_not_begin_where_piles_are_missing(smoke_copy, run_here):
    shutil.rmtree(smoke_copy.data / "train")
    gone = sorted((smoke_copy.data / "piles" / "train").iterdir())[:2]
    for path in gone:
        path.unlink()
    error = run_here(smoke_copy.folder, "generate", *making(), "workers=0", "stage=render").error
    assert f"{gone[0].name}: no such pile file, and 1 more are missing; run pnet-generate" in error
    assert not list((smoke_copy.data / "train").glob("*"))


def test_piles_of_other_settings_are_not_rendered(smoke_copy, run_here):
    """Another cycle's file in a cycle's place: whole, and yet not what it says."""
    one, other = sorted((smoke_copy.data / "piles" / "train").glob("pile*"))[:2]
    shutil.copy(other, one)
    (smoke_copy.data / "train" / one.name).unlink()
    error = run_here(smoke_copy.folder, "generate", *making(), "workers=0", "stage=render").error
    assert f"{one.name}: made with other settings; delete it and run stage=simulate" in error


def test_the_settings_of_another_set_leave_nothing_to_choose(smoke, run_here, tmp_path):
    like = f"like={smoke.data}/dataset.json"
    error = run_here(tmp_path, "generate", like, "data.root=again", "seed=3").error
    assert error.startswith("seed has no say beside like=")
    assert "say with data.root= where" in run_here(tmp_path, "generate", like).error
    old = json.loads((smoke.data / "dataset.json").read_text())
    del old["view"]
    (tmp_path / "old.json").write_text(json.dumps(old))
    error = run_here(tmp_path, "generate", "like=old.json", "data.root=again").error
    assert "old.json: made by an older pnet, it lacks 'view'; make the data anew" in error


def test_noise_is_not_added_twice(smoke_copy, run_here):
    """Scenes that were measured by a noisy sensor are not sent through another one."""
    noisy = ("noise=gaussian", "data.root=noisy", f"data.piles={smoke_copy.data}/piles", "workers=0")
    assert run_here(smoke_copy.folder, "generate", *making(), *noisy).code == 0
    train = (*TRAIN, "noise=gaussian", "data.root=noisy", "run_dir=outputs/twice")
    error = run_here(smoke_copy.folder, "train", *train).error
    assert "noisy: its scenes for training have a noise already; train with noise=none" in error


def test_predictions_of_other_data_are_refused(smoke_copy, run_here):
    manifest = smoke_copy.data / "dataset.json"
    manifest.write_text(manifest.read_text().replace('"seed": 0', '"seed": 1'))
    assert "its data is" in run_here(smoke_copy.folder, "evaluate", "run=outputs/run", "stage=score").error
    assert "evaluate again" in run_here(smoke_copy.folder, "report", "run=outputs/run").error


BAD_EVALUATION = [
    (("run=nowhere",), "nowhere/resolved.yaml: no such file; give a folder that pnet-train made"),
    (("run=outputs/run", "split=test_x"), "test_x"),
    (("run=outputs/run", "stage=some"), "choose predict, score or all"),
    (("run=outputs/run", "every=0"), "expected at least 1"),
    (("run=outputs/run", "data.root=nowhere"), "nowhere/dataset.json: no data set there"),
    (("run=outputs/run", "split=val", "stage=score"), "no predictions there"),
    ((), "run"),
]


@pytest.mark.parametrize(
    ("arguments", "message"), BAD_EVALUATION, ids=[" ".join(a) for a, _ in BAD_EVALUATION]
)
def test_evaluation_refuses(smoke, run_here, arguments, message):
    assert message in run_here(smoke.folder, "evaluate", *arguments).error


def test_a_run_without_a_checkpoint_is_named(smoke_copy, run_here):
    shutil.rmtree(smoke_copy.run / "checkpoints")
    error = run_here(smoke_copy.folder, "evaluate", "run=outputs/run").error
    assert "last.ckpt: no checkpoint there; train first with pnet-train" in error


def test_a_report_needs_an_evaluation(smoke_copy, run_here):
    assert (
        "val/metrics.json: no such file"
        in run_here(smoke_copy.folder, "report", "run=outputs/run", "evaluation=val").error
    )


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_on_a_full_disk_an_evaluation_keeps_what_was_there(smoke_copy, run_here, monkeypatch, call):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    before = snapshot(smoke_copy.folder)
    monkeypatch.setattr(os, call, full)
    assert "No space left on device" in run_here(smoke_copy.folder, "evaluate", "run=outputs/run").error
    assert snapshot(smoke_copy.folder) == before


def test_on_a_full_disk_generation_loses_nothing(smoke, run_here, tmp_path, monkeypatch):
    real, calls = os.fsync, []

    def full(descriptor):
        calls.append(descriptor)
        if len(calls) > 5:  # two manifests, a cycle's piles and scenes, the next one's piles fit
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(descriptor)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        error = run_here(tmp_path, "generate", *making(), "workers=0").error
    assert "No space left on device" in error and ".safetensors" in error
    data, whole = tmp_path / "outputs" / "data" / "tn34_smoke", snapshot(smoke.data)
    assert len(list(data.rglob("*.safetensors"))) == 3 and snapshot(data).items() <= whole.items()
    assert run_here(tmp_path, "generate", *making(), "workers=0").code == 0
    assert snapshot(data) == whole


def test_on_a_full_disk_training_keeps_the_last_checkpoint(smoke_copy, run_here, monkeypatch):
    real = os.replace

    def full(source, target):
        if Path(target).name == "last.ckpt":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(source, target)

    folder = smoke_copy.run / "checkpoints"
    before = snapshot(folder)
    monkeypatch.setattr(os, "replace", full)
    more = ("run_dir=outputs/run", "ckpt=last", "trainer.steps=8")
    assert "No space left on device" in run_here(smoke_copy.folder, "train", *TRAIN, *more).error
    assert snapshot(folder) == before
    assert not (smoke_copy.run / "metrics.json").exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_read_only_folder_is_named(smoke, run_here, tmp_path):
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    for command, *arguments in (
        ("generate", *making(), "workers=0", "data.root=locked/data"),
        ("train", *TRAIN, f"data.root={smoke.data}", "run_dir=locked/run"),
    ):
        assert "locked" in run_here(tmp_path, command, *arguments).error


def test_a_file_in_the_folders_place_is_named(smoke, run_here, tmp_path):
    (tmp_path / "taken").write_text("")
    for command, *arguments in (
        ("generate", *making(), "workers=0", "data.root=taken/data"),
        ("train", *TRAIN, f"data.root={smoke.data}", "run_dir=taken/run"),
    ):
        assert "taken" in run_here(tmp_path, command, *arguments).error


# Ctrl-C


def wait_for(condition, process, seconds=90.0):
    end = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.02)


def interrupt(process) -> tuple[int, list[str]]:
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    return process.returncode, err.strip().splitlines()


def test_ctrl_c_in_generation_and_the_same_command_goes_on(smoke, start, run_here, tmp_path):
    command = ("generate", *making(), "workers=1")
    process = start(tmp_path, *command)
    wait_for(lambda: any(tmp_path.rglob("pile*.safetensors")), process)
    code, lines = interrupt(process)
    assert (code, len(lines)) == (130, 1) and lines[0].startswith("interrupted"), (code, lines)
    data = tmp_path / "outputs" / "data" / "tn34_smoke"
    assert not left_overs(tmp_path)
    outcome = run_here(tmp_path, "generate", *making(), "workers=0")
    assert outcome.code == 0, outcome
    assert snapshot(data) == snapshot(smoke.data)


def test_ctrl_c_in_training_and_going_on_gives_the_same_weights(smoke, start, run_here, tmp_path):
    long = (*TRAIN, "trainer.steps=40", "trainer.validate_every=8", f"data.root={smoke.data}")
    cut = (*long, f"run_dir={tmp_path / 'cut'}")
    process = start(tmp_path, "train", *cut)
    wait_for((tmp_path / "cut" / "checkpoints" / "last.ckpt").exists, process)
    code, lines = interrupt(process)
    assert (code, len(lines)) == (130, 1) and lines[0].startswith("interrupted"), (code, lines)
    assert not left_overs(tmp_path)
    assert not (tmp_path / "cut" / "metrics.json").exists()
    reached = read_checkpoint(tmp_path / "cut" / "checkpoints" / "last.ckpt")["global_step"]
    assert 2 <= reached < 40
    assert run_here(tmp_path, "train", *cut, "ckpt=last").code == 0
    assert run_here(tmp_path, "train", *long, f"run_dir={tmp_path / 'whole'}").code == 0
    weights = [
        read_checkpoint(tmp_path / name / "checkpoints" / "last.ckpt")["state_dict"]
        for name in ("cut", "whole")
    ]
    assert weights[0].keys() == weights[1].keys()
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])
    assert json.loads((tmp_path / "cut" / "metrics.json").read_text())["steps"] == 40


# several runs at once


@pytest.mark.slow
def test_multirun_trains_one_after_another(smoke, run_here):
    outcome = run_here(
        smoke.folder, "train", "--multirun", "backbone=pointnet2_small,range_unet", *TRAIN, "data.workers=0"
    )
    assert outcome.code == 0, outcome
    runs = sorted(path.parent for path in (smoke.folder / "outputs" / "train").glob("*/metrics.json"))
    kinds = [OmegaConf.load(run / "resolved.yaml").backbone._target_.rsplit(".", 1)[-1] for run in runs]
    assert kinds == ["PointNet2", "RangeUNet"]


# a results folder in the benchmark's layout


def test_score_writes_three_numbers(run_here, tmp_path, tn34):
    from pnet.data.poseutils import write_poseutils

    pose = {"R": np.eye(3).tolist(), "t": [0.0, 0.0, 0.6]}
    far = {"R": np.eye(3).tolist(), "t": [0.1, 0.0, 0.6]}
    for name in ("gt", "results"):
        (tmp_path / name).mkdir()
    hidden = {"segmentation_id": 1, "occlusion_rate": 0.0}
    (tmp_path / "gt" / "0.json").write_text(json.dumps([{**pose, **hidden}, {**far, **hidden}]))
    (tmp_path / "gt" / "1.json").write_text(json.dumps([{**pose, **hidden}]))
    (tmp_path / "results" / "0.json").write_text(json.dumps([{**pose, "score": 0.9}]))
    write_poseutils(tmp_path / "poseutils.json", tn34.pose_space(tn34.part_object("L", 0)))
    arguments = ("truth=.", "results=results", "poseutils=poseutils.json")
    outcome = run_here(tmp_path, "score", *arguments, "output=new/score.json")
    # recall: half of the first scene, nothing of the second; precision 1
    expected = {"AP": pytest.approx(0.25), "MAP": pytest.approx(0.25), "F1": pytest.approx(0.4)}
    assert outcome.code == 0
    assert json.loads(outcome.out) == json.loads((tmp_path / "new" / "score.json").read_text()) == expected
    assert list(json.loads(outcome.out)) == ["AP", "MAP", "F1"]
    (tmp_path / "results" / "9.json").write_text("[]")
    assert "9.json: no ground truth of this name" in run_here(tmp_path, "score", *arguments).error
    assert "nowhere" in run_here(tmp_path, "score", "truth=nowhere", *arguments[1:]).error
