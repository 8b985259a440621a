"""The operators' CUDA kernels, in Triton: compiled for the card at their first use and kept on disk.

Every kernel works on the part of its output that it alone writes, in a fixed order, so results are the same
in every run. Distances are rounded as in the references: products and sums are not fused.
"""
