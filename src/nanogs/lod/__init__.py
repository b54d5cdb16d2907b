"""Levels of detail."""
