"""The weights that come with pnet: where they lie, and which part's file is meant."""

from pathlib import Path

from omegaconf import DictConfig, open_dict

from pnet.cli.app import closest

ENDING = ".safetensors"


def weights_dir() -> Path:
    """The folder of weights: inside an installed package, or at the top of a checkout."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "weights", package.parents[1] / "weights"):
        if (folder / "README.md").is_file():
            return folder
    raise FileNotFoundError(f"pnet's weights are missing beside {package}; install pnet again")


def pretrained_parts() -> list[str]:
    """The parts for which there are weights, by name."""
    return sorted(path.stem for path in weights_dir().glob(f"*{ENDING}"))


def pretrained_bundle(part: str) -> Path:
    """The bundle that comes with pnet for a part.

    Raises:
        ValueError: where there is none; names those that there are, and says how to train one.
    """
    known = pretrained_parts()
    if part not in known:
        raise ValueError(
            f"part={part}: no weights for it come with pnet{closest(part, known)}; {_those(known)}; train "
            "a network (pnet-generate, then pnet-train, both with part=) and give run=FOLDER in its place"
        )
    return weights_dir() / f"{part}{ENDING}"


def part_words(arguments: list[str]) -> list[str]:
    """The command line with part=NAME as the setting part.name, as `part` is a group of choices elsewhere."""
    return [f"part.name={word[5:]}" if word.startswith("part=") else word for word in arguments]


def with_run(cfg: DictConfig) -> DictConfig:
    """The settings of pnet-predict with the path of what predicts as `run`, and no `part` beside it.

    Raises:
        ValueError: where not exactly one of the two is given, or no weights come with pnet for the part.
    """
    run, name = cfg.run, cfg.part.name
    if run is not None and name is not None:
        raise ValueError(
            f"run={run} and part={name}: give one of them; a run and a bundle know their part themselves"
        )
    if run is None and name is None:
        raise ValueError(
            "run and part are missing: give part=NAME for weights that come with pnet "
            f"({_those(pretrained_parts())}), or run=FOLDER|FILE for your own"
        )
    chosen = cfg.copy()
    with open_dict(chosen):
        chosen.run = str(pretrained_bundle(str(name))) if run is None else run
        del chosen.part
    return chosen


def _those(parts: list[str]) -> str:
    return f"there are {', '.join(parts)}" if parts else "this copy of pnet holds none"
