"""The operators' CPU kernels, compiled by numba at their first use and kept on disk.

Every kernel works on the part [start, stop) of its output that it alone writes, so results are the same for
any number of threads.
"""
