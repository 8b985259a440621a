"""pnet-data: look after a data set: summary, check, repair, page of samples, conversion and export."""

import sys
from collections.abc import Iterable
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from pnet.cli.app import closest, hydra_value, run_app
from pnet.cli.data_exchange import convert, export
from pnet.cli.opened_set import Opened, open_set

if TYPE_CHECKING:
    from rich.console import Console

    from pnet.scenes.inspection import DataSet, Summary
    from pnet.scenes.protocol import CycleTask
    from pnet.scenes.verification import Fault, Verification

PAGE = "page.html"


ACTIONS = ("summary", "verify", "repair", "page", "convert", "export")


def main() -> None:
    """Entry point; `pnet-data convert …` says the same as `pnet-data action=convert …`."""
    if len(sys.argv) > 1 and sys.argv[1] in ACTIONS:
        sys.argv[1] = f"action={sys.argv[1]}"
    run_app(look_after, "data_set")


def look_after(cfg: DictConfig) -> None:
    """Do what `action` says."""
    if cfg.action not in ACTIONS:
        near = closest(str(cfg.action), list(ACTIONS))
        raise ValueError(f"action={cfg.action}: no such action{near}; choose {', '.join(ACTIONS)}")
    if cfg.action == "convert":
        convert(cfg)
        return
    actions = {"summary": summary, "verify": verify, "repair": repair, "page": page, "export": export}
    actions[cfg.action](cfg, open_set(Path(cfg.root), Path(cfg.piles)))


def summary(cfg: DictConfig, opened: Opened) -> None:
    """Print the tables; write the numbers where `output` says."""
    from pnet.engine.provenance import write_json
    from pnet.reporting.data_tables import rich_table, summary_sheets, summary_values

    found = count(opened)
    out = console()
    for sheet in summary_sheets(opened.settings, found):
        out.print(rich_table(sheet))
    out.print(text_of_reading(found))
    if cfg.output is not None:
        write_json(Path(cfg.output), summary_values(opened.settings, found))
        out.print(f"numbers: {cfg.output}", markup=False)


def verify(cfg: DictConfig, opened: Opened) -> None:
    """Print every fault; an error if there is one."""
    found, seconds = check(opened.data)
    out = console()
    print_faults(out, found.faults)
    what = (
        f"{found.files:,} files with {found.scenes:,} scenes and {found.piles:,} piles checked "
        f"in {seconds:.1f} s ({found.size / 1e6 / max(seconds, 1e-9):,.0f} MB/s)"
    )
    if not found.faults:
        out.print(f"{what}: no fault")
        return
    lasting = sum(fault.kind == "lasting" for fault in found.faults)
    remedy = f"to mend: pnet-data action=repair root={hydra_value(str(cfg.root))}"
    if lasting:
        others = f"; {remedy} for the others" if lasting < len(found.faults) else ""
        remedy = f"{lasting} cannot be mended by making files again{others}"
    raise ValueError(f"{cfg.root}: {counted(len(found.faults), 'fault')}; {what}; {remedy}")


def repair(cfg: DictConfig, opened: Opened) -> None:
    """Delete what is damaged and have pnet-generate make what is missing."""
    from pnet.engine.locks import hold

    data, out = opened.data, console()
    if "converted" in opened.settings:
        raise ValueError(
            f"{data.root}: was converted from another data set; delete what action=verify names as damaged "
            "and run action=convert again, which writes what is missing"
        )
    with hold(data.root, f"another process makes {data.root}"):
        found, _ = check(data)
        print_faults(out, found.faults)
        for fault in found.faults:
            if fault.kind == "damaged":
                fault.path.unlink()
                out.print(f"deleted {fault.path}", markup=False)
    gone = {fault.path for fault in found.faults if fault.kind != "lasting"}
    scenes = [task for task in data.tasks if data.scene_path(task) in gone]
    piles = [task for task in data.tasks if data.pile_path(task) in gone]
    make_again(cfg, data, scenes, piles, others_kept=not found.missing_piles, out=out)
    lasting = sum(fault.kind == "lasting" for fault in found.faults)
    if lasting:
        faults = counted(lasting, "fault")
        raise ValueError(f"{data.root}: {faults} cannot be mended by making files again; see the lines above")


def make_again(
    cfg: DictConfig,
    data: "DataSet",
    scenes: list["CycleTask"],
    piles: list["CycleTask"],
    others_kept: bool,
    out: "Console",
) -> None:
    """Have missing files made, and check them.

    Args:
        scenes, piles: tasks whose files are missing now. others_kept: whether all other piles are there; else
            only those are made again from which scenes are rendered, not every pile of the set.
    """
    from pnet.cli.data_set import run_generate
    from pnet.scenes.manifest import MANIFEST
    from pnet.scenes.verification import Verification, check_piles, check_scenes

    words = {"like": data.root / MANIFEST, "data.root": data.root, "data.piles": data.piles}
    overrides = [f"{key}={hydra_value(str(value))}" for key, value in words.items()]
    overrides.append(f"workers={hydra_value(cfg.workers)}")
    if others_kept and set(piles) - set(scenes):  # making scenes makes their piles too
        run_generate([*overrides, "stage=simulate"], data.root)
    if scenes:
        run_generate(overrides, data.root)
    made = Verification()
    for task in scenes:
        check_scenes(data, task, made)
    for task in piles:
        check_piles(data, task, made)
    if made.faults:
        print_faults(out, made.faults)
        raise ValueError(f"{data.root}: {counted(len(made.faults), 'fault')} in files that were made anew")
    again = len(piles) - len(made.missing_piles)
    out.print(f"made: {counted(len(scenes), 'file')} of scenes, {counted(again, 'file')} of piles")
    if made.missing_piles:
        out.print("other piles are not kept either, so damaged ones are made when their scenes are")


def page(cfg: DictConfig, opened: Opened) -> None:
    """Write the page of samples."""
    from pnet.reporting.data_page import DataPage, sample_scenes, scene_caption, truth_figure, write_data_page
    from pnet.reporting.data_tables import summary_sheets

    data = opened.data
    check_page_settings(cfg, data)
    splits = data.splits if cfg.split == "all" else [cfg.split]
    scenes = sample_scenes(data, splits, cfg.scenes)
    if not scenes:
        raise ValueError(
            f"{data.root}: no scenes of {' or '.join(splits)} there yet; pnet-data action=repair makes them"
        )
    found = count(opened)
    content = DataPage(
        title=f"pnet: data set {data.root.resolve().name}",
        subtitle=f"{data.root}, fingerprint {data.fingerprint}. {text_of_reading(found)}",
        sheets=summary_sheets(opened.settings, found),
        scenes=[(scene_caption(scene, data.part), truth_figure(scene, data.part)) for scene in scenes],
    )
    path = data.root / PAGE if cfg.output is None else Path(cfg.output)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_data_page(path, content)
    console().print(f"page of {counted(len(scenes), 'scene')}: {path}", markup=False)


def check_page_settings(cfg: DictConfig, data: "DataSet") -> None:
    """Refuse what no page can be made of, before anything is read."""
    from pnet.reporting.data_page import MOST_SCENES

    if type(cfg.scenes) is not int or not 1 <= cfg.scenes <= MOST_SCENES:
        raise ValueError(f"scenes={cfg.scenes}: expected 1 to {MOST_SCENES}, browsers draw no more at once")
    if cfg.split != "all" and cfg.split not in data.splits:
        raise ValueError(f"split={cfg.split}: {data.root} has {', '.join(data.splits)}, or all")


def count(opened: Opened) -> "Summary":
    """The summary, with a progress bar."""
    from pnet.reporting.progress import count_progress
    from pnet.scenes.inspection import summarise

    with count_progress("reading", len(opened.data.tasks), "files") as advance:
        return summarise(opened.data, advance)


def check(data: "DataSet") -> tuple["Verification", float]:
    """The check of everything, with a progress bar; and its seconds."""
    from pnet.reporting.progress import count_progress
    from pnet.scenes import verification

    start = perf_counter()
    with count_progress("checking", 2 * len(data.tasks), "files") as advance:
        found = verification.verify(data, advance)
    return found, perf_counter() - start


def text_of_reading(found: "Summary") -> str:
    """What a summary was counted from."""
    splits = found.splits.values()
    whole, scenes, bodies = (
        sum(getattr(split, name) for split in splits) for name in ("whole", "scenes", "instances")
    )
    return (
        f"Counted from the bodies of {counted(whole, 'file')}: {counted(scenes, 'scene')}, "
        f"{counted(bodies, 'instance')}; points were not read (action=verify reads everything)."
    )


def print_faults(out: "Console", faults: Iterable["Fault"]) -> None:
    """One line each."""
    for fault in faults:
        out.print(str(fault), markup=False, highlight=False)


def counted(number: int, what: str) -> str:
    """The number and its noun."""
    return f"{number:,} {what}{'' if number == 1 else 's'}"


def console() -> "Console":
    """Long lines stay lines."""
    from rich.console import Console

    return Console(soft_wrap=True)


if __name__ == "__main__":
    main()
