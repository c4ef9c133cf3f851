"""Components: programs that a node starts, watches, moves and ends. How to write one: `component.py`."""
