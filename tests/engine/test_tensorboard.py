"""What TensorBoard reads back: rows of runs, settings, precision-recall curves, meshes."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.data_provider import MultiplexerDataProvider
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.plugin_event_multiplexer import EventMultiplexer
from tensorboard.context import RequestContext
from tensorboard.plugins.base_plugin import TBContext
from tensorboard.plugins.hparams import api_pb2
from tensorboard.plugins.hparams.backend_context import Context
from tensorboard.plugins.hparams.get_experiment import Handler as ExperimentHandler
from tensorboard.plugins.hparams.list_session_groups import Handler as GroupsHandler
from tensorboard.util.tensor_util import make_ndarray
from torch.utils.tensorboard import SummaryWriter

from pnet.engine.evaluation import SceneScorer
from pnet.engine.tensorboard import (
    COLUMNS,
    MOST_OBJECTS,
    MOST_VERTICES,
    add_curves,
    add_mesh,
    add_settings,
    curve_arrays,
    log_hyperparameters,
)
from pnet.metrics.average_precision import (
    PrecisionRecallCurve,
    average_precision,
    count_positives,
    precision_recall_curve,
)
from pnet.metrics.matching import SceneMatch
from pnet.records import Detections, Scene

SETTINGS = {"part": "tn34", "lr": 0.001, "visibility_module": True}
SCORES = {"final/mAP_L": 0.5, "final/mAP_G": None}


def log(folder, settings=SETTINGS, scores=SCORES, curves=None):
    log_hyperparameters(folder, settings, ("part",), scores, curves or {})


def hparams_page(folder):
    """The columns and the rows of the page, as TensorBoard's own code makes them."""
    events = EventMultiplexer().AddRunsFromDirectory(str(folder))
    events.Reload()
    context = Context(TBContext(data_provider=MultiplexerDataProvider(events, str(folder))))
    statuses = [api_pb2.STATUS_SUCCESS]
    request = api_pb2.ListSessionGroupsRequest(
        start_index=0, slice_size=99, allowed_statuses=statuses, include_metrics=True
    )
    groups = GroupsHandler(RequestContext(), context, "", request).run().session_groups
    asked = api_pb2.GetExperimentRequest(include_metrics=True)
    experiment = ExperimentHandler(RequestContext(), context, "", asked).run()
    rows = {
        group.name: SimpleNamespace(
            sessions=len(group.sessions),
            settings={name: getattr(v, v.WhichOneof("kind")) for name, v in group.hparams.items()},
            scores={m.name.tag: round(m.value, 6) for m in group.metric_values},
        )
        for group in groups
    }
    return experiment, rows


def read(folder):
    return EventAccumulator(str(folder), size_guidance={"tensors": 0}).Reload()


def tensors(folder, tag):
    return [make_ndarray(event.tensor_proto) for event in read(folder).Tensors(tag)]


def detections(R, t, parameters, score) -> Detections:
    none = torch.zeros(0, dtype=torch.int64)
    return Detections(R, t, parameters, score, torch.zeros(len(t), 3, 3), none)


def found_in(scene: Scene, seed: int | None = None) -> Detections:
    """The true poses; with a seed some are missed, some found twice, some moved, scores at random."""
    pick, off, score = np.arange(len(scene.R)), 0.0, np.linspace(1, 0.5, len(scene.R))
    if seed is not None:
        rng = np.random.default_rng(seed)
        pick = rng.integers(0, len(scene.R), 2 * len(scene.R))
        off, score = rng.normal(0, 0.002, (len(pick), 3)), rng.random(len(pick))
    columns = (scene.R[pick], scene.t[pick] + off, scene.parameters[pick], score)
    return detections(*map(torch.from_numpy, columns))


def scored(part, scenes, seed=None):
    return SceneScorer(part).add_all(scenes, [found_in(scene, seed) for scene in scenes]).metrics


def matches(metrics) -> list[SceneMatch]:
    fields = (metrics.score, metrics.truth, metrics.distance, metrics.matched, metrics.relevant)
    return [SceneMatch(*row) for row in zip(*fields, strict=True)]


def match(score, truth, matched, relevant) -> SceneMatch:
    n = len(score)
    return SceneMatch(
        torch.tensor(score, dtype=torch.float64),
        torch.tensor(truth),
        torch.zeros(n, dtype=torch.float64),
        torch.tensor(matched, dtype=torch.bool),
        torch.tensor(relevant, dtype=torch.bool),
    )


# the page that compares runs


def test_each_run_is_one_row_and_all_have_the_same_columns(tmp_path):
    log(tmp_path / "a" / "tensorboard")
    log(tmp_path / "b" / "tensorboard", {**SETTINGS, "lr": 0.1}, {"final/mAP_L": 0.25, "final/mAP_G": 0.75})
    experiment, rows = hparams_page(tmp_path)
    assert set(rows) == {"a/tensorboard", "b/tensorboard"}
    assert [row.sessions for row in rows.values()] == [1, 1]
    assert rows["a/tensorboard"].settings == SETTINGS
    assert rows["b/tensorboard"].settings == {**SETTINGS, "lr": 0.1}
    assert rows["a/tensorboard"].scores == {"final/mAP_L": 0.5}  # there was no G
    assert rows["b/tensorboard"].scores == {"final/mAP_L": 0.25, "final/mAP_G": 0.75}
    assert [info.name.tag for info in experiment.metric_infos] == ["final/mAP_L", "final/mAP_G"]


def test_columns_have_their_types_and_those_asked_for_come_first(tmp_path):
    log(tmp_path)
    columns = hparams_page(tmp_path)[0].hparam_infos
    assert [(column.name, column.type) for column in columns] == [
        ("part", api_pb2.DATA_TYPE_STRING),
        ("lr", api_pb2.DATA_TYPE_FLOAT64),
        ("visibility_module", api_pb2.DATA_TYPE_BOOL),
    ]
    assert list(columns[2].domain_discrete) == [False, True]


def test_what_is_logged_last_counts(tmp_path):
    folder = tmp_path / "run" / "tensorboard"
    with SummaryWriter(str(folder)) as training:
        training.add_scalar("train/loss", 2.0, 10)
    log(folder, scores={"final/mAP_L": 0.5, "final/mAP_G": 0.1})
    log(folder, {**SETTINGS, "steps": 80}, {"final/mAP_L": 0.625, "final/mAP_G": None})
    (row,) = hparams_page(tmp_path)[1].values()
    assert row.settings == {**SETTINGS, "steps": 80}
    assert row.scores == {"final/mAP_L": 0.625}
    events = read(folder)
    assert [event.value for event in events.Scalars("final/mAP_L")] == [0.625]
    assert [event.value for event in events.Scalars("train/loss")] == [2.0]
    assert len(list(folder.iterdir())) == 2


def test_a_failure_leaves_the_earlier_row(tmp_path):
    log(tmp_path)
    with pytest.raises(KeyError):
        log(tmp_path, curves={"final/precision_recall_test_l": {"recall": [0, 1]}})
    assert hparams_page(tmp_path)[1]["."].scores == {"final/mAP_L": 0.5}


def test_curves_of_evaluations_are_drawn(tmp_path):
    log(tmp_path, curves={"final/precision_recall_test_l": {"recall": [0, 1], "precision": [1, 0.5]}})
    (image,) = read(tmp_path).Images("final/precision_recall_test_l")
    assert image.width > 300 and image.encoded_image_string.startswith(b"\x89PNG")


def test_settings_stand_there_once_after_several_starts(tmp_path):
    for steps in (40, 80, 120):
        add_settings(tmp_path, f"trainer:\n  steps: {steps}\n")
    (text,) = tensors(tmp_path, "settings/text_summary")
    assert text.item() == b"```yaml\ntrainer:\n  steps: 120\n```"


# precision over recall


def test_curve_arrays_of_a_case_by_hand():
    """Three bodies to find; by falling score: found, found twice, too occluded, found."""
    scene = match([0.9, 0.8, 0.7, 0.6], [0, 0, 3, 1], [1, 1, 1, 1], [1, 1, 1, 0])
    arrays = curve_arrays([scene])
    assert arrays.shape == (6, COLUMNS)
    steps = arrays[:, np.append(True, (np.diff(arrays) != 0).any(0))]
    tp, fp, tn, fn, precision, recall = steps
    # the first column has all results; the occluded one counts neither way and makes no step
    assert tp.tolist() == [2, 1, 1, 0]
    assert fp.tolist() == [1, 1, 0, 0]
    assert fn.tolist() == [1, 2, 2, 3]
    assert tn.tolist() == [0, 0, 0, 0]
    assert precision == pytest.approx([2 / 3, 1 / 2, 1, 1])
    assert recall == pytest.approx([2 / 3, 1 / 3, 1 / 3, 0])


def test_counts_are_sums_over_scenes_and_precision_and_recall_are_means():
    """One of two bodies found beside a false result; a bin without bodies where one is found."""
    scenes = [match([0.9, 0.5], [1, 0], [1, 0], [1, 1]), match([0.7], [-1], [0], [])]
    arrays = curve_arrays(scenes)
    assert arrays[:, 0] == pytest.approx([1, 2, 0, 1, (1 / 2 + 0) / 2, (1 / 2 + 1) / 2])
    assert tuple(arrays[:2, 0]) == count_positives(scenes)


def test_a_short_curve_is_there_with_every_point(tn34, make_scene):
    scenes = [make_scene(tn34, bodies=d, seed=d) for d in (2, 5, 8)]
    found = matches(scored(tn34, scenes, seed=1))
    exact, arrays = precision_recall_curve(found), curve_arrays(found)
    assert 20 < len(exact.recall) < COLUMNS
    drawn = {(float(p), float(r)) for p, r in arrays[4:].T}
    assert drawn == {(float(p), float(r)) for p, r in zip(exact.precision, exact.recall, strict=True)}
    precision, recall = arrays[4:, ::-1]
    ap = average_precision(PrecisionRecallCurve(precision, recall, np.zeros(COLUMNS)))
    assert ap == pytest.approx(average_precision(exact), abs=1e-12) and 0 < ap < 1


def test_of_a_single_scene_the_counts_give_precision_and_recall(tn34, make_scene):
    found = matches(scored(tn34, [make_scene(tn34, bodies=8)], seed=3))
    tp, fp, _, fn, precision, recall = curve_arrays(found)
    some = tp + fp > 0
    assert precision[some] == pytest.approx((tp / np.maximum(tp + fp, 1))[some])
    assert recall == pytest.approx(tp / (tp + fn))
    assert (np.diff(tp) <= 0).all() and (np.diff(fp) <= 0).all()


def test_a_long_curve_is_thinned_to_points_of_its_own():
    rng = np.random.default_rng(0)
    n = 1000
    found = [match(rng.random(n), rng.integers(0, 300, n), rng.random(n) < 0.7, np.ones(300))]
    exact, arrays = precision_recall_curve(found), curve_arrays(found)
    points = {(float(p), float(r)) for p, r in zip(exact.precision, exact.recall, strict=True)}
    assert {(float(p), float(r)) for p, r in arrays[4:].T} <= points
    assert arrays[4:, 0].tolist() == [exact.precision[-1], exact.recall[-1]]
    assert arrays[:, -1].tolist() == [0, 0, 0, 300, 1, 0]


def test_nothing_found_is_a_curve_without_positives():
    arrays = curve_arrays([match([], np.zeros(0, int), [], [1, 1])])
    assert np.unique(arrays, axis=1).tolist() == [[0], [0], [0], [2], [1], [0]]


@pytest.mark.parametrize("objects, curves", [(1, 1), (3, 4), (MOST_OBJECTS + 1, 1)])
def test_part_objects_have_curves_of_their_own_where_they_are_few(
    tn34, make_scene, tmp_path, objects, curves
):
    scenes = [make_scene(tn34, seed=seed) for seed in range(objects)]
    sizes = [scene.parameters[0] for scene in scenes]
    with SummaryWriter(str(tmp_path)) as writer:
        add_curves(writer, tn34, scored(tn34, scenes), sizes, 5)
    events = read(tmp_path)
    tags = events.summary_metadata
    found = [tag for tag in tags if tags[tag].plugin_data.plugin_name == "pr_curves"]
    assert len(found) == curves and "precision_recall/tn34" in found
    assert ("precision_recall/tn34_12x10" in found) == (objects == 3)
    assert events.Tags()["images"] == ["val/precision_recall"]


def test_the_curve_of_a_part_object_is_of_its_scenes(tn34, make_scene, tmp_path):
    empty = make_scene(tn34, bodies=1)
    empty = replace(
        empty, **{k: getattr(empty, k)[:0] for k in ("R", "t", "parameters", "visibility", "occlusion")}
    )
    scenes = [make_scene(tn34, seed=seed) for seed in (0, 1, 0)] + [empty]
    sizes = [scene.parameters[0] if len(scene.parameters) else None for scene in scenes]
    metrics = scored(tn34, scenes, seed=0)
    with SummaryWriter(str(tmp_path)) as writer:
        for step in (5, 10):
            add_curves(writer, tn34, metrics, sizes, step)
    own = matches(metrics)
    events = read(tmp_path).Tensors("precision_recall/tn34_12x10")
    assert [event.step for event in events] == [5, 10]
    array = make_ndarray(events[0].tensor_proto)
    assert np.array_equal(array, curve_arrays([own[0], own[2]]).astype(np.float32))
    (every, _) = tensors(tmp_path, "precision_recall/tn34")
    assert np.array_equal(every, curve_arrays(own).astype(np.float32))


# meshes


def mesh_of(folder, part, scene, found):
    with SummaryWriter(str(folder)) as writer:
        add_mesh(writer, part, scene, found, 7)
    kinds = ("VERTEX", "FACE", "COLOR")
    return [tensors(folder, f"val/estimates_{kind}")[0][0] for kind in kinds]


def test_estimates_are_drawn_in_their_poses(tn34, make_scene, tmp_path):
    scene = make_scene(tn34, bodies=2)
    vertices, faces, _ = mesh_of(tmp_path, tn34, scene, found_in(scene))
    mesh = tn34.mesh(scene.parameters[0])
    n = len(mesh.vertices)
    assert vertices.shape == (2 * n, 3) and faces.max() == 2 * n - 1
    placed = mesh.vertices @ scene.R[1].T + scene.t[1] - scene.points.mean(0)
    assert vertices[n:] == pytest.approx(placed * [1, -1, -1], abs=1e-6)
    (points,) = tensors(tmp_path, "val/points_VERTEX")
    assert points.shape == (1, 400, 3)


@pytest.mark.parametrize("value", [np.nan, -0.01])
def test_axes_stand_for_parts_of_unknown_or_impossible_size(tn34, make_scene, tmp_path, value):
    scene = make_scene(tn34, bodies=2)
    found = found_in(scene)
    found = replace(found, parameters=torch.full_like(found.parameters, value))
    vertices, faces, colours = mesh_of(tmp_path, tn34, scene, found)
    assert vertices.shape == (24, 3) and faces.shape == (24, 3) and faces.max() == 23
    assert colours[::4].tolist() == 2 * [[255, 0, 0], [0, 255, 0], [0, 0, 255]]
    length = tn34.mesh(tn34.part_object("L", 0)).extents.max() / 2
    tips = scene.t[1] + length * scene.R[1].T - scene.points.mean(0)  # each row an axis
    assert vertices[12::4] == pytest.approx(tips * [1, -1, -1], abs=1e-6)


def test_no_more_is_drawn_than_the_viewer_can_number(tn34, make_scene, tmp_path):
    scene = make_scene(tn34, bodies=1)
    one = found_in(scene)
    n = len(tn34.mesh(scene.parameters[0]).vertices)
    many = MOST_VERTICES // n + 2
    copies = (one.R, one.t, one.parameters, one.score)
    found = detections(*(field.repeat(many, *(1 for _ in field.shape[1:])) for field in copies))
    vertices, faces, _ = mesh_of(tmp_path, tn34, scene, found)
    assert len(vertices) == MOST_VERTICES // n * n and faces.max() < MOST_VERTICES


def test_nothing_found_draws_the_points_alone(tn34, make_scene, tmp_path):
    scene = make_scene(tn34, bodies=1)
    none = detections(torch.zeros(0, 3, 3), torch.zeros(0, 3), torch.zeros(0, 2), torch.zeros(0))
    with SummaryWriter(str(tmp_path)) as writer:
        add_mesh(writer, tn34, scene, none, 7)
    assert read(tmp_path).Tags()["tensors"] == ["val/points_VERTEX"]
