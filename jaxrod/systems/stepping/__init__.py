"""Steps of a system: its assembly, stepper, lists and runs."""
