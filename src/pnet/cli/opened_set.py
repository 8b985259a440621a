"""A data set as commands look at it: its plan and its settings, out of its manifest."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import OmegaConf

from pnet.cli.app import error_text

if TYPE_CHECKING:
    from pnet.scenes.inspection import DataSet

MADE_BY_GENERATE = "root= takes the folder of a data set that pnet-generate made"


@dataclass(frozen=True, eq=False)
class Opened:
    """A data set and the settings in its manifest."""

    data: "DataSet"
    settings: dict[str, Any]


def open_set(root: Path, piles: Path) -> Opened:
    """The data set in a folder.

    Raises:
        FileNotFoundError, ValueError: where none is there; names the file.
    """
    from pnet.cli.generate import MAKING, piling_settings, plan_tasks
    from pnet.parts.base import ParametricPart
    from pnet.scenes.inspection import DataSet
    from pnet.scenes.manifest import MANIFEST, read_manifest, settings_fingerprint
    from pnet.scenes.protocol import Protocol

    if not root.is_dir():
        raise FileNotFoundError(f"{root}: no such folder; {MADE_BY_GENERATE}")
    path = root / MANIFEST
    try:
        settings = read_manifest(root, MADE_BY_GENERATE)
    except UnicodeDecodeError as fault:
        raise ValueError(f"{path}: not readable ({fault}); {MADE_BY_GENERATE}") from fault
    if "converted" in settings:
        return _open_converted(root, path, settings)
    files = settings.pop("files", None)
    lacking = [key for key in MAKING if key not in settings]
    if lacking or not isinstance(files, dict):
        key = [*lacking, "files"][0]
        raise ValueError(f"{path}: made by an older pnet, it lacks {key}; make the data anew")
    part = built(path, "part", settings["part"], ParametricPart)
    protocol = built(path, "protocol", settings["protocol"], Protocol).for_part(part.name)
    data = DataSet(
        root=root,
        piles=piles,
        part=part,
        protocol=protocol,
        tasks=plan_tasks(part, protocol),
        fingerprint=settings_fingerprint({key: settings[key] for key in MAKING}),
        piles_fingerprint=settings_fingerprint(piling_settings(settings)),
        files=files,
    )
    return Opened(data, settings)


def _open_converted(root: Path, path: Path, settings: dict[str, Any]) -> Opened:
    """A store that pnet-data convert made: its manifest lists the files, and there are no piles."""
    from pnet.parts.base import ParametricPart
    from pnet.scenes.inspection import DataSet
    from pnet.scenes.protocol import CycleTask

    try:
        tasks = [
            CycleTask(str(split), str(kind), "G" if split == "test_g" else "L", int(cycle), int(index))
            for split, kind, cycle, index in settings.pop("cycles")
        ]
        files, fingerprint = dict(settings.pop("files")), str(settings["fingerprint"])
        part = built(path, "part", settings["part"], ParametricPart)
    except (KeyError, TypeError) as fault:
        raise ValueError(f"{path}: not the manifest of a converted data set ({fault})") from fault
    data = DataSet(root, root / "piles", part, None, tasks, fingerprint, "", files)
    return Opened(data, settings)


def built(path: Path, key: str, node: Any, kind: type) -> Any:
    """What a key of a manifest describes, of the kind that it has to be."""
    from hydra.errors import InstantiationException

    from pnet.cli.instantiate import instantiate

    try:
        found = instantiate(OmegaConf.create({key: node}))[key]
    except (ValueError, InstantiationException) as fault:
        raise ValueError(f"{path}: {error_text(fault)}; {MADE_BY_GENERATE}") from fault
    if not isinstance(found, kind):
        raise ValueError(f"{path}: {key} describes no {kind.__name__}; {MADE_BY_GENERATE}")
    return found
