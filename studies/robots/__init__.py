"""Closed loops under virtual time, without a mesh: the building, the controller and the link between them."""
