"""pnet-predict: find parts in a user's own depth images and clouds."""

import statistics
import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from pnet.cli.app import EXPECTED, error_text, run_app
from pnet.cli.prediction_inputs import camera_words
from pnet.cli.pretrained import part_words, with_run

if TYPE_CHECKING:
    from rich.console import Console

    from pnet.cli.estimator import Estimator
    from pnet.cli.prediction_inputs import DepthCoding, Prepared, Reading
    from pnet.cli.prediction_outputs import Done, Writer
    from pnet.data.background import Background
    from pnet.engine.depth_estimator import Estimate

NOTHING = (
    "nothing was found: are camera=, depth.scale= and background= right? postprocess.visibility_threshold "
    "and postprocess.cluster decide what counts"
)


def main() -> None:
    """Entry point."""
    sys.argv[1:] = part_words(camera_words(sys.argv[1:]))
    run_app(predict, "predict")


@dataclass
class Tally:
    """What a stream of images came to.

    Attributes:
        images, found: predicted now. kept: had results already. failed: a line about each that could not be.
        seconds: of every image, by stage.
    """

    images: int = 0
    found: int = 0
    kept: int = 0
    failed: list[str] = field(default_factory=list)
    seconds: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))

    def add(self, estimate: "Estimate", seconds: dict[str, float]) -> None:
        """Count one image."""
        self.images += 1
        self.found += len(estimate)
        for stage, value in seconds.items():
            self.seconds[stage].append(value)

    @property
    def medians(self) -> dict[str, float]:
        """Seconds of each stage, the median over the images."""
        return {stage: statistics.median(values) for stage, values in self.seconds.items()}


def predict(cfg: DictConfig) -> None:
    """Predict an image, or a folder of them as a stream."""
    import torch
    from rich.console import Console

    from pnet.cli.prediction_inputs import build_reading, chosen_camera, find_inputs
    from pnet.cli.prediction_outputs import Done, Writer, check_outputs, state_of

    check_values(cfg)
    cfg = with_run(cfg)
    if cfg.threads is not None:
        torch.set_num_threads(cfg.threads)
    others = other_files(cfg)
    inputs = find_inputs(Path(cfg.input), cfg.kind, others)
    output, out = Path(cfg.output), Console(soft_wrap=True)
    check_outputs(output, inputs, others)
    estimator = load(cfg)
    file = chosen_camera(cfg)
    if file is not None and file.distorted:
        print(
            "the camera has a lens distortion, which pnet does not know: are the images rectified?",
            file=sys.stderr,
        )
    reading = build_reading(cfg, file, estimator.camera)
    writer = Writer(cfg, output, len(inputs) == 1)
    estimator.background = coded_alike(estimator.background, reading.coding)
    if len(inputs) == 1 and Path(cfg.input).is_file():
        estimate, seconds = predict_one(inputs[0], reading, estimator, writer)
        print_estimate(out, estimate, seconds, cfg.rows)
        out.print(f"written: {output / inputs[0].stem}.*", markup=False)
        return
    start = perf_counter()
    done = Done(output, state_of(cfg, reading, estimator))
    tally = predict_all(cfg, inputs, reading, estimator, writer, done)
    print_tally(out, tally, perf_counter() - start)
    out.print(f"written to {output}", markup=False)
    if tally.failed:
        raise ValueError(f"{len(tally.failed)} of {len(inputs)} inputs failed: {'; '.join(tally.failed[:4])}")


def check_values(cfg: DictConfig) -> None:
    """Refuse wrong values before anything is loaded."""
    from pnet.scenes.limits import require_number

    for key in ("batch", "rows"):
        if type(cfg[key]) is not int or cfg[key] < 1:
            raise ValueError(f"{key}={cfg[key]}: expected a whole number of at least 1")
    if cfg.threads is not None and (type(cfg.threads) is not int or cfg.threads < 1):
        raise ValueError(f"threads={cfg.threads}: expected a whole number of at least 1, or null")
    for key in ("picture", "page", "again"):
        if not isinstance(cfg[key], bool | None):
            raise ValueError(f"{key}={cfg[key]}: expected true, false or null")
    if cfg.depth.scale is not None:
        require_number("depth.scale", cfg.depth.scale, 0, above=True)


def other_files(cfg: DictConfig) -> list[Path]:
    """The files besides the inputs that the settings name: the camera's, the empty bin's, the bundle."""
    named = (cfg.get("camera") or {}).get("file"), cfg.background.get("image"), cfg.run
    return [Path(str(name)) for name in named if name is not None]


def load(cfg: DictConfig) -> "Estimator":
    """The estimator of the settings."""
    from pnet.cli.estimator import Estimator
    from pnet.cli.instantiate import instantiate

    changes: Any = OmegaConf.to_container(cfg.postprocess, resolve=True)
    background = instantiate(cfg.background)
    return Estimator.load(cfg.run, postprocess=changes, background=background, device=cfg.device)


def coded_alike(background: "Background", coding: "DepthCoding") -> "Background":
    """An empty bin's image that does not say how it is coded is coded like the images."""
    from pnet.data.background import EmptyBin

    if isinstance(background, EmptyBin) and background.scale is None:
        shared = {key: getattr(coding, key) for key in ("scale", "offset", "radial", "of_integers")}
        return replace(background, **shared)
    return background


def predict_one(
    path: Path, reading: "Reading", estimator: "Estimator", writer: "Writer"
) -> tuple["Estimate", dict[str, float]]:
    """Predict one file and write its results."""
    prepared = reading.prepare(path, estimator)
    (estimate,) = estimator.recover([prepared.cloud])
    return estimate, writer.write(prepared, estimate)


def predict_all(
    cfg: DictConfig,
    inputs: list[Path],
    reading: "Reading",
    estimator: "Estimator",
    writer: "Writer",
    done: "Done",
) -> Tally:
    """Predict a folder's files; a thread reads ahead, one that cannot be read is told at the end."""
    from pnet.cli.prediction_inputs import ahead
    from pnet.reporting.progress import count_progress

    tally = Tally()
    wanted = [path for path in inputs if cfg.again or not done.has(path)]
    tally.kept = len(inputs) - len(wanted)
    with count_progress("predicting", len(wanted), "images") as advance:
        stream = ahead(wanted, lambda path: reading.prepare(path, estimator), 2 * cfg.batch)
        for batch in in_batches(stream, cfg.batch, tally, advance):
            estimates = estimator.recover([prepared.cloud for prepared in batch])
            for prepared, estimate in zip(batch, estimates, strict=True):
                tally.add(estimate, writer.write(prepared, estimate))
                done.add(prepared.path)
                advance(1)
    return tally


def in_batches(stream: Any, size: int, tally: Tally, advance: Any) -> Iterator[list["Prepared"]]:
    """What could be read, in batches; what could not is counted."""
    batch: list[Prepared] = []
    for path, future in stream:
        try:
            batch.append(future.result())
        except EXPECTED as fault:
            text = error_text(fault)
            tally.failed.append(text if str(path) in text else f"{path}: {text}")
            advance(1)
        if len(batch) == size:
            yield batch
            batch = []
    if batch:
        yield batch


def print_estimate(out: "Console", estimate: "Estimate", seconds: dict[str, float], rows: int) -> None:
    """The detections by score, and the time of each stage."""
    from pnet.reporting.prediction_tables import detections_table, stage_text

    if len(estimate):
        out.print(detections_table(estimate.detections, estimate.part, rows))
    else:
        out.print(NOTHING, markup=False)
    cloud = estimate.cloud
    out.print(f"{cloud.measured:,} points measured, {cloud.kept:,} not background; {stage_text(seconds)}")


def print_tally(out: "Console", tally: Tally, elapsed: float) -> None:
    """What the stream came to."""
    from pnet.reporting.prediction_tables import stage_text

    kept = f", {tally.kept} had results already" if tally.kept else ""
    out.print(f"{tally.images} images predicted{kept}: {tally.found} parts found")
    if tally.images:
        out.print(f"{tally.images / elapsed:.1f} images/s; medians: {stage_text(tally.medians)}")
        if not tally.found:
            out.print(NOTHING, markup=False)


if __name__ == "__main__":
    main()
