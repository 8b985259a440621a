"""The steps' CUDA kernels, in Triton: compiled for the card at their first use and kept on disk.

Scenes lie beside each other, so a launch serves a batch. Every number has one owner and one order of
summation, in double precision, so results are the same in every run.
"""
