"""Linear models of a period, in local coordinates of states."""
