"""Faults in a real fleet of network namespaces, and checks of the promises from outside."""
