"""Tables of the paper beside our own figures."""

import csv
import io
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from pnet.reporting.paper_table import (
    CSV_HEADINGS,
    PUBLISHED_NOTE,
    RUN_HEADINGS,
    Cell,
    Column,
    PaperTable,
    Row,
    RunFacts,
    cell_texts,
    csv_text,
    duration_text,
    latex,
    markdown,
    rich_table,
    runs_table,
)

shares = st.floats(0, 1, allow_subnormal=False)
COLUMNS = (Column("PPR-Net", "Learn all"), Column("Ours", "Learn all"), Column("Speed"))
ROWS = (
    Row("TN06", (Cell((), 0.79), Cell((0.9, 0.92), 0.93), Cell())),
    Row("PPF", (Cell((), 0.2), Cell(), Cell((), 0.345)), "published"),
    Row("Keypoints", (Cell((0.5,)), Cell((0.25, 0.75)), Cell()), "ours"),
)
RUN = RunFacts("TN06", "runs/a_b", 4321, 1000, 8000, 7384.0, 979412, "H100", "66c6ce5+changes", "tn06 3f2a")
TABLE = PaperTable("IV", "Generalization", "mAP on the G-dataset", "smoke", "Object", COLUMNS, ROWS)
FULL = replace(TABLE, warnings=("two code versions",), missing=("TN06, PPR-Net: no run",), runs=(RUN,))


def one_cell(cell, **options):
    return PaperTable(
        "I", "t", "AP", "p", "Object", (Column("b|c", "a"),), (Row("TN_1", (cell,), **options),)
    )


def rows_of(table):
    """The texts of a rich table's cells."""
    return [
        [str(cell) for cell in row] for row in zip(*(column.cells for column in table.columns), strict=True)
    ]


def printed(table, width=120):
    console = Console(width=width, file=io.StringIO())
    console.print(table)
    return console.file.getvalue()


def pipe_cells(line):
    """The cells of a line of a pipe table, as GitHub splits them."""
    return [cell.strip() for cell in re.findall(r"((?:\\.|[^|\\])*)\|", line.strip().removeprefix("|"))]


def tabular(text):
    """The lines between the rules of a LaTeX table, as cells."""
    lines = text.split("\\toprule\n")[1].split("\\bottomrule")[0].splitlines()
    return [line.removesuffix(r" \\").split(" & ") for line in lines if line.endswith(r"\\")]


def braces_balance(text):
    depth = 0
    for brace in re.findall(r"(?<!\\)[{}]", text):
        depth += 1 if brace == "{" else -1
        assert depth >= 0
    return depth == 0


@given(st.lists(shares, min_size=2, max_size=9), shares)
def test_mean_deviation_and_difference_are_numpys(values, published):
    cell = Cell(tuple(values), published)
    assert cell.mean == pytest.approx(np.mean(values))
    assert cell.deviation == pytest.approx(np.std(values, ddof=1), abs=1e-12)
    assert cell.difference == pytest.approx(np.mean(values) - published, abs=1e-12)


def test_without_values_there_is_no_mean_and_below_two_no_deviation():
    assert (Cell().mean, Cell().deviation, Cell((), 0.5).difference) == (None, None, None)
    assert (Cell((0.5,)).mean, Cell((0.5,)).deviation, Cell((0.5,)).difference) == (0.5, None, None)


@pytest.mark.parametrize(
    ("cell", "origin", "texts"),
    [
        (Cell((0.9, 0.92), 0.93), "both", ("0.910 ± 0.014", "[0.93]", "-0.020")),
        (Cell((0.95,), 0.9), "both", ("0.950", "[0.90]", "+0.050")),
        (Cell((0.5,), 0.5001), "both", ("0.500", "[0.5001]", "+0.000")),
        (Cell((), 1.0), "both", ("–", "[1.00]", "")),
        (Cell((0.5,)), "ours", ("0.500", "", "")),
        (Cell(), "ours", ("–", "", "")),
        (Cell((), 0.345), "published", ("", "[0.345]", "")),
        (Cell(), "published", ("–", "", "")),
    ],
)
def test_texts_of_a_cell(cell, origin, texts):
    assert cell_texts(Row("TN06", (cell,), origin), cell) == texts


@given(st.one_of(st.none(), shares), st.lists(shares, max_size=4))
def test_only_published_figures_are_in_brackets_and_all_of_them(published, values):
    ours, quoted, signed = cell_texts(Row("r", ()), Cell(tuple(values), published))
    assert "[" not in ours + signed and (quoted == "") == (published is None)
    if published is not None:
        assert quoted[0] == "[" and quoted[-1] == "]"
        assert float(quoted[1:-1]) == pytest.approx(published, rel=1e-5)
    assert (signed == "") == (published is None or not values)


@pytest.mark.parametrize(
    "cell", [Cell((0.5, math.nan)), Cell((math.inf,)), Cell((91.0,)), Cell((), math.nan)]
)
def test_what_is_no_share_is_refused_with_its_row_and_column(cell):
    with pytest.raises(ValueError, match=r"row 'TN_1', column 'a: b\|c'.*give numbers in \[0, 1\]"):
        one_cell(cell)


def test_a_value_that_rounding_put_above_one_is_taken():
    assert one_cell(Cell((1 + 1e-7,))).rows[0].cells[0].values == (1 + 1e-7,)


def test_a_row_with_other_than_one_cell_a_column_is_refused():
    with pytest.raises(ValueError, match=r"table I, row 'short': 1 cells; give 3, one a column"):
        PaperTable("I", "t", "AP", "p", "Object", COLUMNS, (Row("short", (Cell(),)),))


@pytest.mark.parametrize(
    ("cell", "origin", "message"),
    [
        (Cell(), "elsewhere", "origin 'elsewhere'; give one of both, published, ours"),
        (Cell((0.5,), 0.5), "published", "only published"),
        (Cell((0.5,), 0.5), "ours", "only ours"),
    ],
)
def test_a_row_whose_origin_does_not_fit_its_cells_is_refused(cell, origin, message):
    with pytest.raises(ValueError, match=message):
        one_cell(cell, origin=origin)


def test_the_terminals_table_has_the_papers_layout():
    table = rich_table(FULL)
    headings = [str(column.header) for column in table.columns]
    assert headings == ["Object", "Learn all\nPPR-Net", "Learn all\nOurs", "\nSpeed"]
    assert rows_of(table) == [
        ["TN06", "–\n[0.79]", "0.910 ± 0.014\n[0.93]\n-0.020", "–"],
        ["PPF", "[0.20]", "–", "[0.345]"],
        ["Keypoints (ours, not in the paper)", "0.500", "0.500 ± 0.354", "–"],
    ]


def test_the_terminals_table_warns_above_and_explains_below():
    text = printed(rich_table(FULL))
    order = [
        "Table IV: Generalization",
        "Note: two code versions",
        "0.910",
        "protocol: smoke",
        PUBLISHED_NOTE,
    ]
    places = [text.index(words) for words in [*order, "Missing: TN06, PPR-Net: no run"]]
    assert places == sorted(places)


def test_the_terminal_dims_published_figures_and_colours_differences():
    styles = {}
    cells = (Cell((0.9,), 0.93), Cell((0.9,), 0.8), Cell((0.9,), 0.9))
    for column in rich_table(replace(TABLE, rows=(Row("r", cells),))).columns[1:]:
        (text,) = column.cells
        styles |= {text.plain[span.start : span.end]: span.style for span in text.spans}
    assert styles["[0.93]"] == styles["[0.80]"] == "dim"
    assert styles["-0.030"] == "red" and styles["+0.100"] == "green"
    assert styles.get("+0.000", "") == ""


def test_names_are_not_read_as_rich_markup():
    table = replace(TABLE, title="[bold]", corner="[red]", rows=(Row("[dim]x", ROWS[0].cells),))
    text = printed(rich_table(table))
    assert "Table IV: [bold]" in text and "[red]" in text and "[dim]x" in text


def test_columns_without_groups_have_headings_of_one_line():
    table = rich_table(one_cell(Cell()))
    plain = rich_table(replace(TABLE, columns=(Column("a"), Column("b"), Column("c"))))
    assert str(table.columns[1].header) == "a\nb|c"
    assert [str(column.header) for column in plain.columns] == ["Object", "a", "b", "c"]


def test_a_narrow_terminal_cuts_nothing():
    text = printed(rich_table(replace(FULL, rows=FULL.rows[:1])), width=40)
    assert "…" not in text
    assert all(figure in text for figure in ("0.910", "0.014", "[0.93]", "[0.79]", "-0.020"))


def test_what_stands_behind_has_a_line_a_run():
    table = runs_table(FULL)
    assert tuple(column.header for column in table.columns) == RUN_HEADINGS
    first = ["TN06", "2 h 3 min", "8,000", "1,000", "4321", "979,412", "H100", "66c6ce5+changes", "tn06 3f2a"]
    assert rows_of(table) == [[*first, "runs/a_b"]]
    unknown = replace(FULL, runs=(replace(RUN, training_seconds=None, parameters=None),))
    assert [rows_of(runs_table(unknown))[0][i] for i in (1, 5)] == ["–", "–"]
    assert rows_of(runs_table(TABLE)) == []


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (None, "–"),
        (0.4, "0 s"),
        (59.4, "59 s"),
        (59.7, "1 min 0 s"),
        (3599.6, "1 h 0 min"),
        (100_000, "27 h 46 min"),
    ],
)
def test_times_are_readable(seconds, text):
    assert duration_text(seconds) == text


def test_markdown_is_the_table_with_its_sections():
    assert markdown(FULL) == (
        "## Table IV: Generalization\n"
        "\n"
        "### Note\n"
        "\n"
        "- two code versions\n"
        "\n"
        "| Object | Learn all: PPR-Net | Learn all: Ours | Speed |\n"
        "| --- | ---: | ---: | ---: |\n"
        "| TN06 | – [0.79] | 0.910 ± 0.014 [0.93] -0.020 | – |\n"
        "| PPF | [0.20] | – | [0.345] |\n"
        "| Keypoints (ours, not in the paper) | 0.500 | 0.500 ± 0.354 | – |\n"
        "\n"
        "mAP on the G-dataset; protocol: smoke\\\n"
        "[ ] as published in the paper; not measured here\\\n"
        "no brackets: measured here, mean ± sample standard deviation over seeds; – no value; "
        "signed: measured less published\n"
        "\n"
        "### Missing\n"
        "\n"
        "- TN06, PPR-Net: no run\n"
        "\n"
        "### What stands behind\n"
        "\n"
        "| cells | training time | scene iterations | steps | seed | parameters | device | commit | data "
        "| folder |\n"
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |\n"
        "| TN06 | 2 h 3 min | 8,000 | 1,000 | 4321 | 979,412 | H100 | 66c6ce5+changes | tn06 3f2a "
        "| runs/a_b |\n"
    )


def test_markdown_leaves_empty_sections_out():
    assert re.findall("^#+ .*", markdown(TABLE), re.MULTILINE) == ["## Table IV: Generalization"]


@given(st.text(st.characters(codec="utf-8", exclude_categories=("Cc", "Cs")), min_size=1))
def test_a_name_never_breaks_the_pipe_table(name):
    table = replace(TABLE, corner=name, rows=(Row(name, ROWS[0].cells),))
    lines = [line for line in markdown(table).split("\n") if line.startswith("|")]
    assert [len(pipe_cells(line)) for line in lines] == [4, 4, 4]
    unescaped = re.sub(r"\\([\\|<`*])", r"\1", pipe_cells(lines[2])[0])
    assert unescaped == " ".join(name.split())


def test_markdown_shows_tags_and_line_ends_in_names_as_text():
    assert "| a \\| b \\<c> \\*d\\* |" in markdown(replace(TABLE, corner="a | b\n<c> *d*"))


def test_the_csv_has_a_line_a_cell():
    lines = list(csv.reader(io.StringIO(csv_text(TABLE))))
    assert tuple(lines[0]) == CSV_HEADINGS
    place, metric = ["IV", "smoke", "TN06", "Learn all"], "mAP on the G-dataset"
    assert lines[1] == [*place, "PPR-Net", metric, "", "", "", "0.79", ""]
    assert lines[2] == [*place, "Ours", metric, "0.91", "0.014142", "2", "0.93", "-0.02"]
    assert lines[3] == ["IV", "smoke", "TN06", "", "Speed", metric, "", "", "", "", ""]
    assert lines[6][9] == "0.345"
    assert lines[7][2] == "Keypoints (ours, not in the paper)" and lines[7][6:9] == ["0.5", "", "1"]
    assert len(lines) == 10


def test_the_csv_quotes_names():
    table = replace(TABLE, title="t", rows=(Row('a, "b"\nc', ROWS[0].cells),))
    assert next(csv.DictReader(io.StringIO(csv_text(table))))["row"] == 'a, "b"\nc'


def test_latex_has_groups_over_their_columns_and_a_line_for_each_kind_of_figure():
    text = latex(FULL)
    assert braces_balance(text)
    assert r"\begin{tabular}{lrrr}" in text
    assert "\n" r"\cmidrule(lr){2-3}" "\n" in text
    assert tabular(text) == [
        ["", r"\multicolumn{2}{c}{Learn all}", r"\multicolumn{1}{c}{}"],
        ["Object", "PPR-Net", "Ours", "Speed"],
        ["TN06", "--", r"0.910 $\pm$ 0.014", "--"],
        ["", "{[}0.79{]}", "{[}0.93{]}", ""],
        ["", "", "$-0.020$", ""],
        ["PPF", "", "--", ""],
        ["", "{[}0.20{]}", "", "{[}0.345{]}"],
        ["Keypoints (ours, not in the paper)", "0.500", r"0.500 $\pm$ 0.354", "--"],
    ]


def test_latex_says_what_brackets_mean_and_what_to_beware_of():
    (caption,) = re.findall(
        r"\\caption\{(.*)\}\n", latex(replace(FULL, warnings=("two codes.", "50 % of data")))
    )
    assert caption.startswith(
        "Table IV: Generalization. mAP on the G-dataset; protocol: smoke; {[} {]} as published"
    )
    assert caption.endswith(r"Note: two codes. Note: 50 \% of data.")


def test_latex_without_groups_has_no_line_for_them():
    text = latex(replace(TABLE, columns=(Column("a"), Column("b"), Column("c"))))
    assert "multicolumn" not in text and "cmidrule" not in text


def test_a_latex_row_of_published_figures_alone_is_one_line():
    published = Row("PPF", (Cell((), 0.2), Cell((), 0.3), Cell((), 0.4)), "published")
    lines = tabular(latex(replace(TABLE, rows=(published,))))
    assert lines[2:] == [["PPF", "{[}0.20{]}", "{[}0.30{]}", "{[}0.40{]}"]]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("w/o M_V & 5 % #1 $x$ {y}", r"w/o M\_V \& 5 \% \#1 \$x\$ \{y\}"),
        (r"a\b^c~d", r"a\textbackslash{}b\textasciicircum{}c\textasciitilde{}d"),
        ("[a]* <b>|c", r"{[}a{]}{*} \textless{}b\textgreater{}\textbar{}c"),
        ("OP-Net₁ – 2 × 3", r"OP-Net$_1$ -- 2 $\times$ 3"),
    ],
)
def test_latex_escapes_names(name, text):
    found = latex(replace(TABLE, rows=(Row(name, ROWS[1].cells, "published"),)))
    assert f"\n{text} & " in found
    assert braces_balance(found)


@given(st.text("ab\\{}$&#_%[]*^~<>|–±×₁\n"))
def test_latex_names_keep_braces_and_columns(name):
    text = latex(replace(TABLE, title=name, corner=name, rows=(Row(name, ROWS[0].cells),), warnings=(name,)))
    body = re.sub(r"\\[{}&]", "", text)
    assert braces_balance(body)
    assert [line.count("&") for line in body.splitlines() if line.endswith(r"\\")] == [2, 3, 3, 3, 3]
