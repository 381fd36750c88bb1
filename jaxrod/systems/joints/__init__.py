"""Joints between members: ties, welds, springs, hinges, glue, attachments."""
