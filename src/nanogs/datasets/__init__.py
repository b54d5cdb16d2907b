"""Data sets with cameras and photographs, and scenes made up for demonstration."""
