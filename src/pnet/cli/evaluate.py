"""pnet-evaluate: predict a split to a file, then score the file."""

from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from pnet.cli.app import closest, key_paths, run_app

if TYPE_CHECKING:
    from pnet.data.scene_folder import SceneFolder
    from pnet.engine.predictions import PredictionHeader

PREDICTIONS = "predictions.safetensors"


def main() -> None:
    """Entry point."""
    run_app(evaluate, "evaluate")


def evaluate(cfg: DictConfig) -> None:
    """Predict, score and print; each step's file appears when it is whole."""
    import torch

    from pnet.cli.build import read_run

    if cfg.stage not in ("predict", "score", "all"):
        raise ValueError(f"stage={cfg.stage}: choose predict, score or all")
    if cfg.every < 1:
        raise ValueError(f"every={cfg.every}: expected at least 1")
    if cfg.threads is not None:
        torch.set_num_threads(cfg.threads)
    run = Path(cfg.run)
    trained = read_run(run)
    if cfg.stage != "score":
        predict(cfg, run)
    if cfg.stage != "predict":
        score(cfg, run, trained)


def evaluation_folder(cfg: DictConfig, run: Path) -> Path:
    """Where the files of this evaluation lie: named by what differs from the plain one."""
    changed = [f"{key}-{value}" for key, value in _leaves(OmegaConf.to_container(cfg.postprocess))]
    every = [f"every-{cfg.every}"] if cfg.every > 1 else []
    other = [Path(cfg.data.root).name] if cfg.data.root else []
    return run / "evaluation" / "_".join([cfg.split, *other, *every, *changed]).replace("/", "-")


def _leaves(node: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(node, dict):
        for key, child in node.items():
            yield from _leaves(child, f"{path}.{key}" if path else str(key))
    else:
        yield path, node


def open_scenes(cfg: DictConfig, trained: DictConfig) -> tuple["SceneFolder", str]:
    """The scenes to evaluate, and the fingerprint of their data set."""
    from pnet.cli.build import identity
    from pnet.data.scene_folder import SceneFolder
    from pnet.scenes.generation import read_manifest, settings_fingerprint

    root = Path(cfg.data.root or trained.data.root)
    fingerprint = settings_fingerprint(read_manifest(root))
    return SceneFolder(root, cfg.split, identity(trained)["part"], cfg.every), fingerprint


def recovery_settings(cfg: DictConfig, trained: DictConfig) -> DictConfig:
    """The run's post-processing with this evaluation's changes; an unknown key is an error."""
    merged = OmegaConf.create(OmegaConf.to_container(trained.postprocess, resolve=True))
    known = list(key_paths(OmegaConf.to_container(merged)))
    for key in key_paths(OmegaConf.to_container(cfg.postprocess)):
        if key not in known:
            raise ValueError(f"postprocess.{key}: unknown key{closest(key, known)}")
    return OmegaConf.merge(merged, cfg.postprocess)  # type: ignore[return-value]


def expected_header(cfg: DictConfig, run: Path, trained: DictConfig, data: str) -> dict[str, str]:
    """What predictions of this evaluation must say of themselves."""
    from pnet.cli.build import identity
    from pnet.engine.checkpoints import NAME

    weights = run / "checkpoints" / NAME
    if not weights.is_file():
        raise FileNotFoundError(f"{weights}: no checkpoint there; train first with pnet-train")
    recovery = OmegaConf.to_yaml(recovery_settings(cfg, trained))
    return {
        "part": identity(trained)["part"],
        "split": cfg.split,
        "data": data,
        "weights": sha256(weights.read_bytes()).hexdigest()[:16],
        "recovery": sha256(recovery.encode()).hexdigest()[:16],
    }


def predict(cfg: DictConfig, run: Path) -> None:
    """The first step: detections of every scene into a file."""
    from pnet.cli.build import load_estimator
    from pnet.cli.instantiate import instantiate
    from pnet.engine.evaluation import predict_scenes
    from pnet.engine.predictions import PredictionHeader, write_predictions
    from pnet.reporting.progress import count_progress

    trained, estimator = load_estimator(run)
    estimator.recovery = instantiate(recovery_settings(cfg, trained))
    scenes, data = open_scenes(cfg, trained)
    expected = expected_header(cfg, run, trained, data)
    with count_progress(f"predicting {cfg.split}", len(scenes), "scenes") as advance:
        found = predict_scenes(estimator, scenes, trained.data.points, advance)
    timing = estimator.timing
    seconds = {
        "network": timing.network / timing.scenes,
        "postprocess": timing.postprocess / timing.scenes,
    }
    ids = [str(scene_id) for scene_id in scenes.ids]
    header = PredictionHeader(**expected, scenes=ids, seconds=seconds)
    write_predictions(evaluation_folder(cfg, run) / PREDICTIONS, header, found)


def score(cfg: DictConfig, run: Path, trained: DictConfig) -> None:
    """The second step: score the file; predictions of anything else are refused."""
    from rich.console import Console

    from pnet.cli.instantiate import instantiate
    from pnet.engine.evaluation import SceneScorer
    from pnet.engine.predictions import read_predictions
    from pnet.engine.provenance import write_json
    from pnet.reporting.tables import metrics_table

    path = evaluation_folder(cfg, run) / PREDICTIONS
    header, found = read_predictions(path)
    scenes, data = open_scenes(cfg, trained)
    check_header(path, header, expected_header(cfg, run, trained, data))
    if header.scenes != [str(scene_id) for scene_id in scenes.ids]:
        raise ValueError(f"{path}: holds other scenes than {cfg.split} has now; predict again")
    scorer = SceneScorer(instantiate(trained.part)).add_all(scenes, found)
    curve = scorer.metrics.curve()
    metrics: dict[str, Any] = {
        **scorer.compute(),
        **{f"{name}_seconds": value for name, value in header.seconds.items()},
    }
    columns = {"recall": curve.recall.tolist(), "precision": curve.precision.tolist()}
    write_json(path.with_name("curve.json"), columns)
    write_json(path.with_name("metrics.json"), metrics)
    out = Console(soft_wrap=True)
    out.print(metrics_table(metrics))
    out.print(f"written to {path.parent}; next: pnet-report run={run}")


def check_header(path: Path, header: "PredictionHeader", expected: dict[str, str]) -> None:
    """Raise ValueError where predictions belong to other data, weights or settings."""
    for key, value in expected.items():
        if getattr(header, key) != value:
            raise ValueError(
                f"{path}: its {key} is {getattr(header, key)}, expected {value}; predict again with stage=all"
            )
