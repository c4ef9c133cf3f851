"""What a laboratory needs beside its devices: the simulated building, trials, studies, plots and demos."""


class LabError(RuntimeError):
    """A demo or a study could not be carried out; one line, with the remedy."""
