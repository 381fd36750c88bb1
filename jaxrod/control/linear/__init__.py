"""Linear models of a control period, in local coordinates of states."""
