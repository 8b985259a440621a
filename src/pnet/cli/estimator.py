"""A trained estimator out of a run's folder or a bundle: the Python side of pnet-predict."""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Self

import torch
from hydra.errors import InstantiationException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from pnet.cli.app import error_text
from pnet.cli.build import network_method, part_of, read_weights
from pnet.cli.bundle_notes import about
from pnet.cli.evaluate import recovery_settings
from pnet.cli.pretrained import pretrained_bundle
from pnet.cli.settings import is_trained, read_run
from pnet.data.background import Background
from pnet.engine.bundle import Bundle, read_bundle
from pnet.engine.depth_estimator import DepthEstimator
from pnet.engine.provenance import read_json
from pnet.geometry.camera import Camera
from pnet.scenes.manifest import MANIFEST

NEEDED = ("seed", "part", "backbone", "model", "postprocess", "method")  # of a training's settings
UNSUITABLE = (InstantiationException, OmegaConfBaseException, AttributeError, TypeError, KeyError)
DEVICES = {"auto": "auto", "cpu": "cpu", "cuda": "gpu"}


class Estimator(DepthEstimator):
    """Finds the instances of a part in depth images and clouds, by a trained run or bundle.

    Example:
        from pnet import Estimator
        found = Estimator.load("outputs/demo").estimate(depth, camera)
        print(found.R, found.t, found.parameters, found.score)
    """

    @classmethod
    def load(
        cls,
        run: str | Path,
        *,
        postprocess: dict[str, Any] | None = None,
        background: Background | None = None,
        device: str = "auto",
    ) -> Self:
        """The estimator of a trained network.

        Args:
            run: a folder that pnet-train made, or a bundle of pnet-export.
            postprocess: settings that differ from the run's, for instance {"visibility_threshold": 0.3}.
            background: see `DepthEstimator`. device: "auto", "cpu" or "cuda".
        Raises:
            FileNotFoundError, ValueError: names the file and what is wrong with it.
        """
        if device not in DEVICES:
            raise ValueError(f"device={device}: choose {', '.join(DEVICES)}")
        if device == "cuda" and not torch.cuda.is_available():
            raise ValueError("device=cuda: torch finds no GPU here; use device=auto")
        path = Path(run)
        source = bundle_of(path)
        with TemporaryDirectory() as folder:
            try:
                cfg = settings_of(source, path, Path(folder))
                recovery = recovery_settings(postprocess or {}, cfg)
                method = network_method(cfg, source.weights, recovery, str(path), DEVICES[device])
            except UNSUITABLE as fault:
                raise ValueError(f"{path}: its settings describe no network ({error_text(fault)})") from fault
        return cls(method, source.points, source.camera, background)

    @classmethod
    def pretrained(
        cls,
        part: str,
        *,
        postprocess: dict[str, Any] | None = None,
        background: Background | None = None,
        device: str = "auto",
    ) -> Self:
        """The estimator of the weights that come with pnet for a part.

        Args:
            part: the template's name, for instance "tn34". The others: see `load`.
        Raises:
            ValueError: where no weights come with pnet for the part; names those that there are.
        """
        bundle = pretrained_bundle(part)
        return cls.load(bundle, postprocess=postprocess, background=background, device=device)


def bundle_of(path: Path, changes: dict[str, Any] | None = None) -> Bundle:
    """What a run's folder, with changes of its post-processing, or a bundle's file holds."""
    if path.is_dir():
        return run_bundle(path, changes)
    if changes:
        raise ValueError(
            f"{path}: refine= changes what the figures on the card are of; export the run's folder"
        )
    return read_bundle(path)


def run_bundle(run: Path, changes: dict[str, Any] | None = None) -> Bundle:
    """What a bundle of a run's folder holds; changes: settings of its post-processing that differ."""
    cfg = read_run(run)
    if not is_trained(cfg):
        raise ValueError(f"{run}: {cfg.method.name} needs no training and has no weights")
    weights = read_weights(run, cfg)
    manifest = read_json(run / MANIFEST)
    settings: Any = OmegaConf.to_container(OmegaConf.masked_copy(cfg, list(NEEDED)), resolve=True)
    if changes:
        settings["postprocess"] = OmegaConf.to_container(recovery_settings(changes, cfg), resolve=True)
    targets = OmegaConf.to_container(cfg.data.targets, resolve=True)
    settings["data"] = {"points": cfg.data.points, "targets": targets}
    settings["trainer"] = {key: cfg.trainer[key] for key in ("accelerator", "precision")}
    seen = scenes_of(manifest, part_of(cfg).name)
    points = cfg.data.points or seen.points
    if points is None:
        raise ValueError(f"{run / MANIFEST}: does not say how many points the scenes had; set data.points")
    return Bundle(settings, weights, points, seen.camera, mesh_files(settings), about(run, cfg, changes))


@dataclass(frozen=True)
class SeenScenes:
    """What a manifest says of a training's scenes, None where it doesn't: N and the camera."""

    points: int | None
    camera: Camera | None


def scenes_of(manifest: dict[str, Any], part: str) -> SeenScenes:
    """Points and camera of the scenes of a data set. part: the template's name."""
    manifest = manifest.get("training", manifest)
    protocol = manifest.get("protocol") or {}
    own = (protocol.get("by_part") or {}).get(part) or {}
    points = manifest.get("points") or own.get("points") or protocol.get("points")
    camera = {key: value for key, value in (manifest.get("camera") or {}).items() if key != "_target_"}
    return SeenScenes(points, Camera(**camera) if camera else None)


def mesh_files(settings: dict[str, Any]) -> dict[str, bytes]:
    """The mesh of a CAD part, and its name in the settings instead of its path."""
    mesh = settings["part"].get("mesh")
    if not isinstance(mesh, str):
        return {}
    path = Path(mesh)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: the part's mesh is gone; a bundle takes it along")
    settings["part"]["mesh"] = path.name
    return {path.name: path.read_bytes()}


def settings_of(bundle: Bundle, path: Path, folder: Path) -> DictConfig:
    """The settings of a bundle, its files written to a folder. path: of the bundle, for errors."""
    for name, content in bundle.files.items():
        if Path(name).name != name or name.startswith("."):
            raise ValueError(f"{path}: holds a file named {name!r}, which is no plain name")
        (folder / name).write_bytes(content)
    for key in (*NEEDED, "data", "trainer"):
        if key not in bundle.settings:
            raise ValueError(f"{path}: its settings lack {key}; export it again")
        if key != "seed" and not isinstance(bundle.settings[key], dict):
            raise ValueError(f"{path}: its setting {key} is {bundle.settings[key]!r}; export it again")
    cfg = OmegaConf.create(bundle.settings)
    if cfg.part.get("mesh") in bundle.files:
        cfg.part.mesh = str(folder / cfg.part.mesh)
    return cfg
