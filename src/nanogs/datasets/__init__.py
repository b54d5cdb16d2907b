"""Data sets: a generated demo scene, and readers for photographs with their cameras."""
