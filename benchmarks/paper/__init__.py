"""`jaxrod reproduce`: the published grid of cases, algorithms and seeds."""
