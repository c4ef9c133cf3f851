"""Closed loops under virtual time: the building, the controller and what stands between them, without a mesh."""
