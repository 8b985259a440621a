"""pnet-train: train a network on a data set, and evaluate it."""

import shutil
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from pnet.cli.app import EXPECTED, error_text, run_app
from pnet.cli.data_set import make_data, make_data_again, repeated
from pnet.cli.evaluate import Evaluation, is_current, open_scenes, predict, score, wanted_evaluations
from pnet.cli.fit import begin_run, fit, is_helper
from pnet.cli.settings import METRICS, is_trained, read_run, training_settings


def main() -> None:
    """Entry point."""
    run_app(train, "train")


def train(cfg: DictConfig) -> None:
    """Train, or go on with a training (`ckpt=last`), evaluate, and write metrics.json last."""
    from pnet.engine.locks import hold
    from pnet.engine.provenance import read_json

    if cfg.sweep is not None or cfg.dry_run:
        raise ValueError("sweep= and dry_run= are about several trainings: add --multirun")
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
        trained = fit(cfg, run) if is_trained(cfg) else without_training(cfg, run)
        metrics, failed = evaluate_all(trained, evaluations, run)
        if metrics != trained or not (run / METRICS).is_file():
            finish(cfg, run, metrics)
        if failed:
            raise ValueError("; ".join(failed))
        print_end(run, read_json(run / METRICS))


def without_training(cfg: DictConfig, run: Path) -> dict[str, Any]:
    """The metrics to begin with of a method that needs no training; those there where nothing has changed."""
    from pnet.engine.provenance import read_json

    if (run / METRICS).is_file() and training_settings(read_run(run)) == training_settings(cfg):
        return read_json(run / METRICS)
    begin_run(cfg, run)
    return {"steps": 0, "training_seconds": 0.0, "scenes_per_second": None, "validation": {}}


def evaluate_all(
    metrics: dict[str, Any], evaluations: list[Evaluation], run: Path
) -> tuple[dict[str, Any], list[str]]:
    """Do the evaluations that are not there yet; one that fails keeps nothing from the others.

    Returns:
        the run's metrics with all that ended; a line about each that failed.
    """
    trained, done, failed = read_run(run), dict(metrics.get("evaluations", {})), []
    for evaluation in evaluations:
        try:
            if not is_current(evaluation, run, trained):
                done.pop(evaluation.name, None)
                predict(evaluation, run)
                score(evaluation, run, trained)
            if evaluation.name not in done:
                done[evaluation.name] = evaluation_entry(evaluation, run, trained)
        except EXPECTED as fault:
            failed.append(f"{evaluation.name}: {error_text(fault)}")
    return {**metrics, "evaluations": done}, failed


def evaluation_entry(evaluation: Evaluation, run: Path, trained: DictConfig) -> dict[str, Any]:
    """What metrics.json keeps of an evaluation: how, on what and by which code, and its metrics."""
    from pnet.engine.provenance import commit_text, git_state, read_json

    found = read_json(evaluation.folder(run) / METRICS)
    found.pop("predictions", None)  # a digest of the file, times and all
    return {
        "split": evaluation.split,
        "postprocess": evaluation.postprocess,
        "data": open_scenes(evaluation, trained)[1],
        "commit": commit_text(git_state(Path(__file__).parent)),
        **found,
    }


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
