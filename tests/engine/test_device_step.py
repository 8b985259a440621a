"""A training step on a device is handed over whole: nothing in it waits for the device.

A GPU works through what it was given while Python prepares what comes next; a number that is read back, or a
constant that is copied to it, makes Python wait. The meta device holds no numbers, so what would read one
back fails there, without a GPU.
"""

from contextlib import nullcontext

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from pnet.cli.app import config_dir
from pnet.cli.build import build_parts
from pnet.cli.instantiate import instantiate
from pnet.records import Batch

BACKBONES = ["pointnet", "pointnet2", "pointnet2_msg", "pointnet2_delayed", "pointsift", "range_unet"]
READS = ("nonzero", "local_scalar", "unique", "bincount", "masked_select")
B, N = 2, 200


class NoWaiting(TorchDispatchMode):
    """Raises where an operation would read from the device, or take its input from the host's memory."""

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        result = operation(*args, **(kwargs or {}))
        given = [x for x in tree_leaves((args, kwargs)) if isinstance(x, torch.Tensor)]
        made = [x for x in tree_leaves(result) if isinstance(x, torch.Tensor)]
        kinds = {x.device.type for x in given}
        if "meta" in kinds and any(word in str(operation) for word in READS):
            raise AssertionError(f"{operation} reads a number back")
        host = any(x.device.type == "cpu" and x.ndim for x in given)  # numbers travel with a launch
        if host and (len(kinds) > 1 or any(x.device.type == "meta" for x in made)):
            raise AssertionError(f"{operation} copies to the device")
        return result


@pytest.fixture
def on_meta(monkeypatch):
    """What would make tensors of the host's numbers on the device, or list indices, is caught too."""

    fill, whole = torch.Tensor.new_tensor, torch.Tensor.__getitem__

    def filled(tensor, *numbers, **options):
        assert tensor.device.type != "meta", "a constant is copied to the device"
        return fill(tensor, *numbers, **options)

    def indexed(tensor, place):
        places = place if isinstance(place, tuple) else (place,)
        if tensor.device.type == "meta" and any(isinstance(p, list) for p in places):
            raise AssertionError("a list of indices is copied to the device")
        return whole(tensor, place)

    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())  # knows no such device
    monkeypatch.setattr(torch.Tensor, "new_tensor", filled)
    monkeypatch.setattr(torch.Tensor, "__getitem__", indexed)


def settings(*overrides: str) -> DictConfig:
    with initialize_config_dir(str(config_dir()), version_base="1.3"):
        cfg = compose("train", overrides=["protocol=demo", *overrides], return_hydra_config=True)
    HydraConfig.instance().set_config(cfg)
    return cfg


def empty_batch(parts, tables) -> Batch:
    m, k = len(parts.part.chain), parts.part.k

    def meta(*shape: int) -> torch.Tensor:
        return torch.empty(*shape, device="meta")

    return Batch(
        points=meta(B, N, 3),
        centroid=meta(B, N, 3),
        keypoints=meta(B, N, m, 3),
        margin=meta(B, N, m),
        parameters=meta(B, N, k),
        visibility=meta(B, N),
        scene=torch.empty(B, dtype=torch.int64, device="meta"),
        rotation=meta(B, N, 3, 3),
        scale=meta(B, 3, 3),
        tables=tables,
    )


@pytest.mark.parametrize("part", ["tn34", "tn06"])
@pytest.mark.parametrize("method", ["parametricnet", "pprnet"])
@pytest.mark.parametrize("backbone", BACKBONES)
def test_a_training_step_waits_for_nothing(on_meta, backbone, method, part):
    cfg = settings(f"part={part}", f"method={method}", f"backbone={backbone}")
    parts = build_parts(cfg)
    loss = instantiate(cfg.loss, part=parts.part)
    tables = None
    if parts.backbone.pyramid is None:  # a data loader finds them
        found = parts.backbone.tables(torch.rand(B, N, 3) + 0.5)
        tables = {name: table.to("meta") for name, table in found.items()}
    network = parts.network.to("meta")
    batch, optimizer = empty_batch(parts, tables), instantiate(cfg.optimizer)(network.parameters())
    loss(network(batch.points, batch.tables), batch)  # constants move once
    with NoWaiting():
        losses = loss(network(batch.points, batch.tables), batch)
        loss.remarks(batch)
        losses["loss"].backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 10.0)
        optimizer.step()
    assert all(p.grad is not None and p.grad.device.type == "meta" for p in network.parameters())


@pytest.mark.parametrize(
    "waits",
    [
        lambda x: x + torch.zeros(3).to("meta"),
        lambda x: x[x > 0],
        lambda x: float(x.sum()),
        lambda x: x.new_tensor([1.0, 2.0]),
        lambda x: x[[0, 1]],
        lambda x: x.nonzero(),
        lambda x: x.unique(),
        lambda x: x.cpu(),
    ],
)
def test_the_guard_guards(on_meta, waits):
    with pytest.raises((AssertionError, RuntimeError, NotImplementedError)), NoWaiting():
        waits(torch.zeros(3, device="meta"))
