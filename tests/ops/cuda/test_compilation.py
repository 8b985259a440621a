"""Every kernel compiles for cards of two generations, without a card: the interpreter allows more.

Also what a profile would ask first: do registers spill, are distances rounded like the references'?
"""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
SCRIPT = Path(__file__).parent / "compile_only.py"
MAY_FUSE = {"_gather_sum", "_scatter_sum"}  # sums of products; nothing is compared there


def launched() -> set[str]:
    """The kernels that pnet launches: name[grid](...)."""
    folders = ("src/pnet/ops/cuda", "src/pnet/postprocess/cuda")
    files = [path for folder in folders for path in (ROOT / folder).glob("*.py")]
    text = "".join(path.read_text() for path in files)
    kernels = set(re.findall(r"@triton\.jit[^\n]*\ndef (\w+)", text))
    passed_on = {"_scatter_sum", "_scatter_max"}  # launched by the name of a parameter
    return {name for name in re.findall(r"\b(_\w+)\[", text) if name in kernels} | passed_on


@pytest.fixture(scope="module", params=[80, 90], ids=["A100", "H100"])
def compiled(request, tmp_path_factory) -> list[dict]:
    """What `compile_only.py` says of each kernel."""
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    environment |= {
        "TRITON_CACHE_DIR": str(tmp_path_factory.mktemp("cache")),
        "PYTHONPATH": str(ROOT / "src"),
    }
    done = subprocess.run(
        [sys.executable, str(SCRIPT), str(request.param)], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


def test_every_kernel_compiles(compiled):
    assert {one["kernel"] for one in compiled} == launched()
    assert len(launched()) > 15


def test_no_register_spills(compiled):
    assert [one for one in compiled if one["stack"]] == []


def test_distances_are_rounded_as_in_the_references(compiled):
    assert {one["kernel"] for one in compiled if one["fused"]} <= MAY_FUSE
    assert any(one["fused"] for one in compiled)  # else nothing was looked at
