"""The files of sweeps: what they declare, the paper's figures in them, and what is wrong with a bad one."""

import pytest
import yaml

from pnet.cli.sweep_file import read_sweep, sweeps_dir

NONE = None
# typed in from the paper, apart from the files
TABLE_2 = {
    "PPF": (0.16, 0.62, 0.20, 0.19),
    "PPF PP": (0.22, 0.63, 0.23, 0.23),
    "LINEMOD+": (0.38, 0.44, 0.25, 0.20),
    "LINEMOD+ PP": (0.49, 0.50, 0.31, 0.26),
    "Sock et al.": (0.64, NONE, NONE, NONE),
    "PPR-Net": (0.91, NONE, 0.81, NONE),
    "PPR-Net with ICP": (0.95, NONE, 0.85, NONE),
    "OP-Net₁": (0.97, 0.84, 0.88, 0.58),
    "OP-Net₂": (0.96, 0.60, 0.58, 0.39),
    "ParametricNet": (0.97, 1.00, 0.92, 0.94),
}
TABLE_3 = {"PPR-Net": (0.80, 0.99, 1.00, 0.39), "ParametricNet": (0.94, 1.00, 1.00, 0.52)}
TABLE_4 = {
    "TN06": (0.79, 0.93, 0.78, 0.86, 0.77, 0.86),
    "TN16": (0.99, 1.00, 0.94, 0.98, 0.56, 0.63),
    "TN34": (1.00, 1.00, 0.96, 1.00, 0.83, 0.86),
    "TN42": (0.28, 0.51, 0.22, 0.41, 0.18, 0.39),
}
TABLE_5 = {
    "ParametricNet (w/o GU)": (0.03, 0.01, 0.82, 0.33),
    "ParametricNet (w/o RF)": (0.93, 0.99, 1.00, 0.49),
    "ParametricNet (w/o M_V)": (0.85, 0.99, 0.99, 0.36),
    "ParametricNet": (0.93, 1.00, 1.00, 0.51),
}
TEMPLATES = ["TN06", "TN16", "TN34", "TN42"]
SMALL = {
    "number": "IX",
    "title": "Try",
    "metric": "mAP",
    "split": "test_g",
    "caption": "mAP",
    "columns": [{"name": "A", "set": ["part=tn34"]}, {"name": "B", "set": ["part=tn06"]}],
    "rows": [{"name": "full", "set": ["method=parametricnet"], "published": [0.5, None]}],
}


def one(name):
    (table,) = read_sweep(name)
    return table


def published(table):
    return {row.name: row.published for row in table.rows if row.published}


# the files that pnet has


def test_every_file_reads():
    names = sorted(path.stem for path in sweeps_dir().glob("*.yaml"))
    assert names == ["all", "surface", "surface_g", "surface_l", "table2", "table3", "table4", "table5"]
    for name in names:
        for table in read_sweep(name):
            assert table.title and table.caption and list(table.cells())


def test_all_is_the_four_tables_in_order():
    assert read_sweep("all") == [one(f"table{number}") for number in (2, 3, 4, 5)]
    assert [table.number for table in read_sweep("all")] == ["II", "III", "IV", "V"]


def test_several_sweeps_are_read_once_each_in_the_order_given():
    assert [table.number for table in read_sweep("table5, table3,table5")] == ["V", "III"]
    assert [table.number for table in read_sweep("table4,all")] == ["IV", "II", "III", "V"]


@pytest.mark.parametrize(
    ("name", "figures"), [("table2", TABLE_2), ("table3", TABLE_3), ("table4", TABLE_4), ("table5", TABLE_5)]
)
def test_published_figures_are_the_papers(name, figures):
    assert published(one(name)) == figures
    assert list(published(one(name))) == list(figures)


@pytest.mark.parametrize("name", ["table3", "table5", "surface_l", "surface_g"])
def test_the_templates_are_the_columns(name):
    table = one(name)
    assert [column.name for column in table.columns] == TEMPLATES
    assert [column.set for column in table.columns] == [(f"part={name.lower()}",) for name in TEMPLATES]


def test_the_columns_of_table_4_are_shares_of_what_is_learnt():
    table = one("table4")
    assert [(column.group, column.name) for column in table.columns] == [
        (f"Learn {share}", method) for share in ("all", "1/3", "1/5") for method in ("PPR-Net", "Ours")
    ]
    methods, shares = (
        ("method=pprnet", "method=parametricnet"),
        ((), ("data.learn=1/3",), ("data.learn=1/5",)),
    )
    assert [column.set for column in table.columns] == [
        (method, *share) for share in shares for method in methods
    ]
    assert [row.set for row in table.rows] == [(f"part={name.lower()}",) for name in TEMPLATES]


def test_the_columns_of_table_2_are_siléanes_parts_in_the_wider_bin():
    table = one("table2")
    assert [(column.name, *column.set) for column in table.columns] == [
        ("C.stick", "part=candlestick"),
        ("Gear", "part=gear"),
        ("T-Less20", "part=tless20"),
        ("T-Less29", "part=tless29"),
    ]
    assert all(column.generate == ("bin=box_400", "view=far", "camera.far=2") for column in table.columns)
    assert "synthetic" in table.note and "stand-ins" in table.note


def test_what_is_scored_is_what_the_paper_scores():
    scored = {table.number: (table.metric, table.split) for table in read_sweep("all")}
    assert scored == {
        "II": ("AP", "test_l"),
        "III": ("mAP", "test_l"),
        "IV": ("mAP", "test_g"),
        "V": ("mAP", "test_g"),
    }


def test_the_rows_that_are_trained_are_the_papers_and_the_two_rules():
    def trained(name):
        return {row.name: row.set for row in one(name).rows if row.origin != "published"}

    both = {"PPR-Net": ("method=pprnet",), "ParametricNet": ("method=parametricnet",)}
    assert trained("table2") == {**both, "PPR-Net with ICP": ("method=pprnet_icp",)}
    assert trained("table3") == both
    assert trained("table5") == {
        "ParametricNet (w/o GU)": ("method=parametricnet", "ablation=no_gu"),
        "ParametricNet (w/o RF)": ("method=parametricnet", "ablation=no_rf"),
        "ParametricNet (w/o M_V)": ("method=parametricnet", "ablation=no_mv"),
        "ParametricNet": ("method=parametricnet", "ablation=none"),
        "Keypoints nearest to the camera": ("method=parametricnet", "ablation=rule_camera"),
        "Keypoints nearest to the point": ("method=parametricnet", "ablation=rule_point"),
    }
    own = {row.name for table in read_sweep("all") for row in table.rows if row.origin == "ours"}
    assert own == {"Keypoints nearest to the camera", "Keypoints nearest to the point"}


def test_the_tables_of_the_surface_are_two_methods_with_and_without_it():
    tables = read_sweep("surface")
    assert [(table.number, table.metric, table.split) for table in tables] == [
        ("S1", "mAP", "test_l"),
        ("S2", "mAP", "test_g"),
    ]
    assert tables == [one("surface_l"), one("surface_g")] and not set(tables) & set(read_sweep("all"))
    for table in tables:
        assert [(row.name, row.set, row.origin, row.published) for row in table.rows] == [
            ("PPR-Net", ("method=pprnet", "refine=none"), "both", ()),
            ("PPR-Net fitted to the surface", ("method=pprnet", "refine=surface"), "ours", ()),
            ("ParametricNet", ("method=parametricnet", "refine=none"), "both", ()),
            ("ParametricNet fitted to the surface", ("method=parametricnet", "refine=surface"), "ours", ()),
        ]
    assert [len(list(table.cells())) for table in tables] == [4 * 4, 4 * 4]


def test_cells_are_those_that_are_trained_row_by_row():
    counts = {table.number: len(list(table.cells())) for table in read_sweep("all")}
    assert counts == {"II": 3 * 4, "III": 2 * 4, "IV": 4 * 6, "V": 6 * 4}
    cells = list(one("table4").cells())
    assert [(cell.row, cell.column) for cell in cells[:8]] == [*((0, j) for j in range(6)), (1, 0), (1, 1)]
    assert cells[3].overrides == ("method=parametricnet", "data.learn=1/3", "part=tn06")
    assert cells[3].name == "Table IV: TN06 / Learn 1/3, Ours"
    first = next(iter(one("table2").cells()))
    assert first.name == "Table II: PPR-Net / C.stick" and first.generate[0] == "bin=box_400"


# files of one's own


@pytest.fixture
def write(tmp_path):
    def go(content, name="mine.yaml"):
        path = tmp_path / name
        path.write_text(content if isinstance(content, str) else yaml.safe_dump(content), encoding="utf-8")
        return str(path)

    return go


def error(path):
    with pytest.raises(ValueError) as caught:
        read_sweep(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ") and "\n" not in text
    return text.removeprefix(f"{path}: ")


def test_a_file_of_ones_own_is_read_by_its_path(write):
    table = one(write(SMALL))
    assert table.number == "IX" and table.corner == "Object" and table.note is None
    assert table.rows[0].published == (0.5, None) and table.rows[0].origin == "both"
    assert [cell.overrides for cell in table.cells()] == [
        ("part=tn34", "method=parametricnet"),
        ("part=tn06", "method=parametricnet"),
    ]


def test_a_number_need_not_be_in_quotes(write):
    table = one(write({**SMALL, "number": 7}))
    assert table.number == "7" and next(iter(table.cells())).name == "Table 7: full / A"


def test_a_list_of_sweeps_may_name_files_of_ones_own(write):
    path = write({"tables": [write(SMALL), "table3"]}, "both.yaml")
    assert [table.number for table in read_sweep(path)] == ["IX", "III"]


def row(key, value):
    return {**SMALL, "rows": [{**SMALL["rows"][0], key: value}]}


def column(key, value):
    return {**SMALL, "columns": [{**SMALL["columns"][0], key: value}, SMALL["columns"][1]]}


BAD = {
    "an unknown key": ({**SMALL, "metrik": "AP"}, "metrik: unknown key, did you mean metric"),
    "an unknown key of a row": (row("sets", []), "rows[0].sets: unknown key, did you mean set?"),
    "an unknown key of a column": (column("grup", "G"), "columns[0].grup: unknown key"),
    "no rows": ({**SMALL, "rows": []}, "rows must be a list with at least one entry"),
    "no list of columns": ({**SMALL, "columns": 3}, "columns must be a list with at least one entry"),
    "a row that is no table": ({**SMALL, "rows": ["full"]}, "rows[0] must have a name"),
    "a row without a name": ({**SMALL, "rows": [{"set": []}]}, "rows[0] lacks name"),
    "too few figures": (row("published", [0.5]), "row full has 1 published figures for 2 columns"),
    "too many figures": (row("published", [0.5] * 3), "row full has 3 published figures for 2"),
    "a figure in words": (row("published", ["high", None]), "rows[0].published must hold numbers"),
    "one figure alone": (row("published", 0.5), "rows[0].published must hold numbers"),
    "a figure that is true": (row("published", [True, None]), "rows[0].published must hold"),
    "an unknown origin": (row("origin", "theirs"), "rows[0].origin is 'theirs', choose both"),
    "no list of overrides": (row("set", "part=tn34"), "rows[0].set must be a list of overrides"),
    "an override without value": (row("set", ["tn34"]), "rows[0].set must be a list of overrides"),
    "a bad generate": (column("generate", [3]), "columns[0].generate must be a list of overrides"),
    "an unknown split": ({**SMALL, "split": "test"}, "split is 'test', choose val, test_l, test_g"),
    "a list": ([SMALL], "expected a table: number, title"),
    "nothing": ("", "the table lacks number"),
    "no YAML": ("number: [1", "not readable"),
    "not even text": ("\x00", "not readable"),
    "tables that are no list": ({"tables": "table3"}, "tables must be a list of names of sweeps"),
    "tables that are none": ({"tables": None}, "tables must be a list of names of sweeps"),
    "tables that are no names": ({"tables": [SMALL]}, "tables must be a list of names of sweeps"),
    "tables beside a table": ({**SMALL, "tables": ["table3"]}, "tables stands alone"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_file_is_named_with_its_fault(write, case):
    content, message = BAD[case]
    assert error(write(content)).startswith(message)


@pytest.mark.parametrize("key", ["number", "title", "metric", "split", "columns", "rows"])
def test_a_missing_key_is_named(write, key):
    assert error(write({k: v for k, v in SMALL.items() if k != key})) == f"the table lacks {key}"


def test_a_list_of_sweeps_that_leads_to_itself_is_refused(write, tmp_path):
    path = write({"tables": ["table3", str(tmp_path / "mine.yaml")]})
    assert error(path) == "its tables lead back to itself"


def test_no_such_sweep_names_the_closest():
    with pytest.raises(ValueError, match="sweep=tabel5: no such sweep, did you mean table5"):
        read_sweep("tabel5")
    known = "there are all, surface, surface_g, surface_l, table2, table3, table4, table5, or give a path"
    with pytest.raises(ValueError, match=known):
        read_sweep("nothing_like_it")


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"mine\.yaml: no such sweep"):
        read_sweep(str(tmp_path / "mine.yaml"))
