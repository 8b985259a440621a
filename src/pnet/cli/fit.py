"""A network's training: the Lightning trainer, checkpoints to go on from, and what is written beside them."""

import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from pnet.cli.settings import CONFIG, METRICS, RESOLVED, read_run, recipe_text, training_settings

if TYPE_CHECKING:
    import lightning

    from pnet.engine.callbacks import Throughput


NEEDED_ON_CUDA = "Triton, a C compiler (gcc) and Python's headers (python3-dev): install what is missing"


def fit(cfg: DictConfig, run: Path) -> dict[str, Any]:
    """Train the network; what came out of it, from metrics.json where the run has ended before."""
    import lightning
    import torch

    quiet_lightning()
    from pnet.cli.build import build_data, build_parts, device_of, identity
    from pnet.cli.instantiate import instantiate
    from pnet.engine.allocator import keep_freed_memory
    from pnet.engine.callbacks import PoseValidation, Throughput
    from pnet.engine.checkpoints import NAME, ResumableCheckpoint, read_checkpoint
    from pnet.engine.method import NetworkMethod
    from pnet.engine.precision import Precision
    from pnet.engine.provenance import read_json
    from pnet.engine.tensorboard import add_settings
    from pnet.engine.training import PoseTraining, check_identity
    from pnet.models.summary import summarise
    from pnet.ops.operators import has_toolkit
    from pnet.scenes.manifest import settings_fingerprint

    if cfg.trainer.threads is not None:
        torch.set_num_threads(cfg.trainer.threads)
    device = device_of(cfg.trainer.accelerator)
    if device == "cpu":
        keep_freed_memory()
    elif not has_toolkit(device):
        print(f"note: the GPU runs without pnet's kernels, many times slower; they need {NEEDED_ON_CUDA}")
    checkpoint = resume_from(cfg.ckpt, run / "checkpoints" / NAME)
    lightning.seed_everything(cfg.seed, workers=True, verbose=False)
    precision = Precision.of(cfg.trainer.precision, device)
    precision.set_products(device)
    parts = build_parts(cfg)
    data = build_data(cfg, parts)
    validation = data.scenes("val", cfg.data.val_every)
    data.train_dataloader()  # says now, before anything is written, what is wrong with the data
    module = PoseTraining(
        parts.network,
        instantiate(cfg.loss, part=parts.part),
        instantiate(cfg.optimizer),
        instantiate(cfg.schedule),
        precision,
        {**identity(cfg), "data": settings_fingerprint(data.source.manifest())},
        compiled(cfg.trainer),
    )
    throughput = Throughput()
    estimator = NetworkMethod(parts.part, parts.network, parts.recovery, precision)
    callbacks = [
        throughput,
        PoseValidation(estimator, validation, cfg.data.points, cfg.trainer.mesh_every),
        ResumableCheckpoint(run / "checkpoints"),
    ]
    trainer = build_trainer(cfg, run, callbacks)
    if checkpoint is not None:  # before the settings of the run are replaced
        check_identity(read_checkpoint(checkpoint), module.identity)
        if cfg.ckpt == "auto":
            check_same_settings(run, cfg)
        if is_finished(run, cfg.trainer.steps):
            return read_json(run / METRICS)  # evaluations keep the post-processing of the run
    if not is_helper():
        begin_run(cfg, run)
    full = validation[len(validation) - 1]  # cycles end with a full bin
    summary = summarise(parts.network, torch.from_numpy(full.points[: cfg.data.points]))
    if not is_helper():
        print(summary)
        add_settings(run / "tensorboard", OmegaConf.to_yaml(cfg, resolve=True))
    try:
        trainer.fit(module, datamodule=data, ckpt_path=checkpoint, weights_only=True)
    except SystemExit:  # what Lightning makes of Ctrl-C
        raise KeyboardInterrupt from None
    if "val/AP" not in trainer.callback_metrics:  # killed after the last step: validated but not written
        trainer.validate(module, datamodule=data, verbose=False)
    return {
        **final_metrics(trainer, throughput),
        "precision": str(precision),
        "recipe": recipe_text(training_settings(cfg)),
        "network": vars(summary),
    }


def compiled(trainer: DictConfig) -> bool:
    """Whether torch.compile makes the network's code; absent in the settings of earlier runs.

    Raises:
        ValueError: without what it needs.
    """
    from pnet.cli.build import device_of
    from pnet.ops.operators import has_toolkit

    if not trainer.get("compile"):
        return False
    if device_of(trainer.accelerator) == "cuda":
        if not has_toolkit("cuda"):
            raise ValueError(f"trainer.compile=true needs {NEEDED_ON_CUDA}, or leave it out")
    elif not any(map(shutil.which, (os.environ.get("CXX") or "g++", "g++", "clang++", "c++"))):
        raise ValueError("trainer.compile=true needs a C++ compiler on a CPU: install g++, or leave it out")
    return True


def is_helper() -> bool:
    """Whether Lightning started this process to train along with the first (trainer.devices > 1)."""
    return int(os.environ.get("LOCAL_RANK", "0")) > 0


def begin_run(cfg: DictConfig, run: Path) -> None:
    """Write what the run is made of; metrics.json of an earlier one goes."""
    from pnet.cli.build import open_source
    from pnet.engine.provenance import commit_text, provenance, write_json
    from pnet.scenes.manifest import MANIFEST
    from pnet.scenes.record_file import write_atomically

    data = open_source(cfg.data).manifest()
    run.mkdir(parents=True, exist_ok=True)
    (run / METRICS).unlink(missing_ok=True)
    write_json(run / MANIFEST, data)  # how the data was made, so that the folder is enough to repeat the run
    write_atomically(run / CONFIG, OmegaConf.to_yaml(cfg).encode())
    write_atomically(run / RESOLVED, OmegaConf.to_yaml(cfg, resolve=True).encode())
    state = provenance(cfg.seed)
    commit = commit_text(state["git"])
    before = earlier_commits(run) if (run / "checkpoints").is_dir() else []
    write_json(run / "provenance.json", {**state, "commits": list(dict.fromkeys([*before, commit]))})


def earlier_commits(run: Path) -> list[str]:
    """Of a training that goes on, the code versions that it has seen."""
    from pnet.engine.provenance import read_json

    try:
        return [str(commit) for commit in read_json(run / "provenance.json")["commits"]]
    except (OSError, ValueError, KeyError, TypeError):
        return []


def quiet_lightning() -> None:
    """Keep Lightning's advertisements and notes on its own internals off the screen."""
    import logging
    import warnings

    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    logging.getLogger("lightning.fabric").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", module="lightning.*")


def resume_from(ckpt: str | None, last: Path) -> Path | None:
    """The checkpoint to go on from, or None to begin; a begun run is not overwritten by mistake.

    Args:
        ckpt: None begins, "last" goes on, "auto" does what fits, anything else is a checkpoint's path.
        last: the run's own checkpoint.
    """
    if ckpt == "auto":
        ckpt = "last" if last.exists() else None
    if ckpt is None:
        if last.exists():
            raise ValueError(
                f"{last} is there already: add ckpt=last to go on with that training, or choose another "
                "run_dir, or delete that folder"
            )
        return None
    path = last if ckpt == "last" else Path(ckpt)
    if not path.is_file():
        raise FileNotFoundError(f"ckpt={ckpt}: there is no checkpoint {path}; leave ckpt out to begin")
    return path


def is_finished(run: Path, steps: int) -> bool:
    """Whether a run's training has ended after at least so many steps."""
    from pnet.engine.provenance import read_json

    path = run / METRICS
    return path.is_file() and int(read_json(path).get("steps") or 0) >= steps


def check_same_settings(run: Path, cfg: DictConfig) -> None:
    """Raise ValueError where a run was begun with other settings than these; names the first few."""
    from pnet.scenes.manifest import differences

    differing = sorted(differences(training_settings(read_run(run)), training_settings(cfg)))
    if differing:
        raise ValueError(
            f"{run}: holds a training with other settings: {'; '.join(differing[:4])}. "
            "Choose another run_dir, or delete that folder"
        )


def build_trainer(cfg: DictConfig, run: Path, callbacks: list["lightning.Callback"]) -> "lightning.Trainer":
    """The Lightning trainer: an epoch lasts from one checkpoint to the next."""
    import lightning
    from lightning.pytorch.callbacks import LearningRateMonitor
    from lightning.pytorch.loggers import TensorBoardLogger

    from pnet.cli.build import device_of
    from pnet.engine.callbacks import SparingBar

    options = cfg.trainer
    on_cpu = device_of(options.accelerator) == "cpu"
    if not isinstance(options.devices, int) or options.devices < 1:
        raise ValueError(f"trainer.devices is {options.devices}, expected a number of at least 1")
    if options.validate_every % options.checkpoint_every:
        raise ValueError(
            f"trainer.validate_every ({options.validate_every}) must be a multiple of "
            f"trainer.checkpoint_every ({options.checkpoint_every})"
        )
    if options.steps % options.checkpoint_every:
        raise ValueError(
            f"trainer.steps ({options.steps}) must be a multiple of trainer.checkpoint_every "
            f"({options.checkpoint_every})"
        )
    return lightning.Trainer(
        accelerator=options.accelerator,
        devices=options.devices,
        strategy="ddp" if options.devices > 1 else "auto",
        use_distributed_sampler=False,  # EpochSampler shares the scenes out itself
        # counted in epochs: with max_steps Lightning skips an epoch when it resumes at an epoch's end
        max_epochs=options.steps // options.checkpoint_every,
        check_val_every_n_epoch=options.validate_every // options.checkpoint_every,
        gradient_clip_val=options.clip,
        logger=TensorBoardLogger(run, name="tensorboard", version="", default_hp_metric=False),
        callbacks=[*callbacks, LearningRateMonitor("step"), SparingBar(1 if on_cpu else 20)],
        log_every_n_steps=min(10, options.checkpoint_every),
        num_sanity_val_steps=0,
        enable_model_summary=False,
        default_root_dir=run,
    )


def final_metrics(trainer: "lightning.Trainer", throughput: "Throughput") -> dict[str, Any]:
    """Validation metrics of the last validation, steps and speed, as plain numbers."""
    logged = {
        name.removeprefix("val/"): float(value)
        for name, value in trainer.callback_metrics.items()
        if name.startswith("val")
    }
    seconds = throughput.seconds
    return {
        "validation": logged,
        "steps": trainer.global_step,
        "training_seconds": seconds,
        "scenes_per_second": throughput.scenes / seconds if seconds else None,
    }
