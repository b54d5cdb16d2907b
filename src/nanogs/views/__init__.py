"""Automatic cameras for a model: around it, inside it, or roaming; and streamed rendering."""
