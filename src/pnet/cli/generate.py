"""pnet-generate: make a data set."""

import json
import os
from collections import Counter
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from pnet.cli.app import run_app

if TYPE_CHECKING:
    from pnet.parts.base import ParametricPart
    from pnet.scenes.factory import SceneFactory
    from pnet.scenes.generation import Summary
    from pnet.scenes.protocol import CycleTask, Protocol

# what decides a scene's bytes; the rest (workers, folders) does not
MAKING = ("part", "protocol", "camera", "bin", "physics", "seed", "camera_height", "clutter_spacing")


def main() -> None:
    """Entry point."""
    run_app(generate_data, "generate")


def generate_data(cfg: DictConfig) -> None:
    """Make what is missing of the data set, with a progress bar and a summary."""
    from pnet.engine.locks import hold

    if cfg.like is not None:
        cfg = like(cfg)
    settings = making_settings(cfg)
    factory = build_factory(cfg, settings)
    tasks = plan_tasks(
        factory.part, factory.protocol
    )  # may refuse the settings, so before anything is written
    root = Path(cfg.data.root)
    with hold(root, f"another process makes {root}"):
        make_missing(cfg, factory, manifest_of(settings, tasks), tasks, root)


def like(cfg: DictConfig) -> DictConfig:
    """The settings that made another data set, with this one's folder and workers."""
    path = Path(cfg.like)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; like= takes a dataset.json")
    try:
        made = {key: json.loads(path.read_text())[key] for key in MAKING}
    except (ValueError, KeyError, TypeError) as fault:
        raise ValueError(f"{path}: not a data set's manifest ({fault})") from fault
    rest = {key: cfg[key] for key in ("data", "workers")}
    return OmegaConf.create({**made, **rest})


def make_missing(
    cfg: DictConfig, factory: "SceneFactory", manifest: dict[str, Any], tasks: list["CycleTask"], root: Path
) -> None:
    """Make the files that are not there, with a progress bar and a summary."""
    from pnet.reporting.progress import scene_progress
    from pnet.scenes.generation import Summary, generate, open_root

    open_root(root, manifest)
    workers = os.cpu_count() or 1 if cfg.workers is None else cfg.workers
    summary, start = Summary(), perf_counter()
    with scene_progress(len(tasks), len(factory.protocol.scene_drops())) as advance:
        for report in generate(factory, root, tasks, workers):
            if report is None:
                summary.kept += 1
            else:
                summary.add(report)
            advance(report is not None)
    summary.seconds = perf_counter() - start
    print_summary(root, summary)


def plan_tasks(part: "ParametricPart", protocol: "Protocol") -> list["CycleTask"]:
    """Every file of a part's data set."""
    from pnet.parts.spread import spread_order

    return protocol.tasks({name: spread_order(grid) for name, grid in part.grids.items()})


def manifest_of(settings: dict[str, Any], tasks: list["CycleTask"]) -> dict[str, Any]:
    """What the data set's manifest says: settings, and how many files there are, so that none is missed."""
    return {**settings, "files": dict(Counter(task.split for task in tasks))}


def is_complete(cfg: DictConfig) -> bool:
    """Whether the data set of these settings is there with all its files."""
    from pnet.cli.instantiate import instantiate
    from pnet.scenes.generation import cycle_path
    from pnet.scenes.manifest import MANIFEST, read_manifest

    root = Path(cfg.data.root)
    if not (root / MANIFEST).is_file():
        return False
    tasks = plan_tasks(instantiate(cfg.part), instantiate(cfg.protocol))
    if read_manifest(root) != manifest_of(making_settings(cfg), tasks):
        return False
    return all(cycle_path(root, task).is_file() for task in tasks)


def making_settings(cfg: DictConfig) -> dict[str, Any]:
    """The settings that decide what the scenes are, as plain values."""
    settings = OmegaConf.to_container(OmegaConf.masked_copy(cfg, list(MAKING)), resolve=True)
    assert isinstance(settings, dict)
    return {str(key): value for key, value in settings.items()}


def build_factory(cfg: DictConfig, settings: dict[str, Any]) -> "SceneFactory":
    """Everything that scenes are made from, out of the config."""
    from pnet.cli.instantiate import instantiate
    from pnet.scenes.factory import SceneFactory
    from pnet.scenes.manifest import settings_fingerprint

    return SceneFactory(
        part=instantiate(cfg.part),
        protocol=instantiate(cfg.protocol),
        camera=instantiate(cfg.camera),
        box=instantiate(cfg.bin),
        physics=instantiate(cfg.physics),
        camera_height=cfg.camera_height,
        clutter_spacing=cfg.clutter_spacing,
        seed=cfg.seed,
        fingerprint=settings_fingerprint(settings),
    )


def print_summary(root: Path, summary: "Summary") -> None:
    """What was made, how fast, and what went wrong with it."""
    from rich.console import Console

    out = Console(soft_wrap=True)
    out.print(f"{summary.made} cycles made, {summary.kept} were there; data set in {root}")
    if not summary.scenes:
        return
    rate = summary.scenes / summary.seconds
    out.print(f"{summary.scenes} scenes in {summary.seconds:.1f} s: {rate:.1f} scenes/s")
    stages = vars(summary.times).items()
    times = ", ".join(f"{name} {1000 * s / summary.scenes:.0f}" for name, s in stages)
    out.print(f"milliseconds a scene and worker: {times}")
    out.print(
        f"{summary.escaped} bodies left the bin and were removed, {summary.unsettled} scenes were not "
        f"at rest in time, {summary.empty} scenes showed no body and were left out"
    )


if __name__ == "__main__":
    main()
