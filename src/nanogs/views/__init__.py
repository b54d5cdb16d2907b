"""Cameras that are found from a model: around it, inside it, roaming; and its first view."""
