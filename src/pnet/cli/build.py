"""Objects out of a config: what training and evaluation share."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from pnet.cli.instantiate import instantiate
from pnet.data.module import SceneDataModule
from pnet.models.parametricnet import ParametricNet
from pnet.parts.base import ParametricPart
from pnet.parts.choice import KeypointRule
from pnet.postprocess.pipeline import PoseRecovery
from pnet.postprocess.vote import MeanVote

if TYPE_CHECKING:
    from pnet.engine.estimator import NetworkEstimator

CONFIG = "config.yaml"  # a run's settings as they were given, interpolations and all
UNLEARNT = ("learning", "generalization", "sections")  # keys of a part that weights don't depend on
RESOLVED = "resolved.yaml"  # the same, resolved: what evaluation reads


@dataclass(frozen=True)
class Parts:
    """The pieces of a run."""

    part: ParametricPart
    network: ParametricNet
    recovery: PoseRecovery


def build_parts(cfg: DictConfig) -> Parts:
    """Part, network and recovery of a config; the network's weights are drawn from its seed."""
    torch.manual_seed(cfg.seed)
    part: ParametricPart = instantiate(cfg.part)
    recovery: PoseRecovery = instantiate(cfg.postprocess)
    if cfg.data.targets.rule == KeypointRule.POINT and isinstance(recovery.voting, MeanVote):
        raise ValueError(
            "data.targets.rule=point teaches the points of a body different equivalents of a keypoint, and "
            "postprocess.voting takes plain means of them: use postprocess=folded"
        )
    backbone = instantiate(cfg.backbone)
    network = instantiate(cfg.model, backbone=backbone, keypoints=len(part.chain))
    return Parts(part, network.to(memory_format=torch.channels_last), recovery)


def build_data(cfg: DictConfig, parts: Parts) -> SceneDataModule:
    """The data module of a config; an epoch lasts from one checkpoint to the next."""
    return SceneDataModule(
        parts.part,
        cfg.data.root,
        instantiate(cfg.data.targets),
        instantiate(cfg.data.augmentation),
        cfg.data.points,
        cfg.data.batch_size,
        cfg.trainer.checkpoint_every * cfg.data.batch_size,
        cfg.data.val_every,
        cfg.data.workers,
        cfg.seed,
        parts.network.backbone.pyramid,
    )


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
    return {"part": instantiate(cfg.part).name, "points": str(cfg.data.points), **texts}


def device_of(accelerator: str) -> str:
    """ "cuda" or "cpu", by the setting trainer.accelerator and by what is there."""
    return "cuda" if torch.cuda.is_available() and accelerator in ("auto", "gpu", "cuda") else "cpu"


def use_bf16(precision: str, accelerator: str) -> bool:
    """Whether to run the network in bfloat16.

    Args:
        precision: "32", "bf16" or "auto": bf16 where the device multiplies it in hardware.
        accelerator: trainer.accelerator.
    """
    if precision not in ("32", "bf16", "auto"):
        raise ValueError(f"trainer.precision is {precision!r}, choose 32, bf16 or auto")
    if precision != "auto":
        return precision == "bf16"
    if device_of(accelerator) == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return bool(torch.cpu._is_avx512_bf16_supported())


def read_run(run: Path) -> DictConfig:
    """The resolved config of a run folder.

    Raises:
        FileNotFoundError, ValueError: where it is no run of pnet-train; names the file.
    """
    path = run / RESOLVED
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; give a folder that pnet-train made as run=")
    try:
        cfg = OmegaConf.load(path)
    except Exception as fault:  # yaml raises classes of its own
        raise ValueError(f"{path}: not readable ({' '.join(str(fault).split())})") from fault
    if not isinstance(cfg, DictConfig) or "part" not in cfg:
        raise ValueError(f"{path}: not the settings of a training")
    return cfg


def load_estimator(run: Path) -> tuple[DictConfig, "NetworkEstimator"]:
    """The trained estimator of a run folder, and its config."""
    from pnet.engine.checkpoints import NAME, read_checkpoint
    from pnet.engine.estimator import NetworkEstimator
    from pnet.engine.training import check_identity

    cfg = read_run(run)
    checkpoint = run / "checkpoints" / NAME
    content = read_checkpoint(checkpoint)
    try:
        check_identity(content, identity(cfg))
        parts = build_parts(cfg)
        prefix = "network."
        weights = {
            name.removeprefix(prefix): value
            for name, value in content["state_dict"].items()
            if name.startswith(prefix)
        }
        parts.network.load_state_dict(weights)
    except RuntimeError as fault:  # names or shapes of weights
        raise ValueError(
            f"{checkpoint}: its weights do not fit the network that this version of pnet builds, train again "
            f"({str(fault).splitlines()[0]})"
        ) from fault
    except (ValueError, OmegaConfBaseException) as fault:
        raise ValueError(f"{checkpoint}: {fault}") from fault
    network = parts.network.to(device_of(cfg.trainer.accelerator)).eval()
    bf16 = use_bf16(cfg.trainer.precision, cfg.trainer.accelerator)
    return cfg, NetworkEstimator(parts.part, network, parts.recovery, bf16)
