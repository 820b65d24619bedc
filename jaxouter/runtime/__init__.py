"""The controller in a real control loop (NumPy only), live learning, and environments for Gymnasium."""

from jaxouter.runtime.controller import Controller

__all__ = ["Controller"]
