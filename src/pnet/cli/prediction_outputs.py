"""What pnet-predict leaves: files for every image, and a note of which are done."""

from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

if TYPE_CHECKING:
    from pnet.cli.estimator import Estimator
    from pnet.cli.prediction_inputs import Prepared, Reading
    from pnet.engine.depth_estimator import Estimate
    from pnet.records import Scene

DONE = ".pnet-predict"  # in the output folder: which images have results, and of what; no result itself


class Done:
    """Which images have results of these settings already.

    Args:
        folder: of the results. state: see `state_of`.
    """

    def __init__(self, folder: Path, state: str) -> None:
        from pnet.engine.provenance import read_json

        self._path, self._folder = folder / DONE, folder
        self._settings = state
        self._images: dict[str, Any] = {}
        if self._path.is_file():
            try:
                content = read_json(self._path)
                if content["settings"] == self._settings:
                    self._images = dict(content["images"])
            except (ValueError, LookupError, TypeError):
                pass  # then all are predicted again

    def has(self, path: Path) -> bool:
        """Whether an image's results are there and the image is as it was."""
        there = (self._folder / f"{path.stem}.json").is_file()
        return there and self._images.get(path.name) == self._state(path)

    def add(self, path: Path) -> None:
        """Note an image whose results are written."""
        from pnet.engine.provenance import write_json

        self._images[path.name] = self._state(path)
        write_json(self._path, {"settings": self._settings, "images": self._images})

    @staticmethod
    def _state(path: Path) -> list[int]:
        status = path.stat()
        return [status.st_size, status.st_mtime_ns]


def state_of(cfg: DictConfig, reading: "Reading", estimator: "Estimator") -> str:
    """Digest of all that results depend on besides the images: weights, settings, camera, background."""
    from pnet.cli.settings import RESOLVED
    from pnet.engine.checkpoints import NAME

    run = Path(cfg.run)
    files = [run / "checkpoints" / NAME, run / RESOLVED] if run.is_dir() else [run]
    image = cfg.background.get("image")
    files += [] if image is None else [Path(image)]
    kept: Any = OmegaConf.to_container(cfg, resolve=True)
    for key in ("run", "input", "output", "again", "rows", "threads", "batch", "camera"):
        kept.pop(key, None)
    if kept.get("ops") == "kernels":  # as in results of before this setting
        kept.pop("ops")
    told = (OmegaConf.to_yaml(kept), repr(reading), repr(estimator.background), repr(estimator.points))
    contents = [file.read_bytes() for file in files if file.is_file()]
    return sha256(b"\0".join([*contents, *map(str.encode, told)])).hexdigest()[:16]


def check_outputs(output: Path, inputs: Sequence[Path], others: Sequence[Path]) -> None:
    """Refuse to write results over what they are made from."""
    kept = {path.resolve() for path in (*inputs, *others)}
    for path in inputs:
        for ending in (".json", ".csv", ".png", ".html"):
            result = (output / f"{path.stem}{ending}").resolve()
            if result in kept:
                raise ValueError(
                    f"output={output}: {result.name} would be written over; choose another folder"
                )


class Writer:
    """Writes an image's results: JSON and CSV always, picture and page as asked.

    Args:
        cfg: the settings of pnet-predict. output: the folder. alone: whether there is one image only.
    """

    def __init__(self, cfg: DictConfig, output: Path, alone: bool) -> None:
        wishes = (cfg.picture, cfg.page)
        self._picture, self._page = (alone if wish is None else bool(wish) for wish in wishes)
        self._output, self._run = output, str(cfg.run)

    def write(self, prepared: "Prepared", estimate: "Estimate") -> dict[str, float]:
        """Write the files; the JSON last. Seconds by stage, writing included."""
        from pnet.data.export.results import write_sileane_results
        from pnet.reporting.overlay import overlay_picture
        from pnet.reporting.prediction_tables import write_detections_csv

        start, name, part = perf_counter(), prepared.path.stem, estimate.part
        self._output.mkdir(parents=True, exist_ok=True)
        picture = self._output / f"{name}.png"
        write_detections_csv(picture.with_suffix(".csv"), estimate.detections, part)
        if self._picture or self._page:
            overlay_picture(
                prepared.depth,
                estimate.cloud.camera,
                estimate.cloud.points,
                estimate.detections,
                part,
                picture,
                prepared.path.name,
            )
        seconds = {**estimate.seconds, "writing": perf_counter() - start}
        if self._page:
            self._write_page(prepared, estimate, picture, seconds)
        write_sileane_results(self._output, [name], [estimate.detections], part.parameter_names)
        return {**estimate.seconds, "writing": perf_counter() - start}

    def _write_page(
        self, prepared: "Prepared", estimate: "Estimate", picture: Path, seconds: dict[str, float]
    ) -> None:
        from pnet.reporting.prediction_page import PredictionPage, camera_text, write_prediction_page

        cloud = estimate.cloud
        facts = [
            ("run", self._run),
            ("input", str(prepared.path)),
            ("camera", camera_text(cloud.camera)),
            ("points", f"{cloud.measured:,} measured, {cloud.kept:,} not background"),
        ]
        content = PredictionPage(
            title=f"pnet: {estimate.part.name.upper()} in {prepared.path.name}",
            facts=facts,
            seconds=seconds,
            picture=picture.read_bytes(),
            scene=untold_scene(estimate),
            detections=estimate.detections,
            part=estimate.part,
        )
        write_prediction_page(picture.with_suffix(".html"), content)


def untold_scene(estimate: "Estimate") -> "Scene":
    """The points that were looked at as a scene of which no truth is known."""
    from pnet.geometry.camera import Camera
    from pnet.records import Scene, SceneId

    points, none = estimate.cloud.points, np.zeros(0)
    return Scene(
        points=points,
        instance=np.full(len(points), -1),
        R=np.zeros((0, 3, 3)),
        t=np.zeros((0, 3)),
        parameters=np.zeros((0, estimate.part.k)),
        visibility=none,
        occlusion=none,
        camera=estimate.cloud.camera or Camera(1, 1, 1.0, 1.0, 0.0, 0.0),
        part=estimate.part.name,
        id=SceneId("input", "image", 0, 0, 0),
    )
