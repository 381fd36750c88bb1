"""Warps: a batch on a GPU, with 32 threads for each scene."""
