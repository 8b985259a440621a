"""Tables of the paper as bars."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.container import ErrorbarContainer
from matplotlib.patches import Rectangle
from PIL import Image

from pnet.reporting.paper_chart import WIDTH, chart, chart_figure
from pnet.reporting.paper_table import PUBLISHED_NOTE, Cell, Column, PaperTable, Row

OURS, PUBLISHED = to_rgb("#0072b2"), to_rgb("#b84700")


def paper_table(number, names, columns, published, ours=None, **options):
    """`ours` maps (row, column) to values; rows without any are only published."""
    ours = ours or {}
    rows = []
    for i, name in enumerate(names):
        cells = tuple(Cell(ours.get((i, j), ()), published[i][j]) for j in range(len(columns)))
        measured = any(place[0] == i for place in ours)
        rows.append(Row(name, cells, "both" if measured else "published"))
    return PaperTable(number, "Ability", "mAP", "small", "Object", columns, tuple(rows), **options)


@pytest.fixture
def fourth():
    """Like Table IV: two columns in each of three groups."""
    columns = tuple(Column(name, f"Learn {x}") for x in ("all", "1/3", "1/5") for name in ("PPR-Net", "Ours"))
    published = [[0.79, 0.93, 0.78, 0.86, 0.77, 0.86], [0.99, 1.0, 0.94, 0.98, 0.56, 0.63]]
    published += [[1.0, 1.0, 0.96, 1.0, 0.83, 0.86], [0.28, 0.51, 0.22, 0.41, 0.18, 0.39]]
    ours = {(0, 1): (0.9, 0.92), (1, 0): (0.97,), (2, 3): (0.9, 0.99, 0.8), (3, 5): (0.0,)}
    return paper_table("IV", ("TN06", "TN16", "TN34", "TN42"), columns, published, ours)


@pytest.fixture
def second():
    """Like Table II: most rows only published, and a row of ours."""
    names = ("PPF", "PPF PP", "LINEMOD+", "LINEMOD+ PP", "Sock et al.", "PPR-Net", "PPR-Net with ICP")
    names += ("OP-Net₁", "OP-Net₂", "ParametricNet")
    columns = tuple(Column(name) for name in ("C.stick", "Gear", "T-Less20", "T-Less29"))
    published = [[0.16, 0.62, 0.2, 0.19]] * 4 + [[0.64, None, None, None]] + [[0.91, None, 0.81, None]] * 2
    published += [[0.97, 0.84, 0.88, 0.58]] * 2 + [[0.97, 1.0, 0.92, 0.94]]
    table = paper_table("II", names, columns, published, {(9, 0): (0.9, 0.8), (5, 1): (0.5,)})
    return replace(table, rows=(*table.rows, Row("Range U-Net", (Cell((0.7,)),) * 4, "ours")))


def bars(figure):
    """Heights of our bars and of the hollow ones, from left to right."""
    found = [patch for axes in figure.axes for patch in axes.patches if patch.get_zorder() > 1]
    hollow = [patch for patch in found if not patch.get_fill()]
    filled = [patch for patch in found if patch.get_fill()]
    return tuple(
        [bar.get_height() for bar in sorted(group, key=Rectangle.get_x)] for group in (filled, hollow)
    )


def texts(figure):
    legend = [text for legend in figure.legends for text in legend.get_texts()]
    inside = [text for axes in figure.axes for text in (*axes.texts, *axes.get_yticklabels())]
    return [text for text in (*figure.texts, *inside, *legend) if text.get_text()]


def words(figure):
    return [text.get_text() for text in texts(figure)]


def dashes(figure):
    """x of the marks of what is missing."""
    lines = [line for axes in figure.axes for line in axes.lines if np.ptp(line.get_ydata()) == 0]
    return sorted(float(np.mean(line.get_xdata())) for line in lines if line.get_ydata()[0] < 0.1)


def assert_texts_are_apart_and_inside(figure):
    FigureCanvasAgg(figure).draw()
    names = words(figure)
    boxes = np.array([text.get_window_extent().extents for text in texts(figure)])
    assert (boxes[:, :2] >= 0).all() and (boxes[:, 2:] <= figure.bbox.extents[2:]).all()
    apart = (boxes[:, None, :2] >= boxes[None, :, 2:]).any(-1)
    overlaps = np.argwhere(np.triu(~(apart | apart.T), 1))
    assert [(names[i], names[j]) for i, j in overlaps] == []


@pytest.mark.parametrize("name", ["fourth", "second"])
def test_the_file_is_a_picture_1200_pixels_wide_and_nothing_else_is_left(name, tmp_path, request):
    chart(request.getfixturevalue(name), tmp_path / "table.png")
    with Image.open(tmp_path / "table.png") as picture:
        assert picture.format == "PNG" and picture.width == WIDTH == 1200 and 600 < picture.height < 1000
        assert picture.info["dpi"] == pytest.approx((150, 150), abs=0.1)
        assert picture.convert("RGB").getpixel((2, 2)) == (255, 255, 255)
    assert [path.name for path in tmp_path.iterdir()] == ["table.png"]


def test_nothing_is_left_where_the_file_cannot_be_written(fourth, tmp_path, monkeypatch):
    def broken(*_):
        raise OSError("the disk is full")

    monkeypatch.setattr("pnet.scenes.record_file.os.replace", broken)
    with pytest.raises(OSError, match="full"):
        chart(fourth, tmp_path / "table.png")
    assert list(tmp_path.iterdir()) == []


def test_bars_are_as_high_as_the_values_the_published_ones_hollow(fourth):
    filled, hollow = bars(chart_figure(fourth))
    assert filled == pytest.approx([0.97, 0.91, 2.69 / 3, 0.0])
    assert hollow == [row.cells[j].published for j in range(6) for row in fourth.rows]


def test_ours_and_the_published_are_seen_in_the_picture(fourth, tmp_path):
    chart(fourth, tmp_path / "table.png")
    with Image.open(tmp_path / "table.png") as picture:
        pixels = np.asarray(picture.convert("RGB")) / 255
    for colour in (OURS, PUBLISHED):
        assert (np.abs(pixels - colour).max(-1) < 0.01).sum() > 1000


def test_error_bars_are_the_deviation_and_lie_within_the_axes():
    table = paper_table("III", ("TN06",), (Column("L"),), [[0.9]], {(0, 0): (0.8, 1.0, 1.0)})
    (axes,) = chart_figure(table).axes
    (errors,) = [container for container in axes.containers if isinstance(container, ErrorbarContainer)]
    ((low, high),) = errors.lines[2][0].get_segments()
    assert (low[1], high[1]) == pytest.approx((2.8 / 3 - 0.115470, 2.8 / 3 + 0.115470), abs=1e-6)
    assert axes.get_ylim()[0] == 0 and axes.get_ylim()[1] > high[1] > 1


def test_only_missing_values_of_our_own_are_marked(second):
    figure = chart_figure(second)
    rows = len(second.rows)
    missing = [(5, j) for j in (0, 2, 3)] + [(9, j) for j in (1, 2, 3)]
    assert dashes(figure) == pytest.approx(sorted(j * (rows + 1) + i for i, j in missing))


def test_every_published_number_is_in_brackets(fourth):
    found = words(chart_figure(fourth))
    assert sum(word.startswith("[0.") or word.startswith("[1.") for word in found) == 24
    assert found.count("0.910") == 1 and found.count("–") == 20
    assert {"[published]", "here"} <= set(found)


def test_title_warnings_groups_names_and_legend_are_written(fourth):
    found = words(chart_figure(replace(fourth, warnings=("two protocols",))))
    assert found[:3] == ["Table IV: Ability", "mAP; protocol: small", "Note: two protocols"]
    assert {"Learn all", "Learn 1/3", "Learn 1/5"} <= set(found)
    assert found.count("PPR-Net") == found.count("Ours") == 3 and found.count("TN06") == 6
    assert PUBLISHED_NOTE in found and "as published" in PUBLISHED_NOTE
    assert "missing: no value measured here" in found


@pytest.mark.parametrize("name", ["fourth", "second"])
def test_texts_stay_apart_and_inside(name, request):
    table = request.getfixturevalue(name)
    assert_texts_are_apart_and_inside(chart_figure(table))
    long = "Ours are measured on synthetic scenes, the published ones on real ones. " * 4
    assert_texts_are_apart_and_inside(
        chart_figure(replace(table, title="Ability " * 20, warnings=(long, "b")))
    )


@settings(max_examples=8, deadline=None)
@given(rows=st.integers(1, 12), columns=st.integers(1, 10), length=st.integers(1, 6), group=st.integers(0, 5))
def test_texts_stay_apart_and_inside_whatever_the_size(rows, columns, length, group):
    names = tuple(f"Method {i} {'of many words ' * length}".strip() for i in range(rows))
    heads = tuple(Column("PPR-Net", f"Learn {j // group}" if group else None) for j in range(columns))
    ours = {(i, j): (0.5, 0.75) for i in range(0, rows, 2) for j in range(columns)}
    table = paper_table("V", names, heads, [[0.5] * columns] * rows, ours)
    assert_texts_are_apart_and_inside(chart_figure(table))


def test_columns_that_do_not_fit_go_into_another_band(fourth):
    columns = tuple(Column(f"c{i}", "one") for i in range(24))
    table = paper_table("V", ("a", "b", "c", "d"), columns, [[0.5] * 24] * 4)
    figure = chart_figure(table)
    assert len(figure.axes) == 3 and len(chart_figure(fourth).axes) == 1
    assert [len(axes.patches) for axes in figure.axes] == [8 * 5] * 3
    assert words(figure).count("one") == 3
    assert_texts_are_apart_and_inside(figure)


def test_names_are_not_read_as_formulas(fourth):
    name = r"w/o $M_V \frac$"
    table = replace(fourth, title=name, rows=(replace(fourth.rows[0], name=name),), columns=fourth.columns)
    figure = chart_figure(table)
    FigureCanvasAgg(figure).draw()
    assert words(figure).count(name) == 6


def test_a_table_of_nothing_is_refused(fourth, tmp_path):
    with pytest.raises(ValueError, match=r"table IV: nothing to draw; give at least one row and one column"):
        chart(replace(fourth, rows=()), tmp_path / "table.png")
    assert list(tmp_path.iterdir()) == []
