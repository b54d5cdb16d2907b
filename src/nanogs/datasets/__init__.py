"""Photographs with known cameras, as other tools write them."""
