"""Perception: pictures in, findings out. Pure."""
