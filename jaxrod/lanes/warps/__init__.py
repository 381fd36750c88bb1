"""Kernels of warps: a batch on a GPU, with 32 threads (a warp) for each scene."""
