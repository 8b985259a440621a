"""pnet-data's ways in and out: any data set into pnet's store, and the store into other projects' layouts."""

from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from pnet.cli.app import closest
from pnet.cli.opened_set import Opened

if TYPE_CHECKING:
    from pnet.data.export.depth_view import Imaging
    from pnet.parts.base import ParametricPart

LAYOUTS = ("sileane", "bop")


def convert(cfg: DictConfig) -> None:
    """Write the scenes of the data set `data` into a store in `root`; what is there already stays."""
    from rich.console import Console

    from pnet.cli.build import open_source
    from pnet.cli.instantiate import instantiate
    from pnet.data.conversion import conversion_manifest, plan_conversion
    from pnet.data.conversion import convert as convert_all
    from pnet.engine.locks import hold
    from pnet.reporting.progress import count_progress
    from pnet.scenes.protocol import SPLITS
    from pnet.scenes.workers import cores

    if cfg.get("part") is None or cfg.get("data") is None:
        raise ValueError(
            "action=convert needs part=, what the scenes show, and data=sileane, ipa or parametric"
        )
    if cfg.split not in ("all", *SPLITS):
        raise ValueError(f"split={cfg.split}: choose {', '.join(SPLITS)}, or all")
    root, part = Path(cfg.root), instantiate(cfg.part)
    plan = plan_conversion(open_source(cfg.data), part, root)
    splits = list(plan.sets) if cfg.split == "all" else [str(cfg.split)]
    if not set(splits) <= set(plan.sets):
        raise ValueError(f"split={cfg.split}: the data set has {', '.join(plan.sets)}")
    settings: Any = OmegaConf.to_container(cfg.part, resolve=True)
    manifest = conversion_manifest(plan, settings)
    workers = cores() if cfg.workers is None else cfg.workers
    start, scenes, empty, kept = perf_counter(), 0, 0, 0
    with (
        hold(root, f"another process makes {root}"),
        count_progress("converting", sum(len(plan.sets[name]) for name in splits), "scenes") as advance,
    ):
        for cycle, report in convert_all(plan, manifest, workers, splits):
            kept += report is None
            if report is not None:
                scenes, empty = scenes + report.scenes, empty + report.empty
            advance(len(cycle.places))
    seconds = perf_counter() - start
    out = Console(soft_wrap=True)
    out.print(
        f"{scenes} scenes written in {seconds:.1f} s ({scenes / seconds:.1f} scenes/s), {empty} showed no "
        f"body and were left out, {kept} cycles were there; data set in {root}"
    )
    for split in splits:
        print_agreement(out, root, split, part)
    use = "pnet-train part=…" if "train" in splits else "pnet-evaluate run=…"
    out.print(f"next: {use} data.root={root}, or pnet-data root={root}", markup=False)


def print_agreement(out: Any, root: Path, split: str, part: "ParametricPart") -> None:
    """Say whether points and poses of a split's fullest scene go together."""
    from pnet.data.agreement import agreement
    from pnet.data.source import StoredData

    scenes = StoredData(root).scenes(split, part)
    fullest = max(range(len(scenes)), key=lambda i: scenes.ids[i].drop)
    try:
        found = agreement(scenes[fullest], part)
    except ValueError as fault:
        out.print(f"{scenes.ids[fullest]}: its poses cannot be right: {fault}", markup=False)
        return
    text = (
        f"{scenes.ids[fullest]}: {found.share:.0%} of the points fall on their own body at its true pose, "
        f"{1000 * found.gap:.2f} mm from its surface in the median"
    )
    doubt = "" if found.is_good else "; are part=, data.source.frame and the data set's conventions right?"
    out.print(text + doubt, markup=False)


def export(cfg: DictConfig, opened: Opened) -> None:
    """Write the scenes of a store, and results where they are given, in another project's layout."""
    from rich.console import Console

    from pnet.data.export.bop import export_bop
    from pnet.data.export.sileane import export_sileane
    from pnet.data.source import StoredData
    from pnet.reporting.progress import count_progress

    if cfg.output is None:
        raise ValueError("action=export needs output=, a folder")
    if cfg.layout not in LAYOUTS:
        near = closest(str(cfg.layout), list(LAYOUTS))
        raise ValueError(f"layout={cfg.layout}: no such layout{near}; choose {', '.join(LAYOUTS)}")
    data, out, output = opened.data, Console(soft_wrap=True), Path(cfg.output)
    if cfg.split not in ("all", *data.splits):
        raise ValueError(f"split={cfg.split}: {data.root} has {', '.join(data.splits)}, or all")
    imaging = imaging_of(opened, out)
    write = export_sileane if cfg.layout == "sileane" else export_bop
    for split in data.splits if cfg.split == "all" else [cfg.split]:
        scenes = StoredData(data.root).scenes(split, data.part)
        with count_progress(f"exporting {split}", len(scenes), "scenes") as advance:
            # Siléane's names do not tell the split, and BOP has one set of objects and one test split
            shared = cfg.layout == "bop" and split != "test_g"
            folder = output if shared else output / split
            written = write(scenes, data.part, folder, imaging, advance)
        folders = [written] if isinstance(written, Path) else written
        out.print(f"{len(scenes)} scenes: {', '.join(map(str, folders))}", markup=False)


def imaging_of(opened: Opened, out: Any) -> "Imaging":
    """How a set's depth images are made: with the noise and the bin that its manifest tells of."""
    from pnet.cli.opened_set import built
    from pnet.data.export.background import Background
    from pnet.data.export.depth_view import Imaging
    from pnet.scenes.manifest import MANIFEST
    from pnet.scenes.noise import NoNoise
    from pnet.scenes.pile import Bin
    from pnet.scenes.viewpoints import Viewpoints

    settings, path = opened.settings, opened.data.root / MANIFEST
    if "converted" in settings:
        out.print(
            "images are rendered from the part, not the sensor's own; there is no bin behind the bodies"
        )
        return Imaging()
    box = built(path, "bin", settings["bin"], Bin)
    viewpoints = built(path, "view", settings["view"], Viewpoints)
    noise = built(path, "noise", settings["noise"], object) if settings["noise_in"] else NoNoise()
    try:
        background = Background.seen_from(viewpoints, box)
    except ValueError as fault:
        out.print(f"no bin behind the bodies: {fault}", markup=False)
        background = None
    return Imaging(noise, background, int(settings["seed"]))
