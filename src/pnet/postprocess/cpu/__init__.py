"""The steps' CPU kernels, compiled by numba at their first use; scene by scene, as trees are of one cloud.

Every kernel divides its output among threads, so results do not depend on how many there are.
"""
