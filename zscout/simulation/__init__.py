"""Runs without devices: the simulated building, demos, workloads and their replay."""


class DemoFailed(RuntimeError):
    """A demo failed: one line, with the remedy."""
