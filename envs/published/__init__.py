"""The published benchmark's arm, with the laws of the published simulator."""
