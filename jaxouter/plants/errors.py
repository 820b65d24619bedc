"""Errors from a plant's own code, as one readable message: which plant, where in its episode, what was raised."""

from __future__ import annotations

LINES, LENGTH = 3, 600  # most lines and characters of its message

Raised = (Exception, SystemExit)
"""What a user's code may raise; excludes Ctrl-C."""


class PlantError(ValueError):
    """A plant's own code failed; its exception is the cause."""

    def __init__(self, plant: str, where: str, what: str) -> None:
        """Args: plant: its name; where: function, or control step and episode; what: text of the exception."""
        super().__init__(plant, where, what)  # all three, so that it can be pickled
        self.plant, self.where, self.what = plant, where, what

    def __str__(self) -> str:
        return f"plant {self.plant}, {self.where}: {self.what}"


def said(error: BaseException) -> str:
    """Type and text of an exception, in a few lines."""
    lines = [line.rstrip() for line in str(error).strip().splitlines() if line.strip()]
    text = "\n".join(lines[:LINES])[:LENGTH]
    more = " ..." if len(lines) > LINES or len("\n".join(lines)) > LENGTH else ""
    return f"{type(error).__name__}: {text}{more}" if text else type(error).__name__
