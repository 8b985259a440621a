"""pnet-generate: make a data set."""

import json
from collections import Counter
from contextlib import nullcontext
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, ListConfig, OmegaConf

from pnet.cli.app import key_of, run_app

if TYPE_CHECKING:
    from pnet.parts.base import ParametricPart
    from pnet.scenes.generation import Plan, Summary
    from pnet.scenes.protocol import CycleTask, Protocol

# what decides a pile's and a scene's bytes; the rest (workers, folders) does not
PILING = ("part", "protocol", "bin", "physics", "clutter", "seed")
MAKING = (*PILING, "camera", "view", "noise", "noise_in")


def main() -> None:
    """Entry point."""
    run_app(generate_data, "generate")


def generate_data(cfg: DictConfig) -> None:
    """Make what is missing of the data set, with a progress bar and a summary."""
    from pnet.engine.locks import hold

    check_values(cfg)
    if cfg.like is not None:
        cfg = like(cfg)
    plan = build_plan(cfg)
    piles = plan.factory.piles
    check_overrides(cfg, piles.part.name)
    tasks = plan_tasks(piles.part, piles.protocol)  # may refuse the settings, so before anything is written
    mine = take_share(tasks, cfg.shard)
    # shares of other machines meet on a shared disk, where locks cannot be trusted; files come by renaming
    waiting = f"another process makes {plan.scenes}"
    with hold(plan.scenes, waiting) if cfg.shard is None else nullcontext():
        open_folders(cfg, plan, tasks)
        make_missing(cfg, plan, mine)


def check_values(cfg: DictConfig) -> None:
    """Refuse wrong values before anything is written."""
    from pnet.scenes.limits import require_number
    from pnet.scenes.protocol import SPLITS

    require_number("seed", cfg.seed, 0)
    if cfg.workers is not None:
        require_number("workers", cfg.workers, 0)
    if not isinstance(cfg.noise_in, ListConfig) or not set(cfg.noise_in) <= set(SPLITS):
        raise ValueError(f"noise_in is {cfg.noise_in}, expected a list out of {', '.join(SPLITS)}")
    if Path(cfg.data.piles).resolve() == Path(cfg.data.root).resolve():
        raise ValueError(
            f"data.piles and data.root are both {cfg.data.root}: piles need a folder of their own"
        )


def check_overrides(cfg: DictConfig, part: str) -> None:
    """Refuse changes of the protocol that would have no say, because it has others for this part."""
    own = cfg.protocol.get("by_part") or {}
    for word in given_overrides():
        key = key_of(word)
        changed = key.removeprefix("protocol.").split(".")[0]
        if key.startswith("protocol.") and changed in (own.get(part) or {}):
            rest = key.removeprefix("protocol.")
            raise ValueError(
                f"{key}: for {part} this protocol has its own; set protocol.by_part.{part}.{rest}"
            )


def given_overrides() -> list[str]:
    """The words of the command line."""
    return list(HydraConfig.get().overrides.task) if HydraConfig.initialized() else []


def like(cfg: DictConfig) -> DictConfig:
    """The settings that made another data set, with this one's folder and workers."""
    path = Path(cfg.like)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; like= takes a dataset.json")
    given = {key_of(word) for word in given_overrides()}
    for key in sorted(given - {"like", "data.root", "data.piles", "workers", "stage", "shard"}):
        raise ValueError(f"{key} has no say beside like={path}, which takes all settings from there")
    if given and "data.root" not in given:
        raise ValueError(f"like={path}: say with data.root= where the scenes shall be")
    try:
        made = {key: json.loads(path.read_text())[key] for key in MAKING}
    except KeyError as fault:
        raise ValueError(f"{path}: made by an older pnet, it lacks {fault}; make the data anew") from fault
    except (ValueError, TypeError) as fault:
        raise ValueError(f"{path}: not a data set's manifest ({fault})") from fault
    rest = {key: cfg[key] for key in ("data", "workers", "stage", "shard")}
    return OmegaConf.create({**made, **rest})


def take_share(tasks: list["CycleTask"], shard: str | None) -> list["CycleTask"]:
    """Every n-th task, from the k-th on, for shard="k/n"; all for None."""
    if shard is None:
        return tasks
    first, _, count = str(shard).partition("/")
    if not (first.isdigit() and count.isdigit() and 1 <= int(first) <= int(count)):
        raise ValueError(f"shard={shard}: expected a number and a count, from 1/8 to 8/8 for eight shares")
    return tasks[int(first) - 1 :: int(count)]


def open_folders(cfg: DictConfig, plan: "Plan", tasks: list["CycleTask"]) -> None:
    """Create the folders of the stages with their manifests, or check the manifests that are there."""
    from pnet.scenes.generation import check_root, open_root
    from pnet.scenes.manifest import MANIFEST, read_manifest

    settings = making_settings(cfg)
    piles, scenes = (manifest_of(part, tasks) for part in (piling_settings(settings), settings))
    if (plan.piles / MANIFEST).exists() and "camera" in read_manifest(plan.piles):
        raise ValueError(f"data.piles={plan.piles}: holds scenes; its piles are in {plan.piles / 'piles'}")
    if plan.stage == "render":
        read_manifest(plan.piles, "run pnet-generate stage=simulate first, or name another data.piles")
    if plan.stage != "simulate":
        check_root(plan.scenes, scenes)  # before anything is written
    open_root(plan.piles, piles, "data.piles")
    if plan.stage != "simulate":
        open_root(plan.scenes, scenes)


def make_missing(cfg: DictConfig, plan: "Plan", tasks: list["CycleTask"]) -> None:
    """Make the files that are not there, with a progress bar and a summary."""
    from pnet.reporting.progress import scene_progress
    from pnet.scenes.generation import Summary, generate
    from pnet.scenes.workers import cores

    workers = cores() if cfg.workers is None else cfg.workers
    summary, start = Summary(), perf_counter()
    with scene_progress(len(tasks), len(plan.factory.piles.protocol.scene_drops())) as advance:
        for report in generate(plan, tasks, workers):
            if report is None:
                summary.kept += 1
            else:
                summary.add(report)
            advance(report is not None)
    summary.seconds = perf_counter() - start
    print_summary(plan, summary)


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
    part = instantiate(cfg.part)
    tasks = plan_tasks(part, instantiate(cfg.protocol).for_part(part.name))
    if read_manifest(root) != manifest_of(making_settings(cfg), tasks):
        return False
    return all(cycle_path(root, task).is_file() for task in tasks)


def making_settings(cfg: DictConfig) -> dict[str, Any]:
    """The settings that decide what the scenes are, as plain values."""
    settings = OmegaConf.to_container(OmegaConf.masked_copy(cfg, list(MAKING)), resolve=True)
    assert isinstance(settings, dict)
    return {str(key): value for key, value in settings.items()}


def piling_settings(settings: dict[str, Any]) -> dict[str, Any]:
    """Of the settings those that decide what the piles are."""
    kept = {key: settings[key] for key in PILING}
    protocol = {key: value for key, value in kept["protocol"].items() if key not in ("name", "points")}
    return {**kept, "protocol": protocol}


def build_plan(cfg: DictConfig) -> "Plan":
    """What to make where, out of the config."""
    from pnet.cli.instantiate import instantiate
    from pnet.scenes.factory import SceneFactory
    from pnet.scenes.generation import Plan
    from pnet.scenes.manifest import settings_fingerprint
    from pnet.scenes.pile_factory import PileFactory
    from pnet.scenes.view_factory import ViewFactory

    settings = making_settings(cfg)
    part = instantiate(cfg.part)
    protocol = instantiate(cfg.protocol).for_part(part.name)
    piles = PileFactory(
        part=part,
        protocol=protocol,
        box=instantiate(cfg.bin),
        physics=instantiate(cfg.physics),
        clutter=instantiate(cfg.clutter),
        seed=cfg.seed,
        fingerprint=settings_fingerprint(piling_settings(settings)),
    )
    views = ViewFactory(
        part, instantiate(cfg.camera), instantiate(cfg.view), instantiate(cfg.noise), protocol.points
    )
    factory = SceneFactory(piles, views, settings_fingerprint(settings), tuple(cfg.noise_in))
    return Plan(factory, Path(cfg.data.piles), Path(cfg.data.root), cfg.stage)


def print_summary(plan: "Plan", summary: "Summary") -> None:
    """What was made, how fast, and what went wrong with it."""
    from rich.console import Console

    out = Console(soft_wrap=True)
    what, where = ("piles", plan.piles) if plan.stage == "simulate" else ("data set", plan.scenes)
    out.print(f"{summary.made} cycles made, {summary.kept} were there; {what} in {where}")
    if not summary.scenes:
        return
    if summary.simulated < summary.made and plan.stage == "all":
        out.print(f"the piles of {summary.made - summary.simulated} of these cycles were there")
    rate = summary.scenes / summary.seconds
    out.print(f"{summary.scenes} scenes in {summary.seconds:.1f} s: {rate:.1f} scenes/s")
    stages = vars(summary.times).items()
    times = ", ".join(f"{name} {1000 * s / summary.scenes:.1f}" for name, s in stages if s)
    out.print(f"milliseconds a scene and worker: {times}")
    out.print(
        f"{summary.escaped} bodies left the bin and were removed, {summary.unsettled} scenes were not "
        f"at rest in time, {summary.empty} scenes showed no body and were left out"
    )


if __name__ == "__main__":
    main()
