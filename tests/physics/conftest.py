"""Compiles as jaxrod does for its users, and makes the fixture `record` known."""

import os

from jaxrod.backend import with_backend_options
from physics.validation import record as record

# In force unless something was computed before these tests were collected.
os.environ["XLA_FLAGS"] = with_backend_options(os.environ.get("XLA_FLAGS", ""))
