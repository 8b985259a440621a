"""Predictions of pnet-evaluate as results files of the Siléane and BOP benchmarks."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from pnet.cli.evaluate import PREDICTIONS, Evaluation, evaluated_source

if TYPE_CHECKING:
    from pnet.data.source import DataSource, SceneSet
    from pnet.parts.base import ParametricPart
    from pnet.records import Detections

BOP = "bop.csv"


def export_results(folder: Path, evaluation: Evaluation, run: Path, trained: DictConfig) -> None:
    """Write the predictions that an evaluation of a run left."""
    from pnet.cli.build import part_of
    from pnet.data.combined import CombinedData
    from pnet.engine.predictions import read_predictions

    header, found = read_predictions(evaluation.folder(run) / PREDICTIONS)
    source, part = evaluated_source(evaluation, trained), part_of(trained)
    if isinstance(source, CombinedData):
        source = source.of(evaluation.split)
    scenes = source.scenes(evaluation.split, part, evaluation.every)
    write_results(folder, source, scenes, part, found, sum(header.seconds.values()))


def write_results(
    folder: Path,
    source: "DataSource",
    scenes: "SceneSet",
    part: "ParametricPart",
    found: Sequence["Detections"],
    seconds: float,
) -> None:
    """Write a JSON a scene, and a CSV of all, numbered like `pnet-data export layout=bop`.

    Args:
        folder: made where missing. source: of the scenes; scenes of a Siléane folder keep its names and its
            world frame, others have `pnet-data export`'s. found: in each scene. seconds: a scene took.
    """
    from pnet.data.export.bop import bop_object_id, bop_scene_id
    from pnet.data.export.results import BopImage, write_bop_results, write_sileane_results
    from pnet.data.export.sileane import sileane_folder, sileane_name
    from pnet.data.public.public_scenes import PublicScenes
    from pnet.data.public.sileane import SileaneData
    from pnet.data.public.sileane_results import world_detections

    if isinstance(source, SileaneData) and isinstance(scenes, PublicScenes):
        write_sileane_results(folder, scenes.names, world_detections(source, found), part.parameter_names)
    else:
        ids = scenes.ids
        for name in sorted({sileane_folder(part.name, one) for one in ids}):
            own = [i for i, one in enumerate(ids) if sileane_folder(part.name, one) == name]
            names = [sileane_name(part.name, ids[i]) for i in own]
            write_sileane_results(folder / name, names, [found[i] for i in own], part.parameter_names)
    images = [
        BopImage(bop_scene_id(one), one.drop, bop_object_id(one), detections, seconds)
        for one, detections in zip(scenes.ids, found, strict=True)
    ]
    write_bop_results(folder / BOP, images)
