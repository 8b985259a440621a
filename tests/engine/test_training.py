"""Training repeats itself bit for bit, also across an interruption."""

from functools import partial
from types import SimpleNamespace

import lightning
import pytest
import torch

from pnet.backbones.pointnet2 import Level, PointNet2
from pnet.backbones.range_unet import RangeUNet
from pnet.data.augmentation import Augmentation
from pnet.data.module import SceneDataModule, Targets
from pnet.data.source import StoredData
from pnet.engine.callbacks import PoseValidation, SparingBar, Throughput
from pnet.engine.checkpoints import NAME, ResumableCheckpoint, read_checkpoint
from pnet.engine.method import NetworkMethod
from pnet.engine.precision import Precision
from pnet.engine.schedules import WarmupCosine
from pnet.engine.training import PoseTraining
from pnet.models.losses import ParametricLoss
from pnet.models.parametricnet import ParametricNet
from pnet.postprocess.cluster import CentroidClusters
from pnet.postprocess.folded_vote import FoldedVote
from pnet.postprocess.pipeline import PoseRecovery
from pnet.postprocess.vote import MeanVote

EPOCH_STEPS, EPOCHS = 3, 3


def pointnet2():
    return PointNet2([Level(32, 0.03, 8, [8]), Level(8, 0.06, 8, [16])], [[16], [16]])


def range_unet():
    return RangeUNet([8, 8], 0.004, 0.6, 0.02, 12)


class CutError(Exception):
    """Stands for whatever ends a training."""


class InterruptAt(lightning.Callback):
    def __init__(self, step):
        self._step = step

    def on_train_batch_end(self, trainer, *_):
        if trainer.global_step == self._step:
            raise CutError


@pytest.fixture(scope="module")
def root(tmp_path_factory, tn34, write_split):
    root = tmp_path_factory.mktemp("data")
    for split in ("train", "val"):
        write_split(root, tn34, split, points=64)
    return root


def fit(
    root,
    part,
    folder,
    backbone,
    seed=0,
    interrupt=None,
    resume=False,
    identity="one",
    extra=(),
    rule="camera",
    compiled=False,
    bar=False,
):
    """Train for nine steps of two scenes; a checkpoint every three."""
    lightning.seed_everything(seed, verbose=False)
    network = ParametricNet(backbone(), 3, [8], [8], 0.02, True)
    optimizer = partial(torch.optim.AdamW, lr=0.003)
    schedule, loss = WarmupCosine(0.1, 0.01), ParametricLoss(part, "each")
    belongs = {"backbone": identity}
    module = PoseTraining(network, loss, optimizer, schedule, Precision.FLOAT32, belongs, compiled)
    data = SceneDataModule(
        part, StoredData(root), Targets(rule), Augmentation(True, 1e-4), None, 2, 2 * EPOCH_STEPS, 1, 0, seed
    )
    voting = FoldedVote(16, 32, 25.0, 3.0) if rule == "point" else MeanVote()
    recovery = PoseRecovery(CentroidClusters(0.01, 2, 4), None, voting, 0.0, False, 0.9, None)
    validation = PoseValidation(NetworkMethod(part, network, recovery), data.scenes("val"), None, 0)
    callbacks = [validation, ResumableCheckpoint(folder), *extra]
    callbacks += [InterruptAt(interrupt)] if interrupt else []
    trainer = lightning.Trainer(
        accelerator="cpu",
        max_epochs=EPOCHS,
        check_val_every_n_epoch=1,
        callbacks=callbacks,
        logger=False,
        enable_progress_bar=bar,
        enable_model_summary=False,
        num_sanity_val_steps=0,
    )
    trainer.fit(module, datamodule=data, ckpt_path=folder / NAME if resume else None, weights_only=True)
    return SimpleNamespace(weights=network.state_dict(), trainer=trainer, data=data)


def test_the_bar_reads_the_losses_only_where_it_draws_them(root, tn34, tmp_path, monkeypatch):
    """On a GPU each reading waits until the step is done."""
    reads = []

    def counted(read):
        return lambda tensor: (reads.append(1), read(tensor))[1]

    for name in ("item", "__float__"):
        monkeypatch.setattr(torch.Tensor, name, counted(getattr(torch.Tensor, name)))
    spent = {}
    for refresh in (None, 3, 1):
        reads.clear()
        bar = [] if refresh is None else [SparingBar(refresh)]
        fit(root, tn34, tmp_path / str(refresh), pointnet2, extra=bar, bar=bool(bar))
        spent[refresh] = len(reads)
    assert spent[3] - spent[None] <= 20 < spent[1] - spent[None]


@pytest.mark.parametrize("backbone", [pointnet2, range_unet])
def test_a_compiled_network_is_trained_to_the_same_weights(root, tn34, tmp_path, backbone, monkeypatch):
    """Without the code generator, which needs a C++ compiler: what it is given is one whole graph."""
    whole = partial(torch.compile, backend="aot_eager", fullgraph=True)
    plain = fit(root, tn34, tmp_path / "plain", backbone)
    monkeypatch.setattr(torch, "compile", whole)
    compiled = fit(root, tn34, tmp_path / "compiled", backbone, compiled=True)
    assert compiled.weights.keys() == plain.weights.keys()
    for name, value in plain.weights.items():
        torch.testing.assert_close(compiled.weights[name], value, rtol=1e-4, atol=1e-6)
    names = (read_checkpoint(tmp_path / run / NAME)["state_dict"].keys() for run in ("plain", "compiled"))
    assert next(names) == next(names)


def equal(one: dict, other: dict) -> bool:
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize("backbone", [pointnet2, range_unet])
def test_the_same_seed_gives_the_same_bits_also_after_an_interruption(root, tn34, tmp_path, backbone):
    whole = fit(root, tn34, tmp_path / "whole", backbone)
    assert whole.trainer.global_step == 9
    assert equal(whole.weights, fit(root, tn34, tmp_path / "again", backbone).weights)
    # after step 5: the last checkpoint is that of step 3
    with pytest.raises(CutError):
        fit(root, tn34, tmp_path / "cut", backbone, interrupt=5)
    assert read_checkpoint(tmp_path / "cut" / NAME)["global_step"] == 3
    resumed = fit(root, tn34, tmp_path / "cut", backbone, resume=True)
    assert resumed.trainer.global_step == 9
    assert equal(whole.weights, resumed.weights)
    first, last = (read_checkpoint(tmp_path / name / NAME) for name in ("whole", "cut"))
    assert equal(first["state_dict"], last["state_dict"])
    moments = [c["optimizer_states"][0]["state"] for c in (first, last)]
    assert all(equal(moments[0][i], moments[1][i]) for i in moments[0])


def test_another_seed_gives_other_weights_seed_zero_included(root, tn34, tmp_path):
    runs = [fit(root, tn34, tmp_path / str(seed), pointnet2, seed) for seed in (0, 1)]
    assert not equal(runs[0].weights, runs[1].weights)


def test_a_checkpoint_of_another_network_is_refused(root, tn34, tmp_path):
    fit(root, tn34, tmp_path, pointnet2)
    with pytest.raises(ValueError, match="the checkpoint's backbone is 'one', this configuration's is 'two'"):
        fit(root, tn34, tmp_path, pointnet2, resume=True, identity="two")


def test_checkpoints_leave_no_temporary_file(root, tn34, tmp_path, monkeypatch):
    fit(root, tn34, tmp_path, pointnet2)
    assert [path.name for path in tmp_path.iterdir()] == [NAME]
    before = (tmp_path / NAME).read_bytes()

    def full(self, path, **_):
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(lightning.Trainer, "save_checkpoint", full)
    with pytest.raises(OSError, match="No space left"):
        fit(root, tn34, tmp_path, pointnet2, seed=1)
    assert [path.name for path in tmp_path.iterdir()] == [NAME]
    assert (tmp_path / NAME).read_bytes() == before


def test_losses_and_poses_of_validation_are_logged(root, tn34, tmp_path):
    metrics = fit(root, tn34, tmp_path, pointnet2).trainer.callback_metrics
    for name in ("train/loss", "val/loss", "val/AP", "val/MAP", "val/mAP"):
        assert 0 <= float(metrics[name]) < 1e6
    for stage in ("train", "val"):
        for term in ("centroid", "keypoints", "parameters", "visibility"):
            assert f"{stage}_loss/{term}" in metrics
    shares = {name: float(metrics[f"ambiguous_labels/{name}"]) for name in tn34.chain.names}
    assert shares["base"] == shares["top"] == 0 and 0 <= shares["rim"] <= 1


@pytest.mark.parametrize("rule", ["canonical", "point"])
def test_every_rule_trains_and_is_validated(root, tn34, tmp_path, rule):
    metrics = fit(root, tn34, tmp_path, pointnet2, rule=rule).trainer.callback_metrics
    assert 0 < float(metrics["train/loss"]) < 1e6 and 0 <= float(metrics["val/AP"]) <= 1
    if rule == "canonical":
        assert all(float(metrics[f"ambiguous_labels/{name}"]) == 0 for name in tn34.chain.names)


def test_training_learns(root, tn34, tmp_path):
    losses = []

    class Record(lightning.Callback):
        def on_train_batch_end(self, trainer, module, outputs, batch, index):
            losses.append(float(outputs["loss"]))

    fit(root, tn34, tmp_path, pointnet2, extra=[Record()])
    assert len(losses) == 9 and sum(losses[-3:]) < sum(losses[:3])


@pytest.mark.parametrize("every, rates", [(1, [6, 4, 6]), (2, [12 / 2.5]), (3, [18 / 3.5])])
def test_throughput_counts_scenes_and_leaves_validation_out(monkeypatch, every, rates):
    times = iter([10.0, 11.0, 12.5, 100.0, 101.0])
    monkeypatch.setattr("pnet.engine.callbacks.perf_counter", lambda: next(times))
    logged = []
    module = SimpleNamespace(log=lambda name, value, **_: logged.append(value))
    batch = SimpleNamespace(points=torch.zeros(6, 1, 3))
    throughput, trainer = Throughput(), SimpleNamespace(world_size=1, log_every_n_steps=every)
    for step in (1, 2, 3):
        throughput.on_train_batch_start(trainer, module)  # the third at 100: the pause does not count
        trainer.global_step = step
        throughput.on_train_batch_end(trainer, module, None, batch, step - 1)
        if step == 2:
            throughput.on_validation_start(trainer, module)
    assert throughput.scenes == 18 and throughput.seconds == pytest.approx(3.5)
    assert logged == pytest.approx(rates)


def test_throughput_goes_on_from_a_checkpoint_and_counts_every_process(monkeypatch):
    times = iter([0.0, 2.0])
    monkeypatch.setattr("pnet.engine.callbacks.perf_counter", lambda: next(times))
    module = SimpleNamespace(log=lambda *_, **__: None)
    trainer = SimpleNamespace(world_size=3, global_step=1, log_every_n_steps=10)
    throughput = Throughput()
    throughput.load_state_dict({"scenes": 10, "seconds": 4.0})
    throughput.on_train_batch_start(trainer, module)
    throughput.on_train_batch_end(trainer, module, None, SimpleNamespace(points=torch.zeros(2, 1, 3)), 0)
    assert throughput.state_dict() == {"scenes": 16, "seconds": 6.0}
