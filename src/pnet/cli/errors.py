"""pnet-errors: what an evaluated run gets wrong, and where."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from pnet.cli.app import run_app
from pnet.cli.settings import read_run

if TYPE_CHECKING:
    from pnet.data.source import SceneSet
    from pnet.metrics.breakdown import Breakdown
    from pnet.parts.base import ParametricPart
    from pnet.records import Detections, Scene

SUMMARY, TRUTHS, RESULTS, FIGURE = "errors.json", "instances.csv", "results.csv", "errors.png"


def main() -> None:
    """Entry point."""
    run_app(errors, "errors")


def errors(cfg: DictConfig) -> None:
    """Write summary, rows, figure and the worst scenes into the evaluation's folder errors; print tables."""
    from rich.console import Console

    from pnet.cli.build import part_of
    from pnet.cli.evaluate import PREDICTIONS
    from pnet.cli.instantiate import instantiate
    from pnet.engine.predictions import read_predictions
    from pnet.metrics.breakdown import break_down
    from pnet.reporting.breakdown_summary import error_table, outcome_table, summary, wrong_pose_line

    if cfg.worst < 0:
        raise ValueError(f"worst={cfg.worst}: expected at least 0")
    run = Path(cfg.run)
    trained, evaluation = read_run(run), run / "evaluation" / cfg.evaluation
    header, found = read_predictions(evaluation / PREDICTIONS)
    part, choice = part_of(trained), instantiate(trained.data.targets).choice
    scenes, places = evaluated_scenes(cfg, trained, header.split, header.data, header.scenes)
    breakdown = break_down(part, choice, (scenes[i] for i in places), found)
    told = summary(breakdown, part, header.scenes)
    folder = evaluation / "errors"
    folder.mkdir(exist_ok=True)
    shown = worst_scenes(breakdown, header.scenes, cfg.worst)
    drawn = draw_worst(breakdown, part, shown, lambda i: scenes[places[i]], found, folder)
    told["worst_scenes"] = [{"scene": header.scenes[i], "picture": name} for i, name in drawn]
    write_errors(breakdown, part, told, header.scenes, folder)
    out = Console(soft_wrap=True)
    out.print(outcome_table(told))
    out.print(error_table(told))
    out.print(wrong_pose_line(told), markup=False, highlight=False)
    out.print(f"written to {folder}: {FIGURE}, {SUMMARY}, {TRUTHS}, {RESULTS}", markup=False)
    for i, name in drawn:
        out.print(f"{folder / name}: {header.scenes[i]}", markup=False)


def evaluated_scenes(
    cfg: DictConfig, trained: DictConfig, split: str, data: str, ids: list[str]
) -> tuple["SceneSet", list[int]]:
    """The split's scenes, and where in it each of the predicted ones stands."""
    from pnet.cli.evaluate import predicted_scenes

    scenes = predicted_scenes(cfg, trained, split, data)
    place = {str(scene_id): i for i, scene_id in enumerate(scenes.ids)}
    lacking = [name for name in ids if name not in place]
    if lacking:
        raise ValueError(
            f"{cfg.data.root or trained.data.root}: has no scene {lacking[0]}, of which there are "
            f"predictions ({len(lacking)} such of {len(ids)}); evaluate again"
        )
    return scenes, [place[name] for name in ids]


def worst_scenes(breakdown: "Breakdown", ids: list[str], most: int) -> list[int]:
    """Of so many cycles the scene with the most true poses not found; of several that with the larger share.

    Neighbouring scenes of a cycle differ by one body, so one of each is enough.
    """
    import numpy as np

    from pnet.metrics.outcomes import Outcome

    truths, scenes = breakdown.truths, len(breakdown.matches)
    lost = np.bincount(truths.scene[truths.fate.outcome != Outcome.FOUND], minlength=scenes)
    share = lost / np.maximum(np.bincount(truths.scene, minlength=scenes), 1)
    worst: dict[str, int] = {}
    for i in np.lexsort((-share, -lost)).tolist():
        if lost[i]:
            worst.setdefault(ids[i].rsplit("/", 1)[0], i)
    return list(worst.values())[:most]


def draw_worst(
    breakdown: "Breakdown",
    part: "ParametricPart",
    shown: list[int],
    scene: "Callable[[int], Scene]",
    found: "list[Detections]",
    folder: Path,
) -> list[tuple[int, str]]:
    """Draw the scenes shown; their places and the files' names. Pictures of before are taken away."""
    from pnet.metrics.breakdown import taken
    from pnet.reporting.failure_picture import failure_picture

    for old in folder.glob("worst_*.png"):
        old.unlink()
    drawn = []
    for rank, i in enumerate(shown, 1):
        truths = taken(breakdown.truths, breakdown.truths.scene == i)
        results = taken(breakdown.results, breakdown.results.scene == i)
        failure_picture(scene(i), found[i], truths, results, part, folder / f"worst_{rank}.png")
        drawn.append((i, f"worst_{rank}.png"))
    return drawn


def write_errors(
    breakdown: "Breakdown", part: "ParametricPart", told: dict[str, object], ids: list[str], folder: Path
) -> None:
    """Figure, rows and summary; each file appears when it is whole."""
    from pnet.engine.provenance import write_json
    from pnet.reporting.breakdown_rows import csv_text, result_table, truth_table
    from pnet.reporting.error_figure import error_picture
    from pnet.scenes.record_file import write_atomically

    error_picture(breakdown, part, told, folder / FIGURE)
    write_atomically(folder / TRUTHS, csv_text(truth_table(breakdown, part, ids)).encode())
    write_atomically(folder / RESULTS, csv_text(result_table(breakdown, ids)).encode())
    write_json(folder / SUMMARY, told)


if __name__ == "__main__":
    main()
