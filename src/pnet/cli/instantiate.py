"""Build objects from configs, from an allowlist only: a config file is data, not code."""

import os
from collections.abc import Iterator
from typing import Any

import hydra
from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf

ALLOWED = (
    "pnet.geometry.camera.",
    "pnet.parts.",
    "pnet.scenes.bullet.",
    "pnet.scenes.clutter.",
    "pnet.scenes.mujoco_world.",
    "pnet.scenes.noise.",
    "pnet.scenes.pile.",
    "pnet.scenes.protocol.",
    "pnet.scenes.viewpoints.",
    "pnet.data.augmentation.",
    "pnet.data.background.",
    "pnet.data.combined.",
    "pnet.data.module.",
    "pnet.data.public.",
    "pnet.data.views.",
    "pnet.backbones.",
    "pnet.models.",
    "pnet.postprocess.",
    "pnet.engine.schedules.",
    "torch.optim.",
)
TRUSTED = "PNET_TRUSTED"  # environment: modules of the user's own that configs may build from, with commas


def instantiate(node: DictConfig, *args: Any, **kwargs: Any) -> Any:
    """`hydra.utils.instantiate`, after every `_target_` in the node was found on the allowlist.

    Raises:
        ValueError: names the key and the target that is not allowed or does not exist.
    """
    for key, target in _targets(OmegaConf.to_container(node, resolve=True)):
        _check(key, target)
    return hydra.utils.instantiate(node, *args, _convert_="all", **kwargs)


def allowed() -> tuple[str, ...]:
    """The prefixes that targets may have: pnet's own, and modules that the user names in the environment.

    A config cannot extend it: whoever starts the command decides whose code runs.
    """
    return (*ALLOWED, *(f"{name}." for name in trusted_modules()))


def trusted_modules() -> list[str]:
    """The modules that the user names in the environment."""
    named = [word.strip() for word in os.environ.get(TRUSTED, "").split(",") if word.strip()]
    for name in named:
        if not all(word.isidentifier() for word in name.split(".")):
            raise ValueError(f"{TRUSTED}: {name!r} is no module's name, such as my_parts")
    return named


def _check(key: str, target: str) -> None:
    where = f"{key or 'config'}._target_: {target}"
    prefixes = allowed()
    if not target.startswith(prefixes):
        raise ValueError(
            f"{where} is not allowed; pnet builds only from {', '.join(prefixes)}; "
            f"name a module of your own in the environment variable {TRUSTED}"
        )
    try:
        found = get_object(target)
    except Exception as fault:
        raise ValueError(f"{where} does not exist ({fault})") from fault
    # a name that is only imported there may be anything: judge the object by where it was defined;
    # classes only: their constructors hold values, a function could act
    home = f"{getattr(found, '__module__', '')}.{getattr(found, '__qualname__', '')}"
    if not isinstance(found, type) or not home.startswith(prefixes):
        raise ValueError(f"{where} is {home}, which is not allowed")


def _targets(node: Any, key: str = "") -> Iterator[tuple[str, str]]:
    if isinstance(node, dict):
        if "_target_" in node:
            yield key, str(node["_target_"])
        for name, child in node.items():
            yield from _targets(child, f"{key}.{name}" if key else str(name))
    elif isinstance(node, list):
        for i, child in enumerate(node):
            yield from _targets(child, f"{key}[{i}]")
