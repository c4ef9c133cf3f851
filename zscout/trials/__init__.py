"""Closed loops under virtual time: the building, the mind and what stands between them, without a mesh."""
