"""The empirical analysis that the paper asks for: strategies compared on families of random workloads.

`families` makes workloads from seeds, `trial` runs a workload through the core, `measures` and `situations` evaluate
the run, `summary` and `foretell` combine many trials. Nothing here reads a clock, a file or the number of processors:
the caller passes the clock and distributes the trials.
"""
