"""pnet-export: a trained network as one file."""

import sys
from dataclasses import replace
from pathlib import Path

from omegaconf import DictConfig

from pnet.cli.app import run_app
from pnet.cli.prediction_inputs import camera_words


def main() -> None:
    """Entry point."""
    sys.argv[1:] = camera_words(sys.argv[1:])
    run_app(export, "export")


def export(cfg: DictConfig) -> None:
    """Write the bundle, and read it back to see that it predicts."""
    from rich.console import Console

    from pnet.cli.estimator import Estimator, run_bundle
    from pnet.cli.prediction_inputs import chosen_camera
    from pnet.engine.bundle import SUFFIX, write_bundle

    output = Path(cfg.output)
    if output.suffix != SUFFIX:
        raise ValueError(f"output={output}: the file's name has to end in {SUFFIX}")
    bundle = run_bundle(Path(cfg.run))
    camera = chosen_camera(cfg)
    if camera is not None:
        bundle = replace(bundle, camera=camera.camera)
    write_bundle(output, bundle)
    estimator = Estimator.load(output)
    count = sum(weight.numel() for weight in bundle.weights.values())
    out = Console(soft_wrap=True)
    out.print(
        f"{estimator.part.name}, {count:,} weights, {bundle.points:,} points, "
        f"camera {'kept' if bundle.camera else 'not known'}: {output} ({output.stat().st_size / 1e6:.1f} MB)"
    )
    out.print(f"next: pnet-predict run={output} input=FILE", markup=False)


if __name__ == "__main__":
    main()
