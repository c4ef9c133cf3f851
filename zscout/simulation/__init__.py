"""What runs without devices: the simulated building, demos, workloads and their replay."""


class DemoFailed(RuntimeError):
    """A demo could not be carried out: one line, with the remedy."""
