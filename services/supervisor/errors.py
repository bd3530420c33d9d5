"""Errors of a fleet as a whole."""


class FleetError(Exception):
    """A fleet cannot go on; the text says which process and why."""


class ProcessRefused(FleetError):
    """A process said that going on is of no use.

    Attributes:
        name: The process.
    """

    def __init__(self, name: str, text: str) -> None:
        super().__init__(text)
        self.name = name
