"""Time stepping of a system: its assembly, stepper, neighbour lists and runs."""
