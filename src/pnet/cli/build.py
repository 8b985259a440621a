"""Objects out of a config: what training and evaluation share."""

from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from torch import nn

from pnet.backbones.base import Backbone
from pnet.cli.instantiate import instantiate
from pnet.cli.settings import is_trained, read_run
from pnet.data.module import SceneDataModule
from pnet.data.source import DataSource, StoredData
from pnet.ops.operators import KERNELS
from pnet.parts.base import ParametricPart
from pnet.parts.choice import KeypointRule
from pnet.postprocess.pipeline import PoseRecovery
from pnet.postprocess.vote import MeanVote
from pnet.scenes.workers import cores

if TYPE_CHECKING:
    from pnet.engine.method import Method, NetworkMethod, Recovery

AVERAGING = "pnet.postprocess.pose_average.PoseAveraging"
UNLEARNT = ("learning", "generalization", "sections")  # keys of a part that weights don't depend on


@dataclass(frozen=True)
class Parts:
    """The pieces of a run."""

    part: ParametricPart
    network: nn.Module
    backbone: Backbone
    recovery: "Recovery"


def build_parts(cfg: DictConfig) -> Parts:
    """Part, network and recovery of a config; the network's weights are drawn from its seed."""
    torch.manual_seed(cfg.seed)
    part = part_of(cfg)
    check_ablations(cfg)
    recovery = instantiate(cfg.postprocess)
    plain_means = isinstance(recovery, PoseRecovery) and isinstance(recovery.voting, MeanVote)
    if cfg.data.targets.rule == KeypointRule.POINT and plain_means:
        raise ValueError(
            "data.targets.rule=point teaches the points of a body different equivalents of a keypoint, and "
            "postprocess.voting takes plain means of them: use postprocess=folded"
        )
    if isinstance(recovery, PoseRecovery) and cfg.data.targets.rule != KeypointRule.POINT:
        recovery = recovery.without_lookalikes()  # other rules teach none
    if "loss" in cfg:  # a bundle of trained weights has none
        check_heads(cfg)
    backbone = instantiate(cfg.backbone)
    network = instantiate(
        cfg.model, backbone=backbone, keypoints=len(part.chain), parameters=len(part.parameter_names)
    )
    return Parts(part, network.to(memory_format=torch.channels_last), backbone, recovery)


def check_heads(cfg: DictConfig) -> None:
    """Raise ValueError where a head is used that the loss does not teach."""
    for head in ("sizes", "doubt"):
        if cfg.model.get(head) and head in cfg.loss and not cfg.loss[head]:
            raise ValueError(
                f"model.{head} is true and loss.{head} is {cfg.loss[head]}: the head would say anything; "
                f"give the loss a weight or set model.{head}=false"
            )


def check_ablations(cfg: DictConfig) -> None:
    """Raise ValueError where an ablation of ParametricNet's votes is asked of a method that has none."""
    for key in ("radius_filter", "voting"):
        if cfg.postprocess._target_ == AVERAGING and key in cfg.postprocess:
            raise ValueError(
                f"postprocess.{key}: {cfg.method.name} takes no votes for keypoints; ablation=no_rf and "
                "rule_point are ParametricNet's"
            )


def build_data(cfg: DictConfig, parts: Parts) -> SceneDataModule:
    """The data module of a config; an epoch lasts from one checkpoint to the next."""
    return SceneDataModule(
        parts.part,
        open_source(cfg.data),
        instantiate(cfg.data.targets),
        instantiate(cfg.data.augmentation),
        cfg.data.points,
        cfg.data.batch_size,
        cfg.trainer.checkpoint_every * cfg.data.batch_size,
        cfg.data.val_every,
        loader_workers(cfg.data.workers, cfg.trainer.accelerator, cfg.trainer.devices),
        cfg.seed,
        None if finds_tables_itself(parts.backbone, cfg.trainer.accelerator) else parts.backbone.tables,
        share("data.learn", cfg.data.learn),
        instantiate(cfg.views),
        instantiate(cfg.noise),
        None if cfg.data.clutter is None else share("data.clutter", cfg.data.clutter),
        device_of(cfg.trainer.accelerator) == "cuda",
    )


def finds_tables_itself(backbone: Backbone, accelerator: str) -> bool:
    """Whether neighbour tables are found where the network runs: a GPU with kernels outruns the loaders."""
    return backbone.pyramid is not None and device_of(accelerator) == "cuda" and bool(KERNELS["cuda"])


def loader_workers(setting: int | None, accelerator: str, devices: int = 1) -> int:
    """Loader processes: as many as set; by default some beside a GPU, none that would share a CPU's cores."""
    if setting is not None:
        return setting
    return min(max(cores() // devices, 1), 8) if device_of(accelerator) == "cuda" else 0


def open_source(data: DictConfig) -> DataSource:
    """The data set of the settings `data`: its root and source (null: pnet's own store)."""
    if data.get("source") is None:  # absent in runs of before
        return StoredData(Path(data.root))
    source: DataSource = instantiate(data.source)
    return source


def share(key: str, value: object) -> float:
    """A share such as 0.2 or 1/5, as a number. key: of the setting."""
    try:
        return float(Fraction(str(value)))
    except (ValueError, ZeroDivisionError, OverflowError):
        raise ValueError(f"{key} is {value!r}, expected a share, for instance 1/3") from None


def part_of(cfg: DictConfig) -> ParametricPart:
    """The part of a run's settings; made once, as it takes a while."""
    return _part(OmegaConf.to_yaml(cfg.part, resolve=True))


@lru_cache
def _part(settings: str) -> ParametricPart:
    node = OmegaConf.create(settings)
    assert isinstance(node, DictConfig)
    part: ParametricPart = instantiate(node)
    return part


def identity(cfg: DictConfig) -> dict[str, str]:
    """What weights belong to: part, network and labels, as text that can be compared."""
    part = {key: value for key, value in cfg.part.items() if key not in UNLEARNT}
    groups = {
        "declaration": OmegaConf.create(part),
        "backbone": cfg.backbone,
        "model": cfg.model,
        "targets": cfg.data.targets,
    }
    texts = {name: OmegaConf.to_yaml(node, resolve=True) for name, node in groups.items()}
    return {
        "part": part_of(cfg).name,
        "points": str(cfg.data.points),
        **texts,
    }


def device_of(accelerator: str) -> str:
    """ "cuda" or "cpu", by the setting trainer.accelerator and by what is there."""
    return "cuda" if torch.cuda.is_available() and accelerator in ("auto", "gpu", "cuda") else "cpu"


def load_method(run: Path, recovery: DictConfig, accelerator: str | None = None) -> "Method":
    """The method of a run folder.

    Args:
        run: made by pnet-train. recovery: settings of a network's post-processing.
        accelerator: where a network runs; None: as it was trained.
    """
    cfg = read_run(run)
    if not is_trained(cfg):
        method: Method = instantiate(cfg.method.estimator, part=part_of(cfg))
        return method
    weights = read_weights(run, cfg)
    return network_method(cfg, weights, recovery, str(run / "checkpoints"), accelerator)


def read_weights(run: Path, cfg: DictConfig) -> dict[str, torch.Tensor]:
    """The weights of a run's network by name; cfg: its settings, to which they must belong."""
    from pnet.engine.checkpoints import NAME, read_checkpoint
    from pnet.engine.training import check_identity

    checkpoint, prefix = run / "checkpoints" / NAME, "network."
    content = read_checkpoint(checkpoint)
    try:
        check_identity(content, identity(cfg))
    except (ValueError, OmegaConfBaseException) as fault:
        raise ValueError(f"{checkpoint}: {fault}") from fault
    state = content["state_dict"].items()
    return {name.removeprefix(prefix): value for name, value in state if name.startswith(prefix)}


def network_method(
    cfg: DictConfig,
    weights: dict[str, torch.Tensor],
    recovery: DictConfig,
    where: str,
    accelerator: str | None = None,
) -> "NetworkMethod":
    """A trained network with a post-processing.

    Args:
        cfg: the settings of its training. weights: of the network. recovery: settings of the post-processing.
        where: the weights come from, for errors. accelerator: where it runs; None: as it was trained.
    """
    from pnet.engine.method import NetworkMethod
    from pnet.engine.precision import Precision

    changed = cfg.copy()
    changed.postprocess = recovery
    try:
        parts = build_parts(changed)
        parts.network.load_state_dict(weights)
    except RuntimeError as fault:  # names or shapes of weights
        raise ValueError(
            f"{where}: its weights do not fit the network that this version of pnet builds, train again "
            f"({str(fault).splitlines()[0]})"
        ) from fault
    except (ValueError, OmegaConfBaseException) as fault:
        raise ValueError(f"{where}: {fault}") from fault
    accelerator = accelerator or cfg.trainer.accelerator
    device = device_of(accelerator)
    precision = Precision.of(cfg.trainer.precision, device)
    return NetworkMethod(parts.part, parts.network.to(device).eval(), parts.recovery, precision)
