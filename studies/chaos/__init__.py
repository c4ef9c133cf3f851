"""Faults in a real fleet of network namespaces, and the promises as they are seen from outside."""
