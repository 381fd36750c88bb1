"""Makes the fixture `record` known."""

from physics.validation import record as record
