"""What a bundle tells of the run that it is made from: code, machine, data, settings, how good it is."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from pnet.cli.evaluate import PREDICTIONS, SPLITS, Evaluation, expected_header, file_digest
from pnet.cli.settings import METRICS
from pnet.engine.predictions import read_predictions
from pnet.engine.provenance import read_json
from pnet.scenes.manifest import MANIFEST

STOOD_ON = ("commits", "packages", "python", "machine", "device", "threads", "seed")  # of provenance.json
CAME_OUT = ("steps", "training_seconds", "precision", "network", "validation")  # of metrics.json
MADE_BY = (  # of the manifest: how the training's scenes were made
    *("source", "converted", "protocol", "files", "scenes", "bin", "physics", "clutter"),
    *("camera", "view", "noise", "noise_in", "seed"),
)
LEARNT_BY = (
    *("data.batch_size", "data.learn", "data.clutter", "views", "noise"),
    *("trainer.precision", "trainer.devices"),
)


def about(run: Path, cfg: DictConfig, changes: dict[str, Any] | None = None) -> dict[str, Any]:
    """Plain values; what nobody knows is left out.

    Args:
        cfg: the run's settings. changes: settings of its post-processing that differ in the bundle.
    """
    state, manifest = read_json(run / "provenance.json"), read_json(run / MANIFEST)
    metrics = read_json(run / METRICS) if (run / METRICS).is_file() else {}
    settings: Any = OmegaConf.to_container(cfg, resolve=True)
    noted = {} if changes else metrics.get("evaluations") or {}
    scored = {**noted, **evaluations(run, cfg, changes)}
    return {
        **_picked(state, STOOD_ON),
        **_picked(metrics, CAME_OUT),
        **({"evaluations": scored} if scored else {}),
        "data": _picked(manifest.get("training", manifest), MADE_BY),
        "training": {k: value for k in LEARNT_BY if (value := _nested(settings, k)) is not None},
    }


def evaluations(run: Path, cfg: DictConfig, changes: dict[str, Any] | None = None) -> dict[str, Any]:
    """The metrics of pnet-evaluate by split, of the run's present weights and the bundle's post-processing;
    where that is not the run's, of the run's beside."""
    found = {split: _evaluation(run, cfg, Evaluation(split, changes or {})) for split in SPLITS}
    if changes:
        found |= {f"{split}, not refined": _evaluation(run, cfg, Evaluation(split)) for split in SPLITS}
    return {split: metrics for split, metrics in found.items() if metrics is not None}


def _evaluation(run: Path, cfg: DictConfig, evaluation: Evaluation) -> dict[str, Any] | None:
    """Its metrics; None where there are none, or of what the run was before."""
    path = evaluation.folder(run) / PREDICTIONS
    try:
        metrics, (header, _) = read_json(path.with_name(METRICS)), read_predictions(path)
    except (OSError, ValueError):
        return None
    scored = metrics.pop("predictions", None) == file_digest(path)
    expected = expected_header(evaluation, run, cfg, header.data)
    current = scored and expected.items() <= vars(header).items()
    return {"split": evaluation.split, "data": header.data, **metrics} if current else None


def _picked(content: Mapping[str, Any], keys: Sequence[str]) -> dict[str, Any]:
    """Those of the keys that are there."""
    return {key: content[key] for key in keys if key in content}


def _nested(settings: Any, key: str) -> Any:
    """The value of a dotted key, None where it is missing."""
    for name in key.split("."):
        settings = settings.get(name) if isinstance(settings, dict) else None
    return settings
