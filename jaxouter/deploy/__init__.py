"""Where outer loops go: the controller, with NumPy alone, and adapters to other tools, each with its extra."""

from jaxouter.deploy.controller import Controller

__all__ = ["Controller"]
