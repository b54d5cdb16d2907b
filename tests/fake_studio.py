"""A fake server for the page of the studio, whose answers and events a test determines."""

import contextlib
import http.server
import json
import queue
import threading
import time
from importlib.resources import files
from urllib.parse import parse_qsl, urlsplit

import jinja2

import nanogs
from nanogs.view.pack import DISTANCE, in_page, pack
from nanogs.views.opening import opening_for

PACKAGE = files("nanogs")
TYPES = {"js": "text/javascript", "css": "text/css", "spz": "application/octet-stream"}
TIMEOUT = 10  # timeout, seconds
ENTRIES = [
    {"name": "old", "kind": "folder", "bytes": None},
    {"name": "scene-small.sog", "kind": "model", "bytes": 1234},
    {"name": "words.txt", "kind": "file", "bytes": 5},
]


LAYOUT = {"name": "3D Tiles", "suffix": "tileset.json", "example": "scene/tileset.json"}


class FakeStudio:
    """A server that records the requests of a page, and sends it events.

    Attributes:
        requests: Path and JSON of each request, in order.
        drawn_reports: The page's reports of what it has drawn, in order.
        left: JSON of the requests that pages sent when they were left, in order.
        fetched: Names of models, in the order in which they were fetched.
        refused: By path, the status and the sentence with which its next request is answered.
    """

    def __init__(self, models):
        """Pack the models, given by name; `original` is the scene."""
        original = models["original"]
        start = opening_for(original)
        self.models = {name: pack(model, start).data for name, model in models.items()}
        self.requests, self.refused, self.drawn_reports, self.fetched = [], {}, [], []
        self.left = []
        self._events = queue.Queue()
        [position] = in_page(start.position[None], start).tolist()
        low, high = original.means.min(axis=0).tolist(), original.means.max(axis=0).tolist()
        self.scene = {
            "type": "scene", "name": "scene.ply", "splats": len(original), "sh_degree": 2,
            "file_bytes": 68 * len(original), "render_mode": "default", "up": "-y",
            "formats": [".ply", ".sog"], "presets": ["fast", "default", "best"],
            "layouts": [LAYOUT],
            "camera": {
                "position": position, "target": [0, 0, 0], "up": start.up.tolist(),
                "lens": start.tangent, "near": start.near,
            },
            "background": "#000000", "bounds": {"low": low, "high": high}, "folder": "scenes",
            "page": {"scale": DISTANCE / start.distance, "centre": start.target.tolist()},
            "stem": "scene", "most_shown": 500_000, "notes": [], "model": self.model("original"),
        }  # fmt: skip

    def model(self, name, splats=1):
        """Return the description of a model in events."""
        return {"id": name, "splats": splats, "mip": False, "note": None}

    def send_event(self, **event):
        """Send an event to the page."""
        self._events.put(event)

    def send_result(self, kind, number, model, drawn=None, **more):
        """Send an event about a result, whose model may have fewer splats than the result has."""
        defaults = {"splats": 30, "bytes": 600, "psnr": 31.0, "ssim": 0.9, "seconds": 1, "stop": ""}
        event = defaults | more
        entry = self.model(model, event["splats"] if drawn is None else drawn)
        self.send_event(type=kind, number=number, model=entry, **event)

    def wait(self, path, count=1):
        """Wait for the request of a path whose number is `count`, from 1; return its JSON."""
        end = time.monotonic() + TIMEOUT
        while len(bodies := [body for each, body in self.requests if each == path]) < count:
            assert time.monotonic() < end, f"{path} was not asked {count} times: {self.requests}"
            time.sleep(0.01)
        return bodies[count - 1]

    def stream(self, file):
        """Write the scene and then each event to `file`, until `end` is called."""
        self._events = queue.Queue()
        self.send_event(**self.scene)
        with contextlib.suppress(OSError):
            while event := self._events.get():
                file.write(f"data: {json.dumps(event)}\n\n".encode())
                file.flush()

    def end(self):
        """End the stream of events."""
        self._events.put(None)


@contextlib.contextmanager
def running_fake(models):
    """Start a fake server; yield it, and the address of its page."""
    fake = FakeStudio(models)

    class Handler(http.server.BaseHTTPRequestHandler):
        def log_message(self, *_):
            pass

        def send(self, data, kind, status=200):
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

        def do_GET(self):
            address = urlsplit(self.path)
            folder, _, name = address.path.rpartition("/")
            if name == "":
                text = (PACKAGE / "studio/page.html.j2").read_text(encoding="utf-8")
                page = jinja2.Environment(autoescape=True).from_string(text)
                data = page.render(name="scene.ply", version=nanogs.__version__).encode()
                self.send(data, "text/html; charset=utf-8")
            elif name == "events":
                self.send_response(200)
                self.send_header("Content-Type", "text/event-stream")
                self.end_headers()
                fake.stream(self.wfile)
            elif name == "files":
                where = dict(parse_qsl(address.query)).get("folder", "")
                listed = {"folder": where, "parent": "" if where else None, "entries": ENTRIES}
                self.send(json.dumps(listed).encode(), "application/json")
            else:
                data = self.data_of(folder, name)
                self.send(data, TYPES[name.rpartition(".")[2]])

        def data_of(self, folder, name):
            if folder == "/models":
                fake.fetched.append(name.removesuffix(".spz"))
                return fake.models[name.removesuffix(".spz")]
            subfolder = "studio/static" if folder == "/static" else "view"
            return (PACKAGE / subfolder / name).read_bytes()

        def do_POST(self):
            body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            path = self.path.removeprefix("/")
            if path in ("seen", "leave"):
                {"seen": fake.drawn_reports, "leave": fake.left}[path].append(body)
                self.send(b"{}", "application/json")
                return
            fake.requests.append((path, body))
            status, message = fake.refused.pop(path, (200, ""))
            response = {"message": message, "command": f"nanogs simplify {body.get('path', '')}"}
            if path == "command":
                response["exists"] = body["path"] in {entry["name"] for entry in ENTRIES}
            self.send(json.dumps(response).encode(), "application/json", status)

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield fake, f"http://127.0.0.1:{server.server_port}/"
    finally:
        fake.end()
        server.shutdown()
        thread.join()
        server.server_close()
