"""`jaxrod benchmark`: rod-steps per second, PyElastica beside it."""
