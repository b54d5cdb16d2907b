"""Interactive pages: models in a browser, in one file, without a network."""
