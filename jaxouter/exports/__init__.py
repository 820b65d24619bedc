"""The learned controller as a file for other tools."""
