"""Validation scores over scenes and minutes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from PIL import Image
from torch.utils.tensorboard import SummaryWriter

from pnet.reporting.learning_curves import (
    Curve,
    CurveRun,
    curves_figure,
    learning_curves,
    mean_curve,
    read_curve,
    short_labels,
)

RUN = CurveRun(Path("none"), "TN34", ("PPR-Net",), scenes_a_step=4, steps=2000, training_seconds=1200.0)


def write(folder, values, tag="val/mAP"):
    with SummaryWriter(folder / "tensorboard") as writer:
        for step, value in values:
            writer.add_scalar(tag, value, step)
    return folder


def curve(*values, every=1000, minutes=1.0):
    count = 1.0 + np.arange(len(values))
    return Curve(np.array(values), every * count, minutes * count)


def named(part, *name):
    return replace(RUN, part=part, name=name)


def panels(figure):
    """Title and legend's texts of each part; its two axes."""
    legends = [[text.get_text() for text in legend.get_texts()] for legend in figure.legends]
    above, below = figure.axes[0::2], figure.axes[1::2]
    return {a.get_title(): (legend, a, b) for a, b, legend in zip(above, below, legends, strict=True)}


def drawn_ticks(axes):
    """Labels of the ticks within the limits; matplotlib keeps others that it does not draw."""
    low, high = axes.get_xlim()
    inside = [t for t in axes.get_xticklabels() if low <= t.get_position()[0] <= high]
    return inside + [t.label1 for t in axes.yaxis.get_major_ticks() if t.label1.get_visible()]


# reading


def test_a_validation_is_placed_by_scenes_and_by_its_share_of_the_training_time(tmp_path):
    """Step 999 is after 1,000 steps of 4 scenes, half of 2,000 steps in 20 minutes."""
    write(tmp_path, [(999, 0.25), (1999, 0.5)])
    found = read_curve(replace(RUN, folder=tmp_path))
    assert found.values.tolist() == [0.25, 0.5]
    assert found.scenes.tolist() == [4000, 8000]
    assert found.minutes.tolist() == pytest.approx([10, 20])


def test_without_a_training_time_there_are_no_minutes(tmp_path):
    write(tmp_path, [(999, 0.25)])
    for changed in ({"training_seconds": None}, {"steps": 0}):
        found = read_curve(replace(RUN, folder=tmp_path, **changed))
        assert np.isnan(found.minutes).all() and found.scenes.tolist() == [4000]


def test_the_metric_decides_which_curve_is_read(tmp_path):
    write(write(tmp_path, [(9, 0.25)]), [(9, 0.75)], "val/AP")
    assert read_curve(replace(RUN, folder=tmp_path, metric="AP")).values.tolist() == [0.75]
    assert read_curve(replace(RUN, folder=tmp_path, metric="F1")) is None


@pytest.mark.parametrize("content", [None, b"", b"no events at all, but many bytes" * 9])
def test_a_run_without_whole_tensorboard_files_is_left_out_and_named(tmp_path, content):
    good = write(tmp_path / "good", [(999, 0.25)])
    (tmp_path / "bad").mkdir()
    if content is not None:
        (tmp_path / "bad" / "events.out.tfevents.1.host").write_bytes(content)
    runs = [replace(RUN, folder=folder) for folder in (good, tmp_path / "bad")]
    assert learning_curves(runs, tmp_path / "curves.png") == [
        f"{tmp_path / 'bad'}: no val/mAP in TensorBoard files, so no learning curve"
    ]
    with Image.open(tmp_path / "curves.png") as picture:
        assert picture.format == "PNG" and picture.width == 600


def test_without_any_curve_no_file_is_written(tmp_path):
    assert len(learning_curves([replace(RUN, folder=tmp_path)], tmp_path / "curves.png")) == 1
    assert learning_curves([], tmp_path / "curves.png") == [] and list(tmp_path.iterdir()) == []


# seeds


def test_the_mean_of_seeds_is_where_all_were_validated():
    first, second = curve(0.2, 0.4, 0.9, minutes=1), Curve(*np.array([[0.4, 0.5], [2000, 3000], [4, 6]]))
    mean = mean_curve([first, second])
    assert mean.scenes.tolist() == [2000, 3000]
    assert mean.values.tolist() == pytest.approx([0.4, 0.7])
    assert mean.minutes.tolist() == pytest.approx([3, 4.5])


def test_seeds_without_a_common_validation_have_no_mean():
    assert mean_curve([curve(0.2), curve(0.4, every=999)]).values.size == 0


def test_seeds_are_thin_lines_of_the_colour_of_their_mean():
    figure = curves_figure([(RUN, curve(0.2, 0.4)), (RUN, curve(0.4, 0.8))])
    (legend, above, below), *_ = panels(figure).values()
    assert legend == ["PPR-Net (2 seeds)"]
    for axes in (above, below):
        assert [line.get_ydata().tolist() for line in axes.lines] == [
            [0.2, 0.4],
            [0.4, 0.8],
            pytest.approx([0.3, 0.6]),
        ]
        assert len({line.get_color() for line in axes.lines}) == 1
        widths = [line.get_linewidth() for line in axes.lines]
        assert widths[0] == widths[1] < 1 < widths[2]
    assert "Thin lines are seeds" in " ".join(text.get_text() for text in figure.texts)


def test_a_seed_without_a_training_time_is_in_the_upper_panel_alone():
    unknown = replace(curve(0.4, 0.8), minutes=np.full(2, np.nan))
    _, above, below = panels(curves_figure([(RUN, curve(0.2, 0.4)), (RUN, unknown)]))["TN34"]
    assert len(above.lines) == 3
    assert [line.get_ydata().tolist() for line in below.lines] == [[0.2, 0.4]]
    _, above, below = panels(curves_figure([(RUN, unknown)]))["TN34"]
    assert len(above.lines) == 1 and not below.lines and below.texts[0].get_text() == "not known"


# panels


def test_each_part_has_a_panel_over_scenes_and_one_over_minutes():
    figure = curves_figure([(named(part, "Ours"), curve(0.5)) for part in ("TN06", "TN34", "TN06")])
    found = panels(figure)
    assert list(found) == ["TN06", "TN34"]
    assert [axes.get_xlabel() for axes in figure.axes] == ["scene iterations", "minutes of training"] * 2
    assert found["TN06"][1].get_ylabel() == "validation mAP" and found["TN34"][1].get_ylabel() == ""
    assert [len(axes.lines) for axes in figure.axes] == [3, 3, 1, 1]


def test_a_name_has_its_colour_and_mark_in_every_panel():
    runs = [named("TN06", "A"), named("TN06", "B"), named("TN34", "B"), named("TN34", "C")]
    found = panels(curves_figure([(run, curve(0.5)) for run in runs]))
    look = {
        part: [(to_hex(line.get_color()), line.get_marker()) for line in above.lines]
        for part, (_, above, _) in found.items()
    }
    assert look["TN06"][1] == look["TN34"][0]
    assert len({*look["TN06"], *look["TN34"]}) == 3


def test_no_two_of_twenty_names_look_alike():
    runs = [named("TN06", f"method {i}") for i in range(20)]
    ((_, above, _),) = panels(curves_figure([(run, curve(0.5)) for run in runs])).values()
    looks = {(line.get_color(), line.get_linestyle()) for line in above.lines}
    assert len(above.lines) == len(looks) == 20


@pytest.mark.parametrize("parts", [1, 2, 4, 6])
@pytest.mark.parametrize("names", [1, 8])
def test_texts_are_apart_and_inside_the_picture(parts, names):
    texts = [f"Keypoints nearest to the camera $_{i} and to the point (3)" for i in range(names)]
    runs = [named(f"TN{i:02d}", text) for i in range(parts) for text in texts]
    figure = curves_figure([(run, curve(0.5, 0.99)) for run in runs], "Table IV: Generalization " * 4)
    FigureCanvasAgg(figure).draw()
    ticks = [text for axes in figure.axes for text in drawn_ticks(axes)]
    labels = [text for axes in figure.axes for text in (axes.title, axes.xaxis.label, axes.yaxis.label)]
    legends = [text for legend in figure.legends for text in legend.get_texts()]
    shown = [text for text in (*figure.texts, *labels, *legends, *ticks) if text.get_text()]
    shown = [text for text in shown if text.get_visible()]
    boxes = np.array([text.get_window_extent().extents for text in shown])
    assert (boxes[:, :2] >= 0).all() and (boxes[:, 2:] <= figure.bbox.extents[2:]).all()
    apart = (boxes[:, None, :2] >= boxes[None, :, 2:]).any(-1)
    overlaps = np.argwhere(np.triu(~(apart | apart.T), 1))
    assert [(shown[i].get_text(), shown[j].get_text()) for i, j in overlaps] == []


def test_many_parts_stand_in_rows_of_four():
    figure = curves_figure([(named(f"part {i}", "A"), curve(0.5)) for i in range(6)])
    lefts = [round(axes.get_position().x0, 3) for axes in figure.axes[::2]]
    assert len(set(lefts)) == 4 and lefts[:2] == lefts[4:]
    assert (
        figure.axes[0].get_position().y0 > figure.axes[1].get_position().y0 > figure.axes[8].get_position().y0
    )


# labels


@pytest.mark.parametrize(
    ("names", "labels"),
    [
        ([("PPR-Net", "", ""), ("ParametricNet", "", "")], ["PPR-Net", "ParametricNet"]),
        (
            [("", "Learn all", "Ours"), ("", "Learn 1/3", "Ours"), ("", "Learn 1/3", "PPR-Net")],
            ["all, Ours", "1/3, Ours", "1/3, PPR-Net"],
        ),
        ([("", "Learn all", "Ours"), ("", "Learn 1/3", "Ours")], ["all", "1/3"]),
        ([("", "Learn all", "Ours")], ["Learn all, Ours"]),
        ([("Net (w/o GU)", "x"), ("Net", "x"), ("Other rule", "x")], ["w/o GU", "Net", "Other rule"]),
        ([("Net (small)",), ("Other (small)",)], ["Net (small)", "Other (small)"]),
        ([("a b",), ("a",)], ["a b", "a"]),
        ([("one", "two"), ("one",)], ["one, two", "one"]),
    ],
)
def test_labels_hold_what_tells_runs_from_each_other(names, labels):
    assert list(short_labels(names).values()) == labels
