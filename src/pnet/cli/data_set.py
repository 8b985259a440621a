"""The data set of a training, made where it is missing; and the settings of a run that is repeated."""

import os
import subprocess
import sys
from pathlib import Path

from hydra import compose
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from pnet.cli.app import hydra_value, key_of
from pnet.cli.settings import read_run
from pnet.engine.locks import NO_WAIT


def repeated(cfg: DictConfig) -> DictConfig:
    """The settings of the run `repeat`, into another folder, with as many threads as it had."""
    from pnet.engine.provenance import git_state, read_json

    old = Path(cfg.repeat)
    again = read_run(old).copy()
    state = read_json(old / "provenance.json")
    commit = git_state(Path(__file__).parent)["commit"]
    if state["git"]["commit"] != commit:
        print(
            f"{old} was trained with commit {state['git']['commit'][:7]}, this is {commit[:7]}",
            file=sys.stderr,
        )
    given = any(key_of(word) == "run_dir" for word in HydraConfig.get().overrides.task)
    again.run_dir = cfg.run_dir if given else f"{str(old).rstrip('/')}_again"
    again.ckpt, again.repeat = cfg.ckpt, cfg.repeat
    again.trainer.threads = state["threads"]
    return again


def make_data_again(cfg: DictConfig) -> None:
    """Have the data of the run `repeat` made where it is gone; other data in its place is an error."""
    from pnet.scenes.generation import MANIFEST, read_manifest, settings_fingerprint

    root, manifest = Path(cfg.data.root), Path(cfg.repeat) / MANIFEST
    if not (root / MANIFEST).exists():
        run_generate([f"like={hydra_value(str(manifest))}", f"data.root={hydra_value(str(root))}"], root)
    elif settings_fingerprint(read_manifest(root)) != settings_fingerprint(read_manifest(manifest.parent)):
        raise ValueError(
            f"{root}: holds other data than {cfg.repeat} was trained on; move it away and try again"
        )


def make_data(cfg: DictConfig) -> None:
    """Have pnet-generate make what is missing of the data set, in a process of its own."""
    from pnet.cli.generate import is_complete

    chosen = HydraConfig.get().overrides.task
    kept = [
        word for word in chosen if word.lstrip("+").startswith(("part=", "part.", "protocol=", "protocol."))
    ]
    overrides = [*kept, f"data.root={cfg.data.root}", *cfg.data.generate]
    if not is_complete(compose("generate", overrides=overrides)):
        run_generate(overrides, cfg.data.root)


def run_generate(overrides: list[str], root: Path) -> None:
    """pnet-generate in a process of its own; its output stays where this one's goes."""
    # a run may be put off while another process works on it, its data has to be waited for
    environment = {key: value for key, value in os.environ.items() if key != NO_WAIT}
    command = [sys.executable, "-m", "pnet.cli.generate", *overrides]
    if subprocess.run(command, env=environment).returncode:
        raise ValueError(f"{root}: the scenes could not be made, see above")
