"""Identification of parameters from measured motions and shapes."""
