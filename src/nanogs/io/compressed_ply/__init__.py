"""PlayCanvas' `.compressed.ply`: splats packed in chunks."""
