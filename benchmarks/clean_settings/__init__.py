"""Accuracy of the settings of the `clean` tasks."""
