"""Levels of detail: the sinks that write them, and their layouts in files and folders."""
