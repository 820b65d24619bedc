"""The controller in a real control loop (NumPy alone), learning live, and environments for Gymnasium."""

from jaxouter.runtime.controller import Controller

__all__ = ["Controller"]
