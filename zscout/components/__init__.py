"""Components: programs that a node starts, watches, moves and ends. `component.py` tells how to write one."""
