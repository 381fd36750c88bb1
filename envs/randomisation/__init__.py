"""Randomised environments: options as plain values, and the wrapper."""
