"""pnet-evaluate: predict a split to a file, then score the file."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from pnet.cli.app import closest, key_of, key_paths, run_app, short_name
from pnet.cli.settings import METRICS, is_trained, read_run

if TYPE_CHECKING:
    from pnet.data.source import DataSource, SceneSet
    from pnet.engine.predictions import PredictionHeader

SPLITS = ("val", "test_l", "test_g")
PREDICTIONS = "predictions.safetensors"


def main() -> None:
    """Entry point."""
    run_app(evaluate, "evaluate")


@dataclass(frozen=True)
class Evaluation:
    """Which scenes a run is scored on, and how its post-processing is changed for it.

    Attributes:
        split: val, test_l or test_g.
        postprocess: settings that differ from the run's; with a `_target_` it stands in place of all of them.
        every: keep every so many scenes of a cycle. root: another data set of the same part, or None.
        source: settings of its reader where it is not pnet's own store.
    """

    split: str
    postprocess: dict[str, Any] = field(default_factory=dict)
    every: int = 1
    root: Path | None = None
    source: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        if self.every < 1:
            raise ValueError(f"every={self.every}: expected at least 1")

    @property
    def name(self) -> str:
        """The folder's name: the split and what differs from the plain evaluation."""
        changed = [f"{key}-{value}" for key, value in _leaves(self.postprocess)]
        every = [f"every-{self.every}"] if self.every > 1 else []
        other = [self.root.name] if self.root else []
        reader = [_source_name(self.source)] if self.source else []
        return short_name("_".join([self.split, *other, *reader, *every, *changed]))

    def folder(self, run: Path) -> Path:
        """Where its files lie."""
        return run / "evaluation" / self.name


def _source_name(source: dict[str, Any]) -> str:
    """The reader's class and a digest of its settings, the folder among them."""
    digest = sha256(OmegaConf.to_yaml(OmegaConf.create(source)).encode()).hexdigest()[:6]
    return f"{str(source.get('_target_', '')).rsplit('.', 1)[-1]}-{digest}"


def wanted_evaluations(items: Any) -> list[Evaluation]:
    """What pnet-train's setting `evaluate` asks for: names of splits, or {split: …, postprocess: {…}}."""
    found = []
    for item in items or []:
        settings = {"split": item} if isinstance(item, str) else item
        if not isinstance(settings, dict) or settings.get("split") not in SPLITS:
            raise ValueError(f"evaluate holds {item!r}, expected {', '.join(SPLITS)}")
        found.append(Evaluation(settings["split"], settings.get("postprocess") or {}))
    return found


def evaluate(cfg: DictConfig) -> None:
    """Predict, score and print; each step's file appears when it is whole."""
    import torch
    from rich.console import Console

    from pnet.engine.locks import hold
    from pnet.reporting.tables import metrics_table

    if cfg.stage not in ("predict", "score", "all"):
        raise ValueError(f"stage={cfg.stage}: choose predict, score or all")
    changes = OmegaConf.to_container(cfg.postprocess)
    assert isinstance(changes, dict)
    root, source = other_data(cfg)
    evaluation = Evaluation(cfg.split, {str(k): v for k, v in changes.items()}, cfg.every, root, source)
    if cfg.threads is not None:
        torch.set_num_threads(cfg.threads)
    run = Path(cfg.run)
    trained = read_run(run)
    with hold(run, f"another process works on {run}"):
        if cfg.stage != "score":
            predict(evaluation, run)
        if cfg.stage == "predict":
            return
        metrics = score(evaluation, run, trained)
        if cfg.results is not None:
            from pnet.cli.benchmark_results import export_results

            export_results(Path(cfg.results), evaluation, run, trained)
    out = Console(soft_wrap=True)
    out.print(metrics_table(metrics))
    words = [f"run={run}", *([] if evaluation.name == "test_l" else [f"evaluation={evaluation.name}"])]
    words += [word for word in HydraConfig.get().overrides.task if key_of(word).split(".")[0] == "data"]
    out.print(f"written to {evaluation.folder(run)}; next: pnet-report {' '.join(words)}", markup=False)


def other_data(cfg: DictConfig) -> tuple[Path | None, dict[str, Any] | None]:
    """Folder and reader's settings of the data set that a command names beside a run's own."""
    root = Path(cfg.data.root) if cfg.data.root else None
    data: Any = OmegaConf.to_container(cfg.data, resolve=True)
    return root, data["source"]


def _leaves(node: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(node, dict):
        for key, child in node.items():
            yield from _leaves(child, f"{path}.{key}" if path else str(key))
    else:
        yield path, node


def evaluated_source(evaluation: Evaluation, trained: DictConfig) -> "DataSource":
    """The data set to evaluate on: the run's own, or another."""
    from pnet.cli.build import open_source

    if evaluation.root is None:
        return open_source(trained.data)
    return open_source(OmegaConf.create({"root": str(evaluation.root), "source": evaluation.source}))


def open_scenes(evaluation: Evaluation, trained: DictConfig) -> tuple["SceneSet", str]:
    """The scenes to evaluate, and the fingerprint of their data set."""
    from pnet.cli.build import part_of
    from pnet.scenes.manifest import settings_fingerprint

    source = evaluated_source(evaluation, trained)
    fingerprint = settings_fingerprint(source.manifest())
    return source.scenes(evaluation.split, part_of(trained), evaluation.every), fingerprint


def predicted_scenes(cfg: DictConfig, trained: DictConfig, split: str, data: str) -> "SceneSet":
    """The scenes that predictions were made from, as a command names them.

    Args:
        cfg: of the command, whose `data` may name another data set. trained: the run's settings.
        split, data: of the predictions' header.
    Raises:
        ValueError: where the data set is another one.
    """
    root, source = other_data(cfg)
    scenes, fingerprint = open_scenes(Evaluation(split, root=root, source=source), trained)
    if fingerprint != data:
        raise ValueError(
            f"{root or trained.data.root}: is not the data that the predictions were made from; "
            "give data.root (and data=) as for pnet-evaluate, or evaluate again"
        )
    return scenes


def recovery_settings(changed: dict[str, Any], trained: DictConfig) -> DictConfig:
    """A run's post-processing with changed settings; an unknown key is an error."""
    changes = OmegaConf.create(changed)
    if "_target_" in changes:
        return changes
    settings: Any = OmegaConf.to_container(trained.postprocess, resolve=True)
    for key, value in changed.items():
        own = settings.get(key)
        if isinstance(value, dict) and isinstance(own, dict):
            kind = own.get("_target_")
            if value.get("_target_", kind) != kind:
                settings[key] = None  # another kind takes its place whole
    merged = OmegaConf.create(settings)
    empty = [key for key, value in _leaves(OmegaConf.to_container(merged)) if value is None]
    known = list(key_paths(OmegaConf.to_container(merged)))
    if merged._target_.endswith(".PoseRecovery"):
        known.append("doubtful")  # which runs of before it lack
    for key in key_paths(changed):
        if key not in known and not key.startswith(tuple(f"{name}." for name in empty)):
            raise ValueError(f"postprocess.{key}: unknown key{closest(key, known)}")
    return OmegaConf.merge(merged, changes)  # type: ignore[return-value]


def expected_header(evaluation: Evaluation, run: Path, trained: DictConfig, data: str) -> dict[str, str]:
    """What predictions of this evaluation must say of themselves."""
    from pnet.cli.build import identity

    recovery = OmegaConf.to_yaml(recovery_settings(evaluation.postprocess, trained))
    return {
        "part": identity(trained)["part"],
        "split": evaluation.split,
        "data": data,
        "weights": _weights_digest(run) if is_trained(trained) else _method_digest(trained),
        "recovery": sha256(recovery.encode()).hexdigest()[:16],
    }


def _weights_digest(run: Path) -> str:
    from pnet.engine.checkpoints import NAME

    weights = run / "checkpoints" / NAME
    if not weights.is_file():
        raise FileNotFoundError(f"{weights}: no checkpoint there; train first with pnet-train")
    return file_digest(weights)


def file_digest(path: Path) -> str:
    return sha256(path.read_bytes()).hexdigest()[:16]


def _method_digest(trained: DictConfig) -> str:
    """What stands for weights where a method has none: its settings and the part's."""
    settings = [OmegaConf.to_yaml(node, resolve=True) for node in (trained.method.estimator, trained.part)]
    return sha256("".join(settings).encode()).hexdigest()[:16]


def is_current(evaluation: Evaluation, run: Path, trained: DictConfig) -> bool:
    """Whether the run's weights were scored like this already, on the data that is there."""
    from pnet.engine.predictions import read_predictions
    from pnet.engine.provenance import read_json

    folder = evaluation.folder(run)
    try:
        if read_json(folder / METRICS).get("predictions") != file_digest(folder / PREDICTIONS):
            return False  # scored before they were predicted anew
        scenes, data = open_scenes(evaluation, trained)
        header, _ = read_predictions(folder / PREDICTIONS)
        check_predictions(folder, header, expected_header(evaluation, run, trained, data), scenes)
    except (OSError, ValueError):
        return False
    return True


def predict(evaluation: Evaluation, run: Path) -> None:
    """The first step: detections of every scene into a file."""
    from pnet.cli.build import load_method
    from pnet.engine.evaluation import predict_scenes
    from pnet.engine.predictions import PredictionHeader, write_predictions
    from pnet.reporting.progress import count_progress

    trained = read_run(run)
    method = load_method(run, recovery_settings(evaluation.postprocess, trained))
    scenes, data = open_scenes(evaluation, trained)
    expected = expected_header(evaluation, run, trained, data)
    with count_progress(f"predicting {evaluation.name}", len(scenes), "scenes") as advance:
        found = predict_scenes(method, scenes, trained.data.points, advance)
    timing = method.timing
    seconds = {
        "network": timing.network / timing.scenes,
        "postprocess": timing.postprocess / timing.scenes,
    }
    ids = [str(scene_id) for scene_id in scenes.ids]
    header = PredictionHeader(**expected, scenes=ids, seconds=seconds)
    write_predictions(evaluation.folder(run) / PREDICTIONS, header, found)


def score(evaluation: Evaluation, run: Path, trained: DictConfig) -> dict[str, Any]:
    """The second step: score the file; predictions of anything else are refused."""
    from pnet.cli.instantiate import instantiate
    from pnet.engine.evaluation import SceneScorer
    from pnet.engine.predictions import read_predictions
    from pnet.engine.provenance import write_json

    path = evaluation.folder(run) / PREDICTIONS
    header, found = read_predictions(path)
    scenes, data = open_scenes(evaluation, trained)
    check_predictions(path, header, expected_header(evaluation, run, trained, data), scenes)
    scorer = SceneScorer(instantiate(trained.part)).add_all(scenes, found)
    curve = scorer.metrics.curve()
    metrics: dict[str, Any] = {
        **scorer.compute(),
        **{f"{name}_seconds": value for name, value in header.seconds.items()},
    }
    columns = {"recall": curve.recall.tolist(), "precision": curve.precision.tolist()}
    write_json(path.with_name("curve.json"), columns)
    write_json(path.with_name(METRICS), {**metrics, "predictions": file_digest(path)})
    return metrics


def check_predictions(
    path: Path, header: "PredictionHeader", expected: dict[str, str], scenes: "SceneSet"
) -> None:
    """Raise ValueError where predictions belong to other data, weights, settings or scenes."""
    for key, value in expected.items():
        if getattr(header, key) != value:
            raise ValueError(
                f"{path}: its {key} is {getattr(header, key)}, expected {value}; predict again with stage=all"
            )
    if header.scenes != [str(scene_id) for scene_id in scenes.ids]:
        raise ValueError(f"{path}: holds other scenes than {header.split} has now; predict again")


if __name__ == "__main__":
    main()
