"""Places on members where couplings act, and the interface of a coupling."""
