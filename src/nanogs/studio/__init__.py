"""`nanogs studio`: a web page on this machine in which the user chooses a smaller model.

The server (`server.py`) passes requests of pages to one worker process (`worker.py`), which holds
the model and calls the library; its answers come back as events.
"""
