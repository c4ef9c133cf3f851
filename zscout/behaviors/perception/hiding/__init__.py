"""Hiding of a Scout: pictures in, wheel commands out. Pure: no clock, no thread, no I/O."""
