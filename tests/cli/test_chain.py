"""Everything at once: one sweep trains Tables II to V, pnet-table prints them."""

import csv
from importlib.util import find_spec

import pytest

from pnet.cli.sweep_file import read_sweep

TINY = (
    "protocol=smoke",
    "trainer.steps=2",
    "trainer.validate_every=2",
    "trainer.checkpoint_every=2",
    "data.generate=['workers=0']",
    "protocol.drop_limit=2",
    "protocol.points=256",
)


@pytest.fixture
def refinement():
    """Skips what needs ICP."""
    if find_spec("small_gicp") is None:
        pytest.skip("needs the extra [icp]")


def written(folder, table, ending):
    """A table's file: the overrides of the sweep stand in its name."""
    paths = folder.glob(f"table_{table.number}_smoke_*.{ending}")
    (path,) = (path for path in paths if not path.stem.endswith(("_curves", "_errors")))
    return path


def cells_of(folder, table):
    with written(folder, table, "csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def assert_every_cell_was_measured(folder, table):
    cells = iter(cells_of(folder, table))
    for row in table.rows:
        for figure in row.published or (None,) * len(table.columns):
            cell = next(cells)
            assert cell["row"].startswith(row.name) and cell["protocol"].startswith("smoke ")
            assert cell["published"] == ("" if figure is None else str(figure))
            if row.origin == "published":
                assert cell["ours_mean"] == ""
            else:
                assert 0 <= float(cell["ours_mean"]) <= 1 and cell["seeds"] == "1", cell
    assert next(cells, None) is None


def assert_printed_beside_the_published_figures(folder, table):
    text = written(folder, table, "md").read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    for row in table.rows:
        line = next(line for line in lines if line.startswith((f"| {row.name} |", f"| {row.name} (ours")))
        figures = [figure for figure in row.published if figure is not None]
        assert line.count("[") == len(figures)
        assert all(f"[{figure:.2f}]" in line for figure in figures)
    assert "### Missing" not in text and "### What stands behind" in text


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_one_sweep_fills_every_table_of_the_paper(bullet, refinement, tmp_path, run_process, start):
    sweep = start(tmp_path, "train", "--multirun", "sweep=all", *TINY)
    out, err = sweep.communicate(timeout=500)
    assert sweep.returncode == 0 and "44 of 44 jobs done" in out, (out[-3000:], err[-3000:])
    runs = [path.parent for path in (tmp_path / "outputs" / "train").glob("*/metrics.json")]
    assert len(runs) == 44

    printed = run_process(tmp_path, "table", "table=all", *TINY)
    assert printed.code == 0, printed
    assert printed.out.count("; 0 cells are missing") == 4
    tables = tmp_path / "outputs" / "tables"
    for table in read_sweep("all"):
        assert_every_cell_was_measured(tables, table)
        assert_printed_beside_the_published_figures(tables, table)
        assert written(tables, table, "png").read_bytes().startswith(b"\x89PNG")
        assert len(list(tables.glob(f"table_{table.number}_smoke_*_curves.png"))) == 1

    again = run_process(tmp_path, "train", "--multirun", "sweep=all", *TINY)
    assert again.code == 0 and "44 jobs: 44 done, 0 missing; nothing to do" in again.out, again
