"""Data sets with cameras and photographs, and scenes for demonstration."""
