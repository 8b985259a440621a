"""pnet-train: train a network on a data set."""

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from pnet.cli.app import run_app

if TYPE_CHECKING:
    import lightning

    from pnet.engine.callbacks import Throughput


def main() -> None:
    """Entry point."""
    run_app(train, "train")


def train(cfg: DictConfig) -> None:
    """Train, or go on with a training (`ckpt=last`), and write metrics.json last."""
    import lightning
    import torch

    quiet_lightning()
    from pnet.cli.build import CONFIG, RESOLVED, build_data, build_parts, device_of, identity, use_bf16
    from pnet.cli.instantiate import instantiate
    from pnet.engine.allocator import keep_freed_memory
    from pnet.engine.callbacks import PoseValidation, Throughput
    from pnet.engine.checkpoints import NAME, ResumableCheckpoint, read_checkpoint
    from pnet.engine.estimator import NetworkEstimator
    from pnet.engine.provenance import provenance, read_json, write_json
    from pnet.engine.training import PoseTraining, check_identity
    from pnet.models.summary import summarise
    from pnet.scenes.generation import read_manifest, settings_fingerprint
    from pnet.scenes.store import write_atomically

    if cfg.trainer.threads is not None:
        torch.set_num_threads(cfg.trainer.threads)
    if device_of(cfg.trainer.accelerator) == "cpu":
        keep_freed_memory()
    run = Path(cfg.run_dir)
    checkpoint = resume_from(cfg.ckpt, run / "checkpoints" / NAME)
    lightning.seed_everything(cfg.seed, workers=True, verbose=False)
    parts, bf16 = build_parts(cfg), use_bf16(cfg.trainer.precision, cfg.trainer.accelerator)
    data = build_data(cfg, parts)
    validation = data.scenes("val", cfg.data.val_every)
    data.train_dataloader()  # says now, before anything is written, what is wrong with the data
    module = PoseTraining(
        parts.network,
        instantiate(cfg.loss, chain=parts.part.chain),
        instantiate(cfg.optimizer),
        instantiate(cfg.schedule),
        bf16,
        {**identity(cfg), "data": settings_fingerprint(read_manifest(data.root))},
    )
    throughput = Throughput()
    estimator = NetworkEstimator(parts.part, parts.network, parts.recovery, bf16)
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
            print_end(run, read_json(run / "metrics.json"))
            return
    run.mkdir(parents=True, exist_ok=True)
    write_atomically(run / CONFIG, OmegaConf.to_yaml(cfg).encode())
    write_atomically(run / RESOLVED, OmegaConf.to_yaml(cfg, resolve=True).encode())
    write_json(run / "provenance.json", provenance(cfg.seed))
    (run / "metrics.json").unlink(missing_ok=True)
    full = validation[len(validation) - 1]  # cycles end with a full bin
    summary = summarise(parts.network, torch.from_numpy(full.points[: cfg.data.points]))
    print(summary)
    try:
        trainer.fit(module, datamodule=data, ckpt_path=checkpoint, weights_only=True)
    except SystemExit:  # what Lightning makes of Ctrl-C
        raise KeyboardInterrupt from None
    if "val/AP" not in trainer.callback_metrics:  # killed after the last step: validated but not written
        trainer.validate(module, datamodule=data, verbose=False)
    metrics = final_metrics(trainer, throughput)
    log_settings(trainer, cfg, metrics)
    metrics["network"] = vars(summary)
    write_json(run / "metrics.json", metrics)
    print_end(run, metrics)


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

    path = run / "metrics.json"
    return path.is_file() and int(read_json(path).get("steps") or 0) >= steps


def check_same_settings(run: Path, cfg: DictConfig) -> None:
    """Raise ValueError where a run was begun with other settings than these; names the first few."""
    from pnet.cli.build import read_run
    from pnet.scenes.generation import differences

    free = ("ckpt", "run_dir", "trainer.threads")  # decide nothing
    old, new = (OmegaConf.to_container(c, resolve=True) for c in (read_run(run), cfg))
    differing = sorted(text for text in differences(old, new) if not text.startswith(free))
    if differing:
        raise ValueError(
            f"{run}: holds a training with other settings: {'; '.join(differing[:4])}. "
            "Choose another run_dir, or delete that folder"
        )


def build_trainer(cfg: DictConfig, run: Path, callbacks: list["lightning.Callback"]) -> "lightning.Trainer":
    """The Lightning trainer: an epoch lasts from one checkpoint to the next."""
    import lightning
    from lightning.pytorch.callbacks import LearningRateMonitor, RichProgressBar
    from lightning.pytorch.loggers import TensorBoardLogger

    options = cfg.trainer
    if options.devices != 1:
        raise ValueError(f"trainer.devices is {options.devices}: training runs on one device, set it to 1")
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
        # counted in epochs: with max_steps Lightning skips an epoch when it resumes at an epoch's end
        max_epochs=options.steps // options.checkpoint_every,
        check_val_every_n_epoch=options.validate_every // options.checkpoint_every,
        gradient_clip_val=options.clip,
        logger=TensorBoardLogger(run, name="tensorboard", version="", default_hp_metric=False),
        callbacks=[*callbacks, LearningRateMonitor("step"), RichProgressBar()],
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


def log_settings(trainer: "lightning.Trainer", cfg: DictConfig, metrics: dict[str, Any]) -> None:
    """The settings for TensorBoard: as text, and as hyperparameters beside the final AP."""
    from lightning.pytorch.loggers import TensorBoardLogger

    logger = trainer.logger
    if not isinstance(logger, TensorBoardLogger):
        return
    logger.experiment.add_text("settings", f"```yaml\n{OmegaConf.to_yaml(cfg, resolve=True)}\n```")
    chosen = {
        "part": identity_name(cfg.part._target_),
        "backbone": identity_name(cfg.backbone._target_),
        "loss": cfg.loss.norm,
        "optimizer": identity_name(cfg.optimizer._target_),
        "lr": cfg.optimizer.lr,
        "batch_size": cfg.data.batch_size,
        "steps": cfg.trainer.steps,
        "keypoint_rule": cfg.data.targets.rule,
        "seed": cfg.seed,
    }
    scores = {
        f"final/{name}": metrics["validation"][name]
        for name in ("AP", "mAP", "loss")
        if name in metrics["validation"]
    }
    logger.log_hyperparams(chosen, scores)
    logger.experiment.flush()


def identity_name(target: str) -> str:
    """The class name at the end of a `_target_`."""
    return target.rsplit(".", 1)[-1]


def print_end(run: Path, metrics: dict[str, Any]) -> None:
    """What came out, and what to do next."""
    from rich.console import Console

    out = Console(soft_wrap=True, width=shutil.get_terminal_size().columns)
    ap = metrics["validation"].get("AP")
    out.print(
        f"{metrics['steps']} steps in {metrics['training_seconds']:.0f} s of training "
        f"({metrics['scenes_per_second'] or 0:.1f} scenes/s)"
        + (f"; validation AP {ap:.3f}" if ap is not None else "")
    )
    out.print(f"run in {run}; next: pnet-evaluate run={run}")
