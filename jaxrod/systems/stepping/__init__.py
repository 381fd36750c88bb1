"""Time stepping of a system: its assembly, its steppers, preparation of a run."""
