"""Where outer loops go: the controller, with NumPy alone; exports, the live loop, and adapters, with their extras."""

from jaxouter.deploy.controller import Controller

__all__ = ["Controller"]
