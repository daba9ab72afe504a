"""Faults on purpose: runs that are killed, damaged and given wrong inputs (``make faults``)."""
