"""Lanes: batches of rods on a CPU, with one rod in each lane of a vector register."""
