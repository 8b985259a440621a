"""pnet-score: score any folder of results in the Siléane layout."""

from pathlib import Path

from omegaconf import DictConfig

from pnet.cli.app import run_app


def main() -> None:
    """Entry point."""
    run_app(score, "score")


def score(cfg: DictConfig) -> None:
    """Print AP, MAP and F1, and write them where `output` says."""
    import json

    from pnet.engine.provenance import write_json
    from pnet.metrics.sileane_results import score_folder

    values = score_folder(Path(cfg.truth), Path(cfg.results), Path(cfg.poseutils))
    if cfg.output is not None:
        write_json(Path(cfg.output), values)
    print(json.dumps(values))


if __name__ == "__main__":
    main()
