"""The stages of the published method (arXiv 2603.16103), which `published` calls in turn."""
