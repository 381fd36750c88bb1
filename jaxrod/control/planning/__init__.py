"""Planning while acting: plans, planning policies, model predictive control."""
