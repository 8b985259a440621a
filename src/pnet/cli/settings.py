"""The settings of a run, as its folder keeps them; light, so that commands start quickly."""

from copy import deepcopy
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

CONFIG = "config.yaml"  # a run's settings as they were given, interpolations and all
RESOLVED = "resolved.yaml"  # the same, resolved: what evaluation reads
METRICS = "metrics.json"  # written last: with it a run is done
DECIDE_NOTHING = (
    "ckpt",
    "run_dir",
    "repeat",
    "evaluate",
    "sweep",
    "dry_run",
    "ops",
    "data.generate",
    "data.workers",
    "trainer.threads",
    "trainer.compile",
)


def training_settings(run: DictConfig | dict[str, Any]) -> dict[str, Any]:
    """What a training depends on, as plain values: a run with equal ones is the same run.

    Post-processing, how often and where to look, and what runs beside it are left out.
    """
    settings: Any = (
        OmegaConf.to_container(run, resolve=True) if isinstance(run, DictConfig) else deepcopy(run)
    )
    settings["data"].setdefault("source", None)  # runs of before had pnet's own store alone
    _leave_out_what_is_off(settings)
    for key in DECIDE_NOTHING:
        group, _, name = key.rpartition(".")
        (settings.get(group, {}) if group else settings).pop(name, None)
    if settings["method"]["estimator"] is None:
        settings.pop("postprocess", None)
        settings["method"].pop("name", None)
    return settings


def _leave_out_what_is_off(settings: dict[str, Any]) -> None:
    """Drop what changes nothing, so that runs of before it was there are found as well."""
    for head in ("sizes", "doubt"):
        if not settings["model"].get(head):
            settings["model"].pop(head, None)
            settings["loss"].pop(head, None)
    for group, key in (("model", "pooling"), ("backbone", "slopes")):
        if settings[group].get(key) is None:
            settings[group].pop(key, None)


def is_trained(cfg: DictConfig) -> bool:
    """Whether the method of a config has weights."""
    return cfg.method.estimator is None


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
    if "method" not in cfg:
        raise ValueError(f"{path}: written by an older pnet, train again")
    return cfg


def recipe_text(settings: dict[str, Any]) -> str:
    """What the time of a step depends on most: backbone, network, points and batch, as text."""
    backbone = settings["backbone"]["_target_"].rsplit(".", 1)[-1]
    model = settings["model"]["_target_"].rsplit(".", 1)[-1]
    points = settings["data"]["points"] or settings["protocol"]["points"]
    return f"{backbone}, {model}, {points} points, {settings['data']['batch_size']} scenes"
