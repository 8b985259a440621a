"""Scalars of a training and the figures of curves."""

import math

import pytest
from torch.utils.tensorboard import SummaryWriter

from pnet.reporting.training_curves import curve_figure, read_scalars, training_figure


def write_scalars(folder, tag, values, **options):
    with SummaryWriter(folder, **options) as writer:
        for step, value in values:
            writer.add_scalar(tag, value, step)


def test_what_was_written_is_read(tmp_path):
    write_scalars(tmp_path / "tensorboard", "train/loss", [(0, 4.0), (10, 2.0), (20, 1.0)])
    write_scalars(tmp_path / "tensorboard" / "below", "val/AP", [(20, 0.5)])
    assert read_scalars(tmp_path) == {
        "train/loss": ([0, 10, 20], [4.0, 2.0, 1.0]),
        "val/AP": ([20], [0.5]),
    }


def test_many_scalars_are_all_read(tmp_path):
    write_scalars(tmp_path, "train/loss", [(i, 1.0) for i in range(11_000)])
    assert len(read_scalars(tmp_path)["train/loss"][0]) == 11_000


def test_a_resumed_training_counts_where_both_have_a_step(tmp_path):
    write_scalars(tmp_path, "train/loss", [(0, 4.0), (10, 3.0)], filename_suffix=".z")
    write_scalars(tmp_path, "train/loss", [(10, 2.0), (20, 1.0)], filename_suffix=".a")
    assert read_scalars(tmp_path) == {"train/loss": ([0, 10, 20], [4.0, 2.0, 1.0])}


def test_a_missing_or_empty_folder_and_an_empty_file_give_nothing(tmp_path):
    assert read_scalars(tmp_path / "none") == {}
    assert read_scalars(tmp_path) == {}
    (tmp_path / "events.out.tfevents.0.host").touch()
    assert read_scalars(tmp_path) == {}


def test_a_file_that_was_cut_off_is_read_as_far_as_it_is_whole(tmp_path):
    write_scalars(tmp_path, "train/loss", [(0, 4.0), (10, 2.0)])
    (path,) = tmp_path.iterdir()
    path.write_bytes(path.read_bytes()[:-5])
    assert read_scalars(tmp_path) == {"train/loss": ([0], [4.0])}


def test_training_figure_shows_only_what_there_is():
    figure = training_figure({"train_loss/centroid": ([0, 10], [1.0, 0.1]), "hp_metric": ([0], [1.0])})
    assert [trace.name for trace in figure.data] == ["centroid"]
    assert figure.layout.yaxis.type == "log"
    assert "yaxis2" not in figure.layout


def test_training_figure_has_losses_ap_and_learning_rate():
    column = ([0, 10], [1.0, 0.1])
    tags = ["train/loss", "train_loss/keypoints", "val/loss", "val_loss/keypoints", "val/AP", "lr-AdamW"]
    figure = training_figure(dict.fromkeys(tags, column))
    shown = {trace.name: trace for trace in figure.data}
    assert set(shown) == {
        "total loss",
        "keypoints",
        "total loss, validation",
        "keypoints, validation",
        "AP, validation",
        "learning rate",
    }
    assert shown["keypoints"].line.color == shown["keypoints, validation"].line.color
    assert [figure.layout[f"yaxis{row}"].title.text for row in ("", 2, 3)] == [
        "loss (log)",
        "validation AP",
        "learning rate",
    ]


def test_no_scalars_make_no_training_figure():
    assert training_figure({}) is None
    assert training_figure({"hp_metric": ([0], [1.0])}) is None


def test_long_curves_are_thinned():
    steps = list(range(100_000))
    figure = training_figure({"train/loss": (steps, [float(step) for step in steps])})
    assert len(figure.data[0].x) == 2000
    assert list(figure.data[0].y) == list(figure.data[0].x)


def test_curve_figure_draws_precision_over_recall():
    figure = curve_figure([1.0, 1.0, 0.5], [0.0, 0.4, 0.8], 0.6)
    assert list(figure.data[0].x) == [0.0, 0.4, 0.8]
    assert list(figure.data[0].y) == [1.0, 1.0, 0.5]
    assert "0.600" in figure.layout.title.text


def test_the_curve_s_steps_enclose_the_ap():
    # AP = Σ (r_k − r_{k−1}) p_k: each step has the height of its right end, plotly's "vh"
    assert curve_figure([1.0, 0.5], [0.0, 1.0], 0.5).data[0].line.shape == "vh"


@pytest.mark.parametrize("ap", [None, math.nan])
def test_a_curve_without_ap_is_drawn(ap):
    figure = curve_figure([], [], ap)
    assert figure.layout.title.text == "Precision and recall"
