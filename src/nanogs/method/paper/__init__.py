"""The published method (arXiv 2603.16103), whole: `published` calls its stages in turn."""
