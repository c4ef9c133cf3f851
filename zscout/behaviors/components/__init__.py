"""Components: programs that a node starts, watches, moves and ends; `component.py` has their base class."""
