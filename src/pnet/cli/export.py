"""pnet-export: a trained network as one file, and its model card."""

import sys
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from pnet.cli.app import run_app
from pnet.cli.prediction_inputs import camera_words

if TYPE_CHECKING:
    from pnet.engine.bundle import Bundle
    from pnet.parts.base import ParametricPart


def main() -> None:
    """Entry point."""
    sys.argv[1:] = camera_words(sys.argv[1:])
    run_app(export, "export")


def export(cfg: DictConfig) -> None:
    """Write the bundle, read it back to see that it predicts, and write its card."""
    from rich.console import Console

    from pnet.cli.estimator import Estimator, bundle_of
    from pnet.cli.prediction_inputs import chosen_camera
    from pnet.engine.bundle import write_bundle
    from pnet.scenes.record_file import write_atomically

    output = Path(cfg.output)
    card = output.with_suffix(".md")
    check_values(cfg, output, card)
    bundle = bundle_of(Path(cfg.run), refinement(cfg))
    camera = chosen_camera(cfg)
    if camera is not None:
        bundle = replace(bundle, camera=camera.camera)
    write_bundle(output, bundle)
    estimator = Estimator.load(output)
    if cfg.card:
        write_atomically(card, card_text(output, bundle, estimator.part, cfg.licence).encode())
    count = sum(weight.numel() for weight in bundle.weights.values())
    out = Console(soft_wrap=True)
    out.print(
        f"{estimator.part.name}, {count:,} weights, {bundle.points:,} points, "
        f"camera {'kept' if bundle.camera else 'not known'}: {output} ({output.stat().st_size / 1e6:.1f} MB)"
    )
    if cfg.card:
        out.print(f"its card: {card}", markup=False)
    out.print(f"next: pnet-predict run={output} input=FILE", markup=False)


def refinement(cfg: DictConfig) -> dict[str, Any]:
    """What `refine=` changes of the run's post-processing.

    Raises:
        ValueError: where another setting of it is changed: the card would not tell of it.
    """
    from pnet.cli.app import closest

    changes: Any = OmegaConf.to_container(cfg.postprocess, resolve=True)
    for key in changes:
        if key != "refine":
            raise ValueError(f"postprocess.{key}: pnet-export takes refine= alone{closest(key, ['refine'])}")
    return {str(key): value for key, value in changes.items()}


def check_values(cfg: DictConfig, output: Path, card: Path) -> None:
    """Refuse wrong values, and to write over a page that is no card, before anything is written."""
    from pnet.engine.bundle import SUFFIXES
    from pnet.reporting.model_card import TITLE

    if output.suffix not in SUFFIXES:
        raise ValueError(f"output={output}: the file's name has to end in {' or '.join(SUFFIXES)}")
    if not isinstance(cfg.card, bool):
        raise ValueError(f"card={cfg.card}: expected true or false")
    if cfg.card and not isinstance(cfg.licence, str):
        raise ValueError(f"licence={cfg.licence}: expected the name of a licence, such as Apache-2.0")
    if cfg.card and card.exists() and not card.read_bytes().startswith(TITLE.encode()):
        raise ValueError(
            f"output={output}: {card} would be written over and is no model card; choose another name"
        )


def card_text(path: Path, bundle: "Bundle", part: "ParametricPart", licence: str) -> str:
    """The model card of a bundle's file: a function of the file alone, and of the licence.

    Args:
        path: the file. bundle: what it holds. part: the template of its settings.
    """
    from pnet.reporting.model_card import CardContent, model_card

    content = path.read_bytes()
    return model_card(
        CardContent(
            file=path.name,
            digest=sha256(content).hexdigest(),
            size=len(content),
            licence=licence,
            part=part,
            settings=bundle.settings,
            about=bundle.about,
            points=bundle.points,
            camera=bundle.camera,
            weights=sum(weight.numel() for weight in bundle.weights.values()),
        )
    )


if __name__ == "__main__":
    main()
