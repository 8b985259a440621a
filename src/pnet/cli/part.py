"""pnet-part: show, check and draw a part."""

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from pnet.cli.app import config_dir, run_app

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from rich.console import Console

    from pnet.parts.base import ParametricPart
    from pnet.parts.checks import Check

FORMATS = ("stl", "obj", "glb", "ply")


def main() -> None:
    """Entry point; `part=all` is no file of conf/part, so it becomes a setting of its own."""
    sys.argv[1:] = ["all=true" if word == "part=all" else word for word in sys.argv[1:]]
    run_app(show_parts, "part")


def show_parts(cfg: DictConfig) -> None:
    """Every chosen part: tables, checks, files; a gallery of all; an error if a check failed."""
    from rich.console import Console

    from pnet.reporting.part_picture import gallery

    _check_settings(cfg)
    out, folder = Console(soft_wrap=True), Path(str(cfg.output))
    parts = [_named(name, node) for name, node in _chosen(cfg)]
    failed = [part.name for part in parts if not show_part(out, part, cfg, folder / part.name)]
    if cfg.all:
        gallery(parts, folder / "gallery.png")
        out.print(f"all parts: {folder / 'gallery.png'}")
    if failed:
        raise ValueError(f"checks failed for {', '.join(failed)}: see the lines marked FAILED")


def show_part(out: "Console", part: "ParametricPart", cfg: DictConfig, folder: Path) -> bool:
    """Tables and files of one part; whether all its checks passed."""
    from pnet.data.poseutils import write_poseutils
    from pnet.reporting.part_picture import part_picture
    from pnet.reporting.part_tables import check_table, constants_table, keypoint_table, parameter_table

    parameters = _parameters(part, cfg)
    checks = list(part_checks(part, cfg.samples))
    for table in (parameter_table(part, parameters), keypoint_table(part), constants_table(part, parameters)):
        out.print(table)
    out.print(check_table(checks))
    mesh = part.mesh(parameters)
    folder.mkdir(parents=True, exist_ok=True)
    for ending in cfg.formats:
        write_mesh(mesh, folder / f"{part.name}.{ending}")
    write_poseutils(folder / "poseutils.json", part.pose_space(parameters))
    part_picture(part, parameters, folder / f"{part.name}.png")
    out.print(f"picture, meshes (metres) and poseutils.json in {folder}\n")
    return all(check.passed or check.is_advice for check in checks)


def part_checks(part: "ParametricPart", samples: int) -> Iterator["Check"]:
    """The part's own checks, and the fit's under every keypoint rule."""
    from pnet.parts.checks import Check, check_part
    from pnet.parts.choice import KeypointRule
    from pnet.postprocess.fit_check import fit_error

    yield from check_part(part, samples)
    for rule in KeypointRule:
        angle, distance = fit_error(part, rule, samples)
        name = f"exact keypoints give the pose back, rule {rule}"
        yield Check(
            name, angle < 1e-6 and distance < 1e-9, f"{angle:.1e} rad, {1000 * distance:.1e} mm at most"
        )


def write_mesh(mesh: Any, path: Path) -> None:
    """Export in the format that the ending names; the file appears when it is whole."""
    from pnet.scenes.record_file import write_atomically

    content = mesh.export(file_type=path.suffix.removeprefix("."))
    write_atomically(path, content.encode() if isinstance(content, str) else content)


def _check_settings(cfg: DictConfig) -> None:
    """Refuse what no part can be shown with, before anything is written."""
    if cfg.output is None:
        raise ValueError("output is null, expected a folder")
    for key, least in (("samples", 1), ("index", 0)):
        if type(cfg[key]) is not int or cfg[key] < least:
            raise ValueError(f"{key} is {cfg[key]}, expected a whole number of at least {least}")
    if not OmegaConf.is_list(cfg.formats) or not set(cfg.formats) <= set(FORMATS):
        raise ValueError(f"formats is {cfg.formats}, expected a list out of {', '.join(FORMATS)}")


def _chosen(cfg: DictConfig) -> Iterator[tuple[str, DictConfig]]:
    if not cfg.all:
        yield "part", cfg.part
        return
    for path in sorted((config_dir() / "part").glob("*.yaml")):
        node = OmegaConf.load(path)
        assert isinstance(node, DictConfig)
        yield path.stem, node


def _named(name: str, node: DictConfig) -> "ParametricPart":
    from pnet.cli.instantiate import instantiate
    from pnet.parts.base import ParametricPart

    try:
        part = instantiate(node)
    except ValueError as fault:
        raise ValueError(f"{name}.{str(fault).removeprefix('config.')}") from fault
    if not isinstance(part, ParametricPart):
        raise ValueError(f"{name}._target_: {node.get('_target_')} is no ParametricPart")
    if not isinstance(part.name, str) or not re.fullmatch(r"\w[\w.-]*", part.name):
        raise ValueError(f"{name}.name is {part.name!r}: files are named by it, so give one plain word")
    return part


def _parameters(part: "ParametricPart", cfg: DictConfig) -> "NDArray[np.float64]":
    """(k,) metres: the settings' own values, or a part object of a grid."""
    import numpy as np

    values = cfg["values"]  # not cfg.values, which is a method
    if values is None or cfg.all:
        return part.part_object(cfg.grid, 0 if cfg.all else cfg.index)
    if not OmegaConf.is_dict(values) or set(values) != set(part.parameter_names):
        raise ValueError(f"values is {values}, expected numbers for {', '.join(part.parameter_names)}")
    try:
        parameters = np.array([float(values[name]) for name in part.parameter_names]) / 1000
    except (TypeError, ValueError) as fault:
        raise ValueError(f"values is {values}, expected numbers in mm") from fault
    part.check_named(parameters)
    return parameters


if __name__ == "__main__":
    main()
