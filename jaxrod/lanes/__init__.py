"""Lanes: many rods at once, one in each lane of the processor's vector registers."""
