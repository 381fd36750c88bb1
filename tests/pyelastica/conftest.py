"""Makes the fixture that records measured values known to the tests here."""

from physics.validation import record as record
