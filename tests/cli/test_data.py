"""pnet-data: a summary, a check, repair and a page of a small real data set."""

import json
import shutil
from pathlib import Path

import pytest
from tests.cli.conftest import SMOKE

from pnet.scenes.record_file import SUFFIX

pytestmark = pytest.mark.usefixtures("bullet")

TRAIN = "train/clutter_0000_part_05"
VAL = "val/pile_0001_part_00"


@pytest.fixture(scope="module")
def made(tmp_path_factory, run_process) -> Path:
    """A folder with a data set in `data`: seven cycles of three scenes, and their piles."""
    folder = tmp_path_factory.mktemp("made")
    outcome = run_process(folder, "generate", *SMOKE, "workers=0", "data.root=data")
    assert outcome.code == 0, outcome
    return folder


@pytest.fixture
def job(made, tmp_path) -> Path:
    """A copy to spoil."""
    shutil.copytree(made / "data", tmp_path / "data")
    return tmp_path


def content(root: Path) -> dict[str, bytes]:
    """All files but locks."""
    files = (path for path in sorted(root.rglob("[!.]*")) if path.is_file())
    return {str(path.relative_to(root)): path.read_bytes() for path in files}


def spoil(path: Path) -> None:
    """Turn a bit near the end."""
    data = bytearray(path.read_bytes())
    data[-100] ^= 1
    path.write_bytes(data)


def test_a_summary_tells_what_is_there_and_writes_numbers(made, run_here, tmp_path):
    out = tmp_path / "numbers.json"
    outcome = run_here(made, "data", "root=data", f"output={out}")
    assert outcome.code == 0 and outcome.err == ""
    for text in ("Settings", "TN34", "Splits", "Instances by visibility", "Orientations", "Piles"):
        assert text in outcome.out
    assert "Counted from the bodies of 7 files: 21 scenes, 42 instances; points were not" in outcome.out
    numbers = json.loads(out.read_text())
    assert list(numbers["splits"]) == ["test_g", "test_l", "train", "val"]
    train = numbers["splits"]["train"]
    assert (train["planned"], train["whole"], train["scenes"], train["part_objects"]) == (4, 4, 12, 2)
    assert train["points"] == [512, 512] and train["instances"] == sum(train["visibility"]) == 24
    assert train["size"] == sum(p.stat().st_size for p in (made / "data" / "train").iterdir())
    assert numbers["piles"]["whole"] == 7 and set(numbers["coverage"]) == {"pile", "clutter"}
    assert numbers["settings"]["seed"] == 0


def test_a_set_in_the_making_has_a_summary(job, run_here):
    for path in (job / "data").rglob(f"*{SUFFIX}"):
        path.unlink()
    outcome = run_here(job, "data", "root=data")
    assert outcome.code == 0 and "Counted from the bodies of 0 files" in outcome.out


def test_a_whole_set_passes_the_check(made, run_here):
    outcome = run_here(made, "data", "root=data", "action=verify")
    assert outcome.code == 0 and outcome.err == ""
    last = outcome.out.strip().splitlines()[-1]
    assert last.startswith("14 files with 21 scenes and 21 piles checked in ") and last.endswith(": no fault")


def test_a_check_names_every_fault_and_how_to_mend_it(job, run_here):
    spoil(job / "data" / f"{TRAIN}{SUFFIX}")
    (job / "data" / f"{VAL}{SUFFIX}").unlink()
    outcome = run_here(job, "data", "root=data", "action=verify")
    lines = outcome.out.strip().splitlines()
    assert any(line.startswith(f"data/{TRAIN}{SUFFIX}: not a whole cycle file") for line in lines)
    assert f"data/{VAL}{SUFFIX}: missing" in lines
    assert outcome.error.startswith("data: 2 faults; 13 files with 15 scenes and 21 piles checked in ")
    assert outcome.error.endswith("to mend: pnet-data action=repair root='data'")


def test_repair_makes_again_what_is_damaged_or_missing(made, job, run_process):
    data = job / "data"
    spoil(data / f"{TRAIN}{SUFFIX}")
    (data / f"{VAL}{SUFFIX}").unlink()
    spoil(data / "piles" / f"{VAL}{SUFFIX}")
    outcome = run_process(job, "data", "root=data", "action=repair", "workers=0")
    assert outcome.code == 0, outcome
    for name in (TRAIN, f"piles/{VAL}"):
        assert f"deleted data/{name}{SUFFIX}" in outcome.out
    assert outcome.out.strip().splitlines()[-1] == "made: 2 files of scenes, 1 file of piles"
    assert content(data) == content(made / "data")


def test_repair_makes_piles_again_without_their_scenes(made, job, run_process):
    path = job / "data" / "piles" / f"{VAL}{SUFFIX}"
    spoil(path)
    outcome = run_process(job, "data", "root=data", "action=repair", "workers=0")
    assert outcome.code == 0, outcome
    assert outcome.out.strip().splitlines()[-1] == "made: 0 files of scenes, 1 file of piles"
    assert content(job / "data") == content(made / "data")


def test_repair_does_not_make_all_piles_where_they_are_not_kept(made, job, run_process):
    data = job / "data"
    kept = data / "piles" / f"{TRAIN}{SUFFIX}"
    for path in (data / "piles").rglob(f"*{SUFFIX}"):
        if path not in (kept, data / "piles" / f"{VAL}{SUFFIX}"):
            path.unlink()
    spoil(kept)
    outcome = run_process(job, "data", "root=data", "action=repair", "workers=0")
    assert outcome.code == 0, outcome
    assert "made: 0 files of scenes, 0 files of piles\nother piles are not kept either" in outcome.out
    assert [p.stem for p in (data / "piles").rglob(f"*{SUFFIX}")] == [VAL.split("/")[1]]


def test_repair_leaves_what_it_cannot_mend(job, run_here):
    extra = job / "data" / "train" / f"pile_0009_part_00{SUFFIX}"
    shutil.copy(job / "data" / f"{VAL}{SUFFIX}", extra)
    before = content(job / "data")
    outcome = run_here(job, "data", "root=data", "action=repair")
    assert outcome.error == "data: 3 faults cannot be mended by making files again; see the lines above"
    assert f"data/train/{extra.name}: not of this data set's plan; move it away" in outcome.out
    assert "made: 0 files of scenes, 0 files of piles" in outcome.out
    assert content(job / "data") == before
    outcome = run_here(job, "data", "root=data", "action=verify")
    assert outcome.error.endswith("; 3 cannot be mended by making files again")


def test_a_page_shows_samples(made, run_here, tmp_path):
    page = tmp_path / "new" / "page.html"
    outcome = run_here(made, "data", "root=data", "action=page", "scenes=3", "split=train", f"output={page}")
    assert outcome.code == 0 and f"page of 3 scenes: {page}" in outcome.out
    text = page.read_text()
    assert text.count('class="plot"') == 3 and "train/pile_0000_part_00/003: " in text
    assert "<title>pnet: data set data</title>" in text


def test_a_page_lies_beside_the_data(job, run_here):
    outcome = run_here(job, "data", "root=data", "action=page", "scenes=1")
    assert outcome.code == 0 and (job / "data" / "page.html").is_file()


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        ([], "root is missing: give root=…; --help says what it is"),
        (["root=gone"], "gone: no such folder; root= takes the folder of a data set that pnet-generate made"),
        (["root=."], "dataset.json: no data set there; root= takes the folder of a data set that"),
        (["root=data", "action=verfy"], "action=verfy: no such action, did you mean verify"),
        (["root=data", "action=page", "scenes=0"], "scenes=0: expected 1 to 12"),
        (["root=data", "action=page", "scenes=13"], "scenes=13: expected 1 to 12"),
        (["root=data", "action=page", "split=dev"], "split=dev: data has train, val, test_l, test_g, or all"),
        (["root=data", "colour=red"], "colour: unknown key"),
    ],
)
def test_mistakes_are_told_in_one_line(made, run_here, arguments, error):
    assert run_here(made, "data", *arguments).error.startswith(error)


@pytest.mark.parametrize(
    ("change", "error"),
    [
        (lambda text: b"\x93\xff", "dataset.json: not readable ("),
        (lambda text: b"{", "dataset.json: not readable ("),
        (lambda text: b"[]", "dataset.json: not a data set's manifest"),
        (
            lambda text: b'{"a": 1}',
            "dataset.json: made by an older pnet, it lacks part",
        ),
        (
            lambda text: text.replace(b"tn34.TN34", b"tn34.TN99"),
            "dataset.json: part._target_: pnet.par",
        ),
        (
            lambda text: text.replace(b"pnet.parts.tn34.TN34", b"os.system"),
            "dataset.json: part._target_: os",
        ),
        (
            lambda text: json.dumps({**json.loads(text), "part": 3}).encode(),
            "dataset.json: part describes no ParametricPart; root= takes",
        ),
    ],
)
def test_what_is_no_manifest_is_told(job, run_here, change, error):
    manifest = job / "data" / "dataset.json"
    manifest.write_bytes(change(manifest.read_bytes()))
    assert run_here(job, "data", "root=data").error.startswith(f"data/{error}")


def test_a_page_of_nothing_is_refused(job, run_here):
    shutil.rmtree(job / "data" / "val")
    outcome = run_here(job, "data", "root=data", "action=page", "split=val")
    assert outcome.error.startswith("data: no scenes of val there yet; pnet-data action=repair makes them")
