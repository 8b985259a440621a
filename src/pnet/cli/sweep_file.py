"""The files in `sweeps/`: tables of trainings, each with its grid and the paper's figures."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from pnet.cli.app import closest
from pnet.cli.evaluate import SPLITS

ORIGINS = ("both", "published", "ours")


@dataclass(frozen=True)
class Heading:
    """A row or a column.

    Attributes:
        name: as the table prints it.
        set: overrides of pnet-train. generate: overrides of pnet-generate alone.
        group: of adjacent columns, a heading above them.
        published: of a row, the paper's figure for each column, None where it has none.
        origin: "both"; "published": never trained here; "ours": a row that the paper does not have.
    """

    name: str
    set: tuple[str, ...] = ()
    generate: tuple[str, ...] = ()
    group: str | None = None
    published: tuple[float | None, ...] = ()
    origin: str = "both"


@dataclass(frozen=True)
class CellPlan:
    """One cell: what is trained for it, and on what it is scored."""

    table: "TablePlan"
    row: int
    column: int

    @property
    def overrides(self) -> tuple[str, ...]:
        """Of pnet-train; the row's come last."""
        return (*self.table.columns[self.column].set, *self.table.rows[self.row].set)

    @property
    def generate(self) -> tuple[str, ...]:
        """Of pnet-generate alone."""
        return (*self.table.columns[self.column].generate, *self.table.rows[self.row].generate)

    @property
    def name(self) -> str:
        """Readable: table, row and column."""
        column = self.table.columns[self.column]
        group = f"{column.group}, " if column.group else ""
        return f"Table {self.table.number}: {self.table.rows[self.row].name} / {group}{column.name}"


@dataclass(frozen=True)
class TablePlan:
    """A table.

    Attributes:
        number, title: the paper's. metric: a key of an evaluation's metrics. split: what is scored.
        caption: what the figures are. corner: heading of the first column. note: what a reader must know.
    """

    number: str
    title: str
    metric: str
    split: str
    caption: str
    columns: tuple[Heading, ...]
    rows: tuple[Heading, ...]
    corner: str = "Object"
    note: str | None = None

    def cells(self) -> Iterator[CellPlan]:
        """Every cell that is trained here, row by row."""
        for i, row in enumerate(self.rows):
            if row.origin != "published":
                yield from (CellPlan(self, i, j) for j in range(len(self.columns)))


def sweeps_dir() -> Path:
    """The folder of sweeps: inside an installed package, or at the top of a checkout."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "sweeps", package.parents[1] / "sweeps"):
        if folder.is_dir():
            return folder
    raise FileNotFoundError(f"pnet's sweeps are missing beside {package}; install pnet again")


def read_sweep(name: str, within: tuple[Path, ...] = ()) -> list[TablePlan]:
    """The tables of a sweep.

    Args:
        name: of a file in `sweeps/` without its ending, several with commas, or the path of another file.
        within: the files that name it.
    Raises:
        FileNotFoundError, ValueError: names the file and the fault.
    """
    tables: list[TablePlan] = []
    for word in name.split(","):
        path = _path(word.strip())
        content = _read(path)
        if "tables" in content:
            for other in _others(path, content, within):
                tables += read_sweep(other, (*within, path))
        else:
            tables.append(_table(path, content))
    return list(dict.fromkeys(tables))


def _path(name: str) -> Path:
    path = Path(name)
    if path.suffix in (".yaml", ".yml"):
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such sweep")
        return path
    found = sweeps_dir() / f"{name}.yaml"
    if not found.is_file():
        known = sorted(path.stem for path in sweeps_dir().glob("*.yaml"))
        raise ValueError(
            f"sweep={name}: no such sweep{closest(name, known)}; there are {', '.join(known)}, "
            "or give a path that ends in .yaml"
        )
    return found


def _read(path: Path) -> dict[str, Any]:
    try:
        content = OmegaConf.to_container(OmegaConf.load(path))
    except Exception as fault:  # yaml raises classes of its own
        raise ValueError(f"{path}: not readable ({' '.join(str(fault).split())})") from fault
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected a table: number, title, metric, split, caption, columns, rows")
    return {str(key): value for key, value in content.items()}


def _others(path: Path, content: Mapping[str, Any], within: Sequence[Path]) -> list[str]:
    """The names in `tables`."""
    names = content["tables"]
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise ValueError(f"{path}: tables must be a list of names of sweeps")
    if len(content) > 1:
        raise ValueError(
            f"{path}: tables stands alone; {', '.join(set(content) - {'tables'})} cannot be there"
        )
    if path in within:
        raise ValueError(f"{path}: its tables lead back to itself")
    return names


def _table(path: Path, content: Mapping[str, Any]) -> TablePlan:
    _check_keys(
        path, "", content, TablePlan, required=("number", "title", "metric", "split", "columns", "rows")
    )
    lists = {}
    for key in ("columns", "rows"):
        given = content[key]
        if not isinstance(given, Sequence) or not given:
            raise ValueError(f"{path}: {key} must be a list with at least one entry")
        lists[key] = tuple(_heading(path, f"{key}[{i}]", entry) for i, entry in enumerate(given))
    for row in lists["rows"]:
        if row.published and len(row.published) != len(lists["columns"]):
            raise ValueError(
                f"{path}: row {row.name} has {len(row.published)} published figures for "
                f"{len(lists['columns'])} columns"
            )
    if content["split"] not in SPLITS:
        raise ValueError(f"{path}: split is {content['split']!r}, choose {', '.join(SPLITS)}")
    texts = {key: str(value) for key, value in content.items() if value is not None}
    return TablePlan(**{"caption": "", **texts, **lists})  # type: ignore[arg-type]


def _heading(path: Path, where: str, entry: Any) -> Heading:
    if not isinstance(entry, dict):
        raise ValueError(f"{path}: {where} must have a name")
    _check_keys(path, where, entry, Heading, required=("name",))
    for key in ("set", "generate"):
        words = entry.get(key, [])
        if not isinstance(words, list) or not all(isinstance(w, str) and "=" in w for w in words):
            raise ValueError(f"{path}: {where}.{key} must be a list of overrides such as part=tn34")
    published = entry.get("published") or ()
    if not isinstance(published, (list, tuple)) or not all(_is_figure(value) for value in published):
        raise ValueError(f"{path}: {where}.published must hold numbers, or null where the paper has none")
    if entry.get("origin", "both") not in ORIGINS:
        raise ValueError(f"{path}: {where}.origin is {entry['origin']!r}, choose {', '.join(ORIGINS)}")
    tuples = {key: tuple(entry[key]) for key in ("set", "generate") if key in entry}
    return Heading(**{**entry, **tuples, "published": tuple(published)})


def _is_figure(value: Any) -> bool:
    return value is None or (isinstance(value, (int, float)) and not isinstance(value, bool))


def _check_keys(
    path: Path, where: str, content: Mapping[str, Any], record: type, required: Sequence[str]
) -> None:
    known = [field.name for field in fields(record)]
    for key in content:
        if key not in known:
            raise ValueError(
                f"{path}: {where}.{key}: unknown key{closest(str(key), known)}".replace(": .", ": ")
            )
    for key in required:
        if key not in content:
            raise ValueError(f"{path}: {where or 'the table'} lacks {key}")
