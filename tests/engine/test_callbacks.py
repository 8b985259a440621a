"""What a validation logs."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from pnet.engine.callbacks import PoseValidation
from pnet.records import Detections


class Knowing:
    """Finds every body of its scenes in turn, with parameters that are off by so many metres."""

    def __init__(self, part, scenes, off):
        self.part, self._scenes, self._off = part, iter(scenes), torch.tensor(off, dtype=torch.float64)

    def estimate(self, points):
        scene = next(self._scenes)
        R, t, parameters = (torch.from_numpy(value) for value in (scene.R, scene.t, scene.parameters))
        d, unknown = len(t), torch.zeros(len(t), 3, 3, dtype=torch.float64)
        found = Detections(R, t, parameters, torch.linspace(1, 0.5, d), unknown, torch.zeros(0).long())
        return [replace(found, parameters=parameters + self._off)]


def logged(part, scenes, off, logger=None):
    values = {}
    module = SimpleNamespace(log_dict=lambda given, **_: values.update(given))
    trainer = SimpleNamespace(sanity_checking=False, logger=logger, is_global_zero=True, global_step=10)
    PoseValidation(Knowing(part, scenes, off), scenes, None, 0).on_validation_epoch_end(trainer, module)
    return values


def test_the_error_of_each_parameter_is_logged_and_read_again(tn34, make_scene, tmp_path):
    scenes = [make_scene(tn34, bodies=3, seed=seed) for seed in (0, 1)]
    values = logged(tn34, scenes, [0.001, -0.002])
    shown = {"val/parameter_error_mm/r": 1.0, "val/parameter_error_mm/h": 2.0, "val/parameter_error_mm": 1.5}
    assert {name: values[name] for name in shown} == pytest.approx(shown)
    logger = TensorBoardLogger(tmp_path, name="", version="")
    logger.log_metrics(values, step=9)
    logger.finalize("success")
    book = EventAccumulator(str(tmp_path))
    book.Reload()
    assert set(book.Tags()["scalars"]) == set(values)
    assert book.Scalars("val/parameter_error_mm/h")[0].value == pytest.approx(2.0)


def test_a_method_without_sizes_logs_none(tn34, make_scene):
    values = logged(tn34, [make_scene(tn34)], [float("nan")] * 2)
    assert values["val/mAP"] == 1.0 and not [name for name in values if "parameter" in name]
