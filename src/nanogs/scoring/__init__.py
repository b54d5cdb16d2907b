"""Comparing models: scores on views, and a page that shows them."""
