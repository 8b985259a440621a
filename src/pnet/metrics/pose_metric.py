"""The scores of a run, gathered scene by scene."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torchmetrics import Metric

from pnet.geometry.pose_space import PoseSpace
from pnet.metrics.average_precision import (
    PrecisionRecallCurve,
    average_precision,
    best_f1,
    count_positives,
    mean_average_precision,
    precision_recall_curve,
    recall_at_precision,
)
from pnet.metrics.matching import SceneMatch, ScoredPoses, TruePoses, match_scene, nearest_matches
from pnet.metrics.pose_error import axis_error, parameter_error, position_error

_FIELDS = ("score", "truth", "distance", "matched", "relevant")
_ERRORS = ("position", "axis", "parameter")


class PoseMetrics(Metric):
    """Average precision and the errors of matched poses.

    `compute()` gives AP, MAP, F1, recall_at_precision_99; position_error_mm, axis_error_deg and
    parameter_error_mm, means over the relevant true poses' nearest matched results, NaN where there
    is none; parameter_error_mm/NAME, the same of each named parameter that some of them have; and the
    counts true_positives, false_positives (every result a positive), truths_to_find, results, scenes.

    Note:
        Each process counts its own scenes; nothing is gathered, where several train together each sees all.
    """

    is_differentiable = False
    higher_is_better = True
    full_state_update = False

    def __init__(self, max_occlusion: float = 0.5, parameter_names: Sequence[str] = ()) -> None:
        """
        Args:
            max_occlusion: a true pose that is more occluded than this counts neither way.
            parameter_names: (k) in the order of every parameter array; without them the mean alone is given.
        """
        super().__init__(sync_on_compute=False)
        self.max_occlusion = max_occlusion
        self.parameter_names = tuple(parameter_names)
        for name in _FIELDS + _ERRORS:
            self.add_state(name, default=[], dist_reduce_fx=None)

    def update(
        self,
        space: PoseSpace,
        truth: TruePoses,
        results: ScoredPoses,
        truth_parameters: Tensor | None = None,
        result_parameters: Tensor | None = None,
    ) -> None:
        """Add one scene.

        Args:
            space: the pose distance of the scene's part object.
            truth_parameters: (m, k), result_parameters: (n, k) metres; both or neither.
        """
        self._check(truth_parameters, result_parameters)
        match = match_scene(space, truth, results, self.max_occlusion)
        for name in _FIELDS:
            getattr(self, name).append(getattr(match, name))
        i, j = nearest_matches(match)
        self._append_pose_errors(space, truth, results, i, j)
        if truth_parameters is not None and result_parameters is not None:
            error = parameter_error(truth_parameters.cpu()[i], result_parameters.cpu()[j])
            self._states("parameter").append(error.double())

    def compute(self) -> dict[str, float]:
        """All numbers; the names say the units."""
        matches, curve = self._matches(), self.curve()
        true, false = count_positives(matches)
        return {
            "AP": average_precision(curve),
            "MAP": mean_average_precision(matches),
            "F1": best_f1(curve),
            "recall_at_precision_99": recall_at_precision(curve),
            "position_error_mm": 1000 * self._mean("position"),
            "axis_error_deg": math.degrees(self._mean("axis")),
            "parameter_error_mm": 1000 * self._mean("parameter"),
            **self._named_errors(),
            "true_positives": true,
            "false_positives": false,
            "truths_to_find": sum(int(m.relevant.sum()) for m in matches),
            "results": sum(len(m.score) for m in matches),
            "scenes": len(matches),
        }

    def curve(self) -> PrecisionRecallCurve:
        """Precision and recall over the score threshold."""
        return precision_recall_curve(self._matches())

    def _append_pose_errors(
        self, space: PoseSpace, truth: TruePoses, results: ScoredPoses, i: Tensor, j: Tensor
    ) -> None:
        Ra, ta, Rb, tb = truth.R[i], truth.t[i], results.R[j], results.t[j]
        self._states("position").append(position_error(space, Ra, ta, Rb, tb))
        self._states("axis").append(axis_error(space, Ra, Rb))

    def _check(self, truth_parameters: Tensor | None, result_parameters: Tensor | None) -> None:
        if (truth_parameters is None) != (result_parameters is None):
            raise ValueError("parameters are given for the truth or the results only, expected both")
        names = self.parameter_names
        if truth_parameters is not None and names and truth_parameters.shape[-1] != len(names):
            raise ValueError(f"{truth_parameters.shape[-1]} parameters, expected {', '.join(names)}")

    def _named_errors(self) -> dict[str, float]:
        """By key, mm. Means over all: NaN where some lack the parameter; no key where all do (PPR-Net)."""
        values = self._states("parameter")
        columns = torch.cat(values).T if values else ()
        return {
            f"parameter_error_mm/{name}": 1000 * float(column.mean())
            for name, column in zip(self.parameter_names, columns, strict=False)
            if not bool(column.isnan().all())
        }

    def _states(self, name: str) -> list[Tensor]:
        return getattr(self, name)

    def _matches(self) -> list[SceneMatch]:
        # the states follow the module to a device, scoring stays on the CPU
        rows = zip(*(self._states(name) for name in _FIELDS), strict=True)
        return [SceneMatch(*(field.cpu() for field in row)) for row in rows]

    def _mean(self, name: str) -> float:
        values = self._states(name)
        return float(torch.cat(values).mean()) if values else math.nan
