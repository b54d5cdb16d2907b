"""Interactive pages: self-contained HTML files that show models in a browser, without network."""
