"""How much each backbone learns in the same time, on the demo's scenes.

python benchmarks/learning_curves.py --minutes 6

Every backbone trains once with the demo's recipe for about the same time: a short run finds its seconds per
step, and the number of steps follows, so that each has its whole learning rate schedule. The table has the
minutes that it really took. Runs and the picture are written to outputs/learning. Run again after an
interruption: what is there is not done twice.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

from matplotlib.figure import Figure

from pnet.reporting.training_curves import read_scalars

# a number after @: backbone.radius_scale; the published radii are for scenes larger than the demo's bin
BACKBONES = ("pointnet", "pointnet2", "pointnet2_delayed", "pointsift", "pointsift@0.25", "range_unet")
FOLDER = Path("outputs/learning")
VALIDATIONS = 8
PROBE = 40  # steps of the run that finds the speed
BATCH = 4  # scenes of a step


def main() -> None:
    """Train, then print and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--minutes", type=float, default=6.0, help="of training for each backbone")
    parser.add_argument("--backbones", nargs="+", default=BACKBONES)
    parser.add_argument("--part", default="tn34", help="of a data set made with protocol=demo")
    options = parser.parse_args()
    curves = {}
    for backbone in options.backbones:
        run = folder(options.part, options.minutes, backbone)
        if not (run / "metrics.json").exists():
            train(options.part, backbone, run, steps_for(options.part, backbone, options.minutes * 60))
        curves[backbone] = read_curve(run)
    print(f"{'backbone':20}{'steps':>7}{'scenes/s':>10}{'minutes':>9}{'val AP':>8}{'best':>8}")
    for backbone, curve in curves.items():
        run = folder(options.part, options.minutes, backbone)
        metrics = json.loads((run / "metrics.json").read_text())
        minutes, best = curve[-1][0], max(ap for _, ap in curve)
        print(
            f"{backbone:20}{metrics['steps']:>7}{metrics['scenes_per_second']:>10.1f}{minutes:>9.1f}"
            f"{curve[-1][1]:>8.3f}{best:>8.3f}"
        )
    picture = folder(options.part, options.minutes, "curves").with_suffix(".png")
    draw(curves, picture)
    print(picture)


def folder(part: str, minutes: float, name: str) -> Path:
    """Of one training; another length is another training."""
    return FOLDER / f"{part}_{minutes:g}min_{name}"


def steps_for(part: str, backbone: str, seconds: float) -> int:
    """Steps that fill the time, a multiple of the number of validations."""
    probe = FOLDER / "probes" / f"{part}_{backbone}"
    if not (probe / "metrics.json").exists():
        train(part, backbone, probe, PROBE, validations=1)
    metrics = json.loads((probe / "metrics.json").read_text())
    steps = PROBE * seconds / metrics["training_seconds"]
    return max(1, round(steps / VALIDATIONS)) * VALIDATIONS


def train(part: str, backbone: str, run: Path, steps: int, validations: int = VALIDATIONS) -> None:
    """One training with the demo's recipe; goes on with one that was interrupted."""
    every = steps // validations
    backbone, _, scale = backbone.partition("@")
    command = [
        Path(sys.executable).with_name("pnet-train"),
        f"part={part}",
        "protocol=demo",
        f"backbone={backbone}",
        f"run_dir={run}",
        "ckpt=auto",
        f"trainer.steps={steps}",
        f"trainer.validate_every={every}",
        f"trainer.checkpoint_every={every}",
        "trainer.mesh_every=0",
        f"data.batch_size={BATCH}",
        *([f"backbone.radius_scale={scale}"] if scale else []),
    ]
    print("$", *command, flush=True)
    subprocess.run(command, check=True)


def read_curve(run: Path) -> list[tuple[float, float]]:
    """(minutes of training, validation AP) of every validation."""
    metrics = json.loads((run / "metrics.json").read_text())
    # by the speed: the seconds of an interrupted training are those since it went on
    share = BATCH / metrics["scenes_per_second"] / 60
    steps, values = read_scalars(run / "tensorboard")["val/AP"]
    return [(step * share, value) for step, value in zip(steps, values, strict=True)]


def draw(curves: dict[str, list[tuple[float, float]]], path: Path) -> None:
    """AP against minutes."""
    figure = Figure(figsize=(7.5, 4.5), layout="constrained", dpi=150)
    axes = figure.subplots()
    for backbone, curve in curves.items():
        minutes, ap = zip(*((0.0, 0.0), *curve), strict=True)
        axes.plot(minutes, ap, marker="o", markersize=3.5, label=f"{backbone} ({ap[-1]:.2f})")
    axes.set(xlabel="minutes of training on two cores", ylabel="validation AP", ylim=(0, 1.02))
    axes.set_title("The demo's scenes, one run each", fontsize=11)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=9)
    figure.savefig(path)


if __name__ == "__main__":
    main()
