"""`nanogs studio`: a page of this machine's browser in which a smaller model is chosen.

The server (`server.py`) hands requests of pages to one process (`worker.py`), which holds the model
and calls the library; what it finds comes back as events.
"""
