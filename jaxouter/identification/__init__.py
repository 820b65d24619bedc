"""Identification: models of a plant from records of r~ and y, and how far they hold."""
