"""pnet-train: train a network on a data set."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra import compose
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from pnet.cli.app import hydra_value, key_of, run_app
from pnet.cli.evaluate import Evaluation, is_current, open_scenes, predict, score, wanted_evaluations
from pnet.cli.settings import (
    CONFIG,
    METRICS,
    RESOLVED,
    is_trained,
    read_run,
    recipe_text,
    training_settings,
)

if TYPE_CHECKING:
    import lightning

    from pnet.engine.callbacks import Throughput


def main() -> None:
    """Entry point."""
    run_app(train, "train")


def train(cfg: DictConfig) -> None:
    """Train, or go on with a training (`ckpt=last`), evaluate, and write metrics.json last."""
    from pnet.engine.locks import hold
    from pnet.engine.provenance import read_json

    if cfg.sweep is not None:
        raise ValueError(f"sweep={cfg.sweep} declares several trainings: add --multirun")
    if cfg.repeat is not None:
        cfg = repeated(cfg)
    run = Path(cfg.run_dir)
    if is_helper():
        fit(cfg, run)
        return
    evaluations = wanted_evaluations(OmegaConf.to_container(cfg.evaluate, resolve=True))
    with hold(run, f"another process works on {run}"):
        if cfg.repeat is not None:
            make_data_again(cfg)
        elif cfg.data.generate is not None:
            make_data(cfg)
        if is_trained(cfg):
            metrics = fit(cfg, run)
        else:
            begin_run(cfg, run)
            metrics = {"steps": 0, "training_seconds": 0.0, "scenes_per_second": None, "validation": {}}
        if all(is_evaluated(metrics, evaluation, run) for evaluation in evaluations):
            if not (run / METRICS).is_file():
                finish(cfg, run, metrics)
        else:
            finish(cfg, run, with_evaluations(metrics, evaluations, run))
        print_end(run, read_json(run / METRICS))


def fit(cfg: DictConfig, run: Path) -> dict[str, Any]:
    """Train the network; what came out of it, from metrics.json where the run has ended before."""
    import lightning
    import torch

    quiet_lightning()
    from pnet.cli.build import build_data, build_parts, device_of, identity, use_bf16
    from pnet.cli.instantiate import instantiate
    from pnet.engine.allocator import keep_freed_memory
    from pnet.engine.callbacks import PoseValidation, Throughput
    from pnet.engine.checkpoints import NAME, ResumableCheckpoint, read_checkpoint
    from pnet.engine.estimator import NetworkEstimator
    from pnet.engine.provenance import read_json
    from pnet.engine.tensorboard import add_settings
    from pnet.engine.training import PoseTraining, check_identity
    from pnet.models.summary import summarise
    from pnet.scenes.generation import read_manifest, settings_fingerprint

    if cfg.trainer.threads is not None:
        torch.set_num_threads(cfg.trainer.threads)
    if device_of(cfg.trainer.accelerator) == "cpu":
        keep_freed_memory()
    checkpoint = resume_from(cfg.ckpt, run / "checkpoints" / NAME)
    lightning.seed_everything(cfg.seed, workers=True, verbose=False)
    parts, bf16 = build_parts(cfg), use_bf16(cfg.trainer.precision, cfg.trainer.accelerator)
    data = build_data(cfg, parts)
    validation = data.scenes("val", cfg.data.val_every)
    data.train_dataloader()  # says now, before anything is written, what is wrong with the data
    module = PoseTraining(
        parts.network,
        instantiate(cfg.loss, part=parts.part),
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
            return read_json(run / METRICS)
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
        "recipe": recipe_text(training_settings(cfg)),
        "network": vars(summary),
    }


def is_helper() -> bool:
    """Whether Lightning started this process to train along with the first (trainer.devices > 1)."""
    return int(os.environ.get("LOCAL_RANK", "0")) > 0


def begin_run(cfg: DictConfig, run: Path) -> None:
    """Write what the run is made of; metrics.json of an earlier one goes."""
    from pnet.engine.provenance import provenance, write_json
    from pnet.scenes.generation import MANIFEST, read_manifest
    from pnet.scenes.store import write_atomically

    data = read_manifest(Path(cfg.data.root))
    run.mkdir(parents=True, exist_ok=True)
    (run / METRICS).unlink(missing_ok=True)
    write_json(run / MANIFEST, data)  # how the data was made, so that the folder is enough to repeat the run
    write_atomically(run / CONFIG, OmegaConf.to_yaml(cfg).encode())
    write_atomically(run / RESOLVED, OmegaConf.to_yaml(cfg, resolve=True).encode())
    write_json(run / "provenance.json", provenance(cfg.seed))


def is_evaluated(metrics: dict[str, Any], evaluation: Evaluation, run: Path) -> bool:
    """Whether a run's metrics hold this evaluation of its weights."""
    return evaluation.name in metrics.get("evaluations", {}) and is_current(evaluation, run, read_run(run))


def with_evaluations(metrics: dict[str, Any], evaluations: list[Evaluation], run: Path) -> dict[str, Any]:
    """The metrics of a run, and those of its evaluations; what is there already is not done again."""
    from pnet.engine.provenance import read_json

    trained, done = read_run(run), dict(metrics.get("evaluations", {}))
    for evaluation in evaluations:
        if not is_current(evaluation, run, trained):
            predict(evaluation, run)
            score(evaluation, run, trained)
        found = read_json(evaluation.folder(run) / METRICS)
        done[evaluation.name] = {
            "split": evaluation.split,
            "postprocess": evaluation.postprocess,
            "data": open_scenes(evaluation, trained)[1],
            **found,
        }
    return {**metrics, "evaluations": done}


def finish(cfg: DictConfig, run: Path, metrics: dict[str, Any]) -> None:
    """Tell TensorBoard what came out, then write metrics.json: with it the run is done."""
    from pnet.engine.provenance import read_json, write_json
    from pnet.engine.tensorboard import log_hyperparameters

    paths = [run / "evaluation" / name / "curve.json" for name in metrics.get("evaluations", {})]
    curves = {f"final/precision_recall_{p.parent.name}": read_json(p) for p in paths if p.is_file()}
    log_hyperparameters(
        run / "tensorboard",
        chosen_settings(cfg),
        ("part", "method", "keypoint_rule", "visibility_module", "learn"),  # what most sweeps vary
        final_scores(metrics),
        curves,
    )
    write_json(run / METRICS, metrics)


def repeated(cfg: DictConfig) -> DictConfig:
    """The settings of the run `repeat`, into another folder, with as many threads as it had."""
    from pnet.engine.provenance import git_state, read_json

    old = Path(cfg.repeat)
    again = read_run(old).copy()
    state = read_json(old / "provenance.json")
    commit = git_state(Path(__file__).parent)["commit"]
    if state["git"]["commit"] != commit:
        print(
            f"{old} was trained with commit {state['git']['commit'][:7]}, this is {commit[:7]}",
            file=sys.stderr,
        )
    given = any(key_of(word) == "run_dir" for word in HydraConfig.get().overrides.task)
    again.run_dir = cfg.run_dir if given else f"{str(old).rstrip('/')}_again"
    again.ckpt, again.repeat = cfg.ckpt, cfg.repeat
    again.trainer.threads = state["threads"]
    return again


def make_data_again(cfg: DictConfig) -> None:
    """Have the data of the run `repeat` made where it is gone; other data in its place is an error."""
    from pnet.scenes.generation import MANIFEST, read_manifest, settings_fingerprint

    root, manifest = Path(cfg.data.root), Path(cfg.repeat) / MANIFEST
    if not (root / MANIFEST).exists():
        run_generate([f"like={hydra_value(str(manifest))}", f"data.root={hydra_value(str(root))}"], root)
    elif settings_fingerprint(read_manifest(root)) != settings_fingerprint(read_manifest(manifest.parent)):
        raise ValueError(
            f"{root}: holds other data than {cfg.repeat} was trained on; move it away and try again"
        )


def make_data(cfg: DictConfig) -> None:
    """Have pnet-generate make what is missing of the data set, in a process of its own."""
    from pnet.cli.generate import is_complete

    chosen = HydraConfig.get().overrides.task
    kept = [
        word for word in chosen if word.lstrip("+").startswith(("part=", "part.", "protocol=", "protocol."))
    ]
    overrides = [*kept, f"data.root={cfg.data.root}", *cfg.data.generate]
    if not is_complete(compose("generate", overrides=overrides)):
        run_generate(overrides, cfg.data.root)


def run_generate(overrides: list[str], root: Path) -> None:
    """pnet-generate in a process of its own; its output stays where this one's goes."""
    if subprocess.run([sys.executable, "-m", "pnet.cli.generate", *overrides]).returncode:
        raise ValueError(f"{root}: the scenes could not be made, see above")


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
    from pnet.scenes.generation import differences

    differing = sorted(differences(training_settings(read_run(run)), training_settings(cfg)))
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


def chosen_settings(cfg: DictConfig) -> dict[str, Any]:
    """What TensorBoard's page of hyperparameters compares runs by."""
    return {
        "part": cfg.part.get("name", identity_name(cfg.part._target_)),
        "protocol": cfg.protocol.name,
        "method": cfg.method.name,
        "keypoint_rule": cfg.data.targets.rule,
        "radius_filter": cfg.postprocess.get("radius_filter") is not None,
        "visibility_module": cfg.model.visibility,
        "learn": str(cfg.data.learn),
        "backbone": identity_name(cfg.backbone._target_),
        "loss": cfg.loss.get("norm", identity_name(cfg.loss._target_)),
        "optimizer": identity_name(cfg.optimizer._target_),
        "lr": cfg.optimizer.lr,
        "batch_size": cfg.data.batch_size,
        "steps": cfg.trainer.steps,
        "seed": cfg.seed,
    }


def final_scores(metrics: dict[str, Any]) -> dict[str, float | None]:
    """mAP on each evaluation and on validation scenes, by tag; None where it was not measured."""
    evaluations, validation = metrics.get("evaluations", {}), metrics["validation"]
    scores = {
        "final/mAP_L": evaluations.get("test_l", {}).get("mAP"),
        "final/mAP_G": evaluations.get("test_g", {}).get("mAP"),
        "final/mAP_G_without_RF": evaluations.get("test_g_radius_filter-None", {}).get("mAP"),
        **{f"final/{name}_val": validation.get(name) for name in ("mAP", "AP", "loss")},
    }
    return {tag: value if value == value else None for tag, value in scores.items()}


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
    evaluations = metrics.get("evaluations", {})
    for name, values in evaluations.items():
        out.print(f"{name}: mAP {values['mAP'] or 0:.3f}, AP {values['AP'] or 0:.3f}")
    more = "" if evaluations else f"; next: pnet-evaluate run={run}"
    out.print(f"run in {run}{more}")


if __name__ == "__main__":
    main()
