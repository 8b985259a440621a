"""pnet-report: one HTML page and a picture of an evaluated run."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from pnet.cli.app import run_app
from pnet.cli.settings import read_run

if TYPE_CHECKING:
    from pnet.data.source import SceneSet
    from pnet.parts.base import ParametricPart
    from pnet.records import Detections


def main() -> None:
    """Entry point."""
    run_app(report, "report")


def report(cfg: DictConfig) -> None:
    """Write report.html and scene.png into the run's report folder; print their paths and the metrics."""
    from rich.console import Console

    from pnet.cli.evaluate import PREDICTIONS, predicted_scenes
    from pnet.cli.instantiate import instantiate
    from pnet.engine.predictions import read_predictions
    from pnet.engine.provenance import read_json
    from pnet.reporting.page import write_page
    from pnet.reporting.picture import scene_picture
    from pnet.reporting.tables import metrics_table

    if cfg.scenes < 1:
        raise ValueError(f"scenes={cfg.scenes}: expected at least 1")
    run = Path(cfg.run)
    trained, evaluation = read_run(run), run / "evaluation" / cfg.evaluation
    metrics = read_json(evaluation / "metrics.json")
    header, found = read_predictions(evaluation / PREDICTIONS)
    part = instantiate(trained.part)
    scenes = predicted_scenes(cfg, trained, header.split, header.data)
    shown = pick_scenes(header.scenes, cfg.scenes)
    folder = run / "report"
    folder.mkdir(exist_ok=True)
    index = scene_index(scenes, header.scenes[shown[0]])
    scene_picture(scenes[index], found[shown[0]], part, folder / "scene.png")
    curve = read_json(evaluation / "curve.json")
    content = page_content(run, trained, metrics, curve, part, scenes, header.scenes, found, shown)
    write_page(folder / "report.html", content)
    out = Console(soft_wrap=True)
    out.print(metrics_table(metrics))
    out.print(f"report: {folder / 'report.html'}\npicture: {folder / 'scene.png'}")


def pick_scenes(ids: list[str], count: int) -> list[int]:
    """Indices of the fullest scene of `count` cycles, spread over all cycles."""
    fullest: dict[str, int] = {}
    for index, name in enumerate(ids):
        fullest[name.rsplit("/", 1)[0]] = index  # scenes of a cycle stand in the order of drops
    cycles = list(fullest.values())
    count = min(count, len(cycles))
    return [cycles[round(i * (len(cycles) - 1) / max(count - 1, 1))] for i in range(count)]


def scene_index(scenes: "SceneSet", name: str) -> int:
    """Where a scene stands in the split."""
    return [str(scene_id) for scene_id in scenes.ids].index(name)


def page_content(
    run: Path,
    trained: DictConfig,
    metrics: dict[str, Any],
    curve: dict[str, Any],
    part: "ParametricPart",
    scenes: "SceneSet",
    ids: list[str],
    found: "list[Detections]",
    shown: list[int],
) -> Any:
    """Everything that the page tells."""
    from pnet.engine.provenance import read_json
    from pnet.reporting.page import PageContent
    from pnet.reporting.scene_view import scene_figure
    from pnet.reporting.tables import headline_rows
    from pnet.reporting.training_curves import curve_figure, read_scalars, training_figure

    figures = []
    for index in shown:
        scene = scenes[scene_index(scenes, ids[index])]
        caption = f"{ids[index]}: {len(scene.R)} bodies, {len(found[index].score)} found"
        figures.append((caption, scene_figure(scene, found[index], part)))
    state = read_json(run / "provenance.json")
    rows = [(key, value if isinstance(value, str) else json.dumps(value)) for key, value in state.items()]
    return PageContent(
        title=f"pnet: {part.name.upper()}",
        subtitle=f"{len(ids)} scenes of {ids[0].split('/')[0]}, run {run}",
        metrics=headline_rows(metrics),
        scenes=figures,
        precision_recall=curve_figure(curve["precision"], curve["recall"], metrics.get("AP")),
        training=training_figure(read_scalars(run / "tensorboard")),
        settings=OmegaConf.to_yaml(trained),
        provenance=rows,
    )


if __name__ == "__main__":
    main()
