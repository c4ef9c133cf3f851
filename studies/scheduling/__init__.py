"""The empirical analysis that the paper asks for: strategies side by side on families of random workloads.

`families` makes workloads from seeds, `trial` runs one through the core, `measures` and `situations` say what
came of it, `summary` and `foretell` put many trials together. Nothing here reads a clock, a file or the
number of processors: the caller gives the clock and spreads the trials.
"""
