"""A running `nanogs studio`, and a client of it without a browser."""

import http.client
import json
import os
import queue
import socket
import subprocess
import sys
import threading
import time
from contextlib import closing, contextmanager, suppress
from secrets import token_hex
from urllib.parse import urlsplit


@contextmanager
def running(scene, *options, cwd, env=None):
    """Start the command in a process of its own, and yield it once it has printed its address."""
    words = ["studio", scene, "--no-open", "--json", *options]
    process = subprocess.Popen(
        [sys.executable, "-m", "nanogs", *map(str, words)], cwd=cwd, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=dict(os.environ) | (env or {}),
    )  # fmt: skip
    try:
        yield Started(process)
    finally:
        process.terminate()
        process.communicate(timeout=30)


class Started:
    """The process of the command: `output` is the JSON that it printed, `url` its address."""

    def __init__(self, process):
        self.process = process
        text = ""
        while not text.endswith("}\n"):
            line = process.stdout.readline()
            assert line, process.stderr.read()
            text += line
        self.output = json.loads(text)
        self.url = self.output["url"]

    def request(self, method, path="", body=None, headers=None, whole=False):
        """Send a request; return status, headers and bytes.

        With `whole`, `path` is the whole path; otherwise it is appended to that of the address.
        """
        parts = urlsplit(self.url)
        connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=60)
        default_headers = {"Host": parts.netloc}
        if method == "POST":
            default_headers |= {
                "Origin": f"http://{parts.netloc}",
                "Content-Type": "application/json",
            }
        all_headers = {
            k: v for k, v in (default_headers | (headers or {})).items() if v is not None
        }
        connection.putrequest(method, path if whole else parts.path + path, skip_host=True)
        data = json.dumps(body).encode() if isinstance(body, dict) else body or b""
        if method == "POST" and "Content-Length" not in all_headers:
            all_headers["Content-Length"] = str(len(data))
        for name, value in all_headers.items():
            connection.putheader(name, value)
        connection.endheaders(data)
        answer = connection.getresponse()
        with closing(connection):
            return answer.status, dict(answer.getheaders()), answer.read()

    def page(self):
        """Open a page that listens for events."""
        return Page(self)


class Page:
    """A page without a browser: it sends requests and receives events."""

    def __init__(self, studio, name=None):
        self.studio, self.name, self.number = studio, name or token_hex(8), 0
        self.events, self.seen = queue.Queue(), []
        parts = urlsplit(studio.url)
        self.connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=60)
        self.connection.request("GET", f"{parts.path}events?page={self.name}")
        self.socket = self.connection.sock
        self.answer = self.connection.getresponse()
        assert self.answer.status == 200, self.answer.read()
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()

    def _read(self):
        try:
            for line in self.answer:
                if line.startswith(b"data: "):
                    self.events.put(event := json.loads(line[6:]))
                    if event["type"] in ("draft", "made"):  # as if drawn at once
                        self.post("seen", model=event["model"]["id"])
        except (OSError, ValueError, AttributeError, http.client.HTTPException):
            pass
        self.events.put(None)

    def close(self):
        """Close the connection that events come from."""
        with suppress(OSError):
            self.socket.shutdown(socket.SHUT_RDWR)
        self.reader.join()
        self.answer.close()
        self.connection.close()
        self.socket.close()

    def wait(self, *kinds, number=None, seconds=60):
        """Wait for the next event of some kinds and, if given, a number; keep all in `seen`."""
        until = time.monotonic() + seconds
        while True:
            event = self.events.get(timeout=max(until - time.monotonic(), 0.01))
            assert event is not None, self.seen[-3:]
            self.seen.append(event)
            if event["type"] in kinds and number in (None, event.get("number")):
                return event
            assert event["type"] != "failed" or "failed" in kinds, event

    def post(self, where, /, **body):
        """Post a request; return the status and the answer."""
        status, _, data = self.studio.request("POST", where, {"page": self.name} | body)
        return status, json.loads(data) if data else None

    def ask(self, **choice):
        """Ask for a model; return the number of the request and the equivalent command."""
        self.number += 1
        status, answer = self.post("ask", number=self.number, choice=choice)
        assert status == 200, answer
        return self.number, answer["command"]

    def save(self, path, overwrite=False, **choice):
        """Save a model; return the number of the request and the equivalent command."""
        self.number += 1
        status, answer = self.post(
            "save", number=self.number, choice=choice, path=path, overwrite=overwrite
        )
        assert status == 200, answer
        return self.number, answer["command"]

    def model(self, name):
        """Fetch the bytes of a model."""
        status, _, data = self.studio.request("GET", f"models/{name}.spz")
        assert status == 200
        return data
