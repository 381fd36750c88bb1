"""Learning algorithms, a module each, and modules of their common parts."""
