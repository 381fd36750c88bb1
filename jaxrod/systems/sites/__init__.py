"""Sites of couplings on members, and the interface of a coupling."""
