"""Freed memory stays with the process: no page faults for the second tensor of a size."""

import subprocess
import sys

import pytest

COUNT = """
import resource, torch
from pnet.engine.allocator import keep_freed_memory

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(5):
        torch.empty(5_000_000).fill_(1.0)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

torch.set_num_threads(1)
first = faults()
done = keep_freed_memory()
for _ in range(4):  # until the heap has grown to what is asked for
    faults()
print(done, first, faults())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc's malloc")
def test_a_tensor_of_the_same_size_causes_no_page_faults():
    out = subprocess.run([sys.executable, "-c", COUNT], capture_output=True, text=True, check=True).stdout
    done, before, after = out.split()
    if done == "False":
        pytest.skip("the C library is not glibc")
    assert int(after) < int(before) / 20
