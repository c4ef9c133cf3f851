"""The simulated network and virtual time, on which services run with faults."""
