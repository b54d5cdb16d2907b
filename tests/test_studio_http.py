"""HTTP security of the studio: it answers only its own page, and shows only its own folder."""

import asyncio
import contextlib
import json
import os
import re
import socket
import sys
from functools import partial
from urllib.parse import urlsplit

import pytest
from starlette.responses import PlainTextResponse

import nanogs
from builders import random_splats
from nanogs.errors import OptionError
from nanogs.studio import server
from nanogs.studio.listing import Folder
from nanogs.studio.pages import KEPT, MOST, Pages
from nanogs.studio.safety import Guard
from nanogs.studio.streaming import EventStream
from studio import running


@pytest.fixture(scope="module")
def studio(tmp_path_factory):
    top = tmp_path_factory.mktemp("studio")
    folder = top / "work"
    (folder / "sub" / "deep").mkdir(parents=True)
    (top / "secret.ply").write_bytes(b"secret")
    (folder / "note.txt").write_text("hello")
    (folder / ".hidden").write_text("hello")
    if os.name != "nt":
        (folder / "leak.ply").symlink_to(top / "secret.ply")
        (folder / "out").symlink_to(top)
        (folder / "near").symlink_to(folder / "sub")
    nanogs.save(random_splats(200, degree=1), folder / "scene.ply")
    with running("scene.ply", cwd=folder) as started:
        started.folder = folder
        yield started


ASK = {"page": "p", "number": 1, "choice": {"wish": {"splats": 50}}}


def test_the_page_has_strict_security_headers(studio):
    status, headers, body = studio.request("GET")
    assert status == 200
    assert b"scene.ply" in body
    policy = headers["content-security-policy"]
    for kind in ("default-src", "base-uri", "form-action", "frame-ancestors"):
        assert f"{kind} 'none'" in policy.split("; ")
    assert not re.search(r"https?:|\*|unsafe-eval'(?<!wasm-unsafe-eval')", policy)
    assert headers["referrer-policy"] == "no-referrer"
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["cache-control"] == "no-store"
    assert headers["x-frame-options"] == "DENY"
    assert headers["cross-origin-resource-policy"] == "same-origin"
    assert "server" not in headers


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are UTF-8 elsewhere")
def test_a_scene_whose_name_is_not_utf8_has_a_page_and_a_command(tmp_path):
    scene = os.fsdecode(b"\xff.ply")
    nanogs.save(random_splats(100), tmp_path / scene)
    with running(scene, cwd=tmp_path) as studio:
        status, _, body = studio.request("GET")
        assert (status, b"\\udcff.ply" in body) == (200, True)
        status, headers, body = studio.request("POST", "command", ASK | {"path": "out.ply"})
    assert (status, headers["content-type"]) == (200, "application/json")
    assert json.loads(body)["command"].startswith(f"nanogs simplify '{scene}' out.ply")


def test_the_studio_listens_only_on_this_machine(studio):
    assert urlsplit(studio.url).hostname == "127.0.0.1"
    assert len(urlsplit(studio.url).path) > 30
    with server._listening(0) as listening:
        assert listening.getsockname()[0] == "127.0.0.1"


@pytest.mark.parametrize(
    "path",
    ["/", "/x/", "/favicon.ico", "//", "/{token}", "/{token}x/", "/{token}/nothing",
     "/{token}/static/../server.py", "/{token}/static/%2e%2e/server.py", "/{token}/static/..",
     "/{token}/static/%2e%2e%2fserver.py", "/{token}/static/", "/{token}/server.py",
     "/{token}/models/..%2f..%2fscene.spz", "/x/../{token}/",
     f"/{{token}}/static/{'x' * 300}.js"],
)  # fmt: skip
def test_other_paths_are_not_found(studio, path):
    token = urlsplit(studio.url).path.strip("/")
    status, headers, _ = studio.request("GET", path.format(token=token), whole=True)
    assert status == 404
    assert headers["x-frame-options"] == "DENY"


@pytest.mark.parametrize(
    ("name", "status"),
    [("a.js", 200), ("a.woff2", 200), ("a.py", 404), ("a", 404), (".a.js", 404), ("../a.json", 404),
     ("a/b.js", 404), ("..\\a.json", 404), ("a\\..\\..\\b.png", 404)],
)  # fmt: skip
def test_only_files_of_one_folder_with_known_suffixes_are_given(monkeypatch, name, status):
    monkeypatch.setattr(server, "_package", lambda _package, _path: b"bytes")
    assert server._file("nanogs.studio", f"static/{name}", name).status_code == status


def test_what_is_no_request_is_refused_and_not_reported(tmp_path):
    """Any program of this machine may knock on the port; the terminal is the user's."""
    nanogs.save(random_splats(100), tmp_path / "scene.ply")
    with running("scene.ply", cwd=tmp_path) as studio:
        parts = urlsplit(studio.url)
        with socket.create_connection((parts.hostname, parts.port), 30) as knocking:
            knocking.sendall(b"\x16\x03\x01 hello\r\n\r\n")
            assert knocking.recv(100).startswith(b"HTTP/1.1 400")
        studio.process.terminate()
        _, reported = studio.process.communicate(timeout=30)
    assert "Invalid" not in reported


def test_a_discarded_model_gives_an_empty_answer(studio):
    token = urlsplit(studio.url).path.strip("/")
    status, _, body = studio.request("GET", f"/{token}/models/x.spz", whole=True)
    assert (status, body) == (204, b"")


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1", "127.0.0.1:1", "localhost", "", "[::1]:{port}", None]
)
def test_requests_to_another_host_name_are_refused(studio, host):
    port = urlsplit(studio.url).port
    status, _, body = studio.request("GET", headers={"Host": host and host.format(port=port)})
    assert status in (400, 421)
    assert b"scene" not in body


def test_localhost_is_accepted_as_host_name(studio):
    port = urlsplit(studio.url).port
    names = {"Host": f"localhost:{port}", "Origin": f"http://localhost:{port}"}
    assert studio.request("GET", headers=names)[0] == 200
    assert studio.request("POST", "ask", ASK, headers=names)[0] == 200


def guarded(path="/token/", method="GET", *, headers=(), port=8080, kind="http"):
    """Send a request to a guard of an application that answers everything; return the status."""
    sent = []

    async def send(message):
        sent.append(message)

    given = [(name.encode(), value.encode()) for name, value in headers]
    scope = {"type": kind, "method": method, "path": path, "headers": given}
    asyncio.run(Guard(PlainTextResponse("here"), "token", port)(scope, None, send))
    return sent[0]["status"] if sent else None


HOST = ("host", "localhost:8080")
POSTED = {"origin": "http://localhost:8080", "content-type": "application/json"}


@pytest.mark.parametrize(("times", "status"), [(1, 200), (2, 421)])
def test_a_second_host_name_is_refused(times, status):
    assert guarded(headers=[HOST] * times) == status


@pytest.mark.parametrize(
    ("path", "status"),
    [("/token/", 200), ("/token/x/y", 200), ("/token", 404), ("/tok/", 404), ("/tokens/", 404),
     ("/x/token/", 404), ("//token/", 404), ("//", 404), ("/", 404), ("", 404),
     ("/t\xf6ken/", 404)],
)  # fmt: skip
def test_the_token_must_be_the_first_segment_of_a_path(path, status):
    assert guarded(path, headers=[HOST]) == status


@pytest.mark.parametrize("method", ["PUT", "DELETE", "OPTIONS", "PATCH", "TRACE", "get"])
def test_the_application_gets_no_other_methods(method):
    assert guarded(method=method, headers=[HOST]) == 405
    assert guarded(method="HEAD", headers=[HOST]) == 200


@pytest.mark.parametrize("port", [8080, 80])
def test_the_application_gets_no_other_connections(port):
    headers = [("host", "localhost")] if port == 80 else [HOST]
    assert guarded(kind="websocket", headers=headers, port=port) is None


@pytest.mark.parametrize("origin", [
    "http://evil.localhost:8080", "http://localhost:8080.evil.example", "http://127.0.0.1:8080",
    "https://localhost:8080", "http://LOCALHOST:8080", "localhost:8080", "http://localhost", "",
])  # fmt: skip
def test_origins_that_resemble_the_page_are_foreign(origin):
    headers = [HOST, *(POSTED | {"origin": origin, "content-length": "2"}).items()]
    assert guarded(method="POST", headers=headers) == 403


@pytest.mark.parametrize(
    ("length", "status"),
    [("65536", 200), ("65537", 413), ("0", 200), (None, 411), ("-1", 411), ("1e3", 411)],
)
def test_the_length_of_a_request_is_known_and_limited(length, status):
    given = POSTED if length is None else POSTED | {"content-length": length}
    assert guarded(method="POST", headers=[HOST, *given.items()]) == status


@pytest.mark.parametrize(("port", "status"), [(80, 200), (8080, 421)])
@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
@pytest.mark.parametrize("method", ["GET", "POST"])
def test_only_port_80_may_be_left_out_of_the_host_name(port, status, host, method):
    headers = POSTED | {"host": host, "origin": f"http://{host}", "content-length": "0"}
    assert guarded(method=method, headers=headers.items(), port=port) == status


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Origin": None}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "http://localhost:1"}, 403),
        ({"Origin": "https://127.0.0.1"}, 403),
        ({"Content-Type": None}, 415),
        ({"Content-Type": "text/plain"}, 415),
        ({"Content-Type": "application/x-www-form-urlencoded"}, 415),
        ({"Content-Type": "text/plain; application/json"}, 415),
        ({"Content-Type": "application/json; charset=utf-8"}, 200),
        ({"Content-Type": "Application/JSON ; charset=utf-8"}, 200),
    ],
)
def test_only_the_page_itself_may_send_requests(studio, headers, status):
    for path, body in (("ask", ASK), ("cancel", {"page": "p"}), ("leave", {"page": "p"})):
        found = studio.request("POST", path, body, headers=headers)[0]
        assert found == (204 if status == 200 and path != "ask" else status)


@pytest.mark.parametrize("method", ["PUT", "DELETE", "OPTIONS", "PATCH", "TRACE"])
def test_other_methods_are_refused(studio, method):
    assert studio.request(method, "ask")[0] == 405


def test_requests_cannot_be_sent_by_get(studio):
    assert studio.request("GET", "ask")[0] == 405
    assert studio.request("GET", "save")[0] == 405


@pytest.mark.parametrize(
    "body",
    [b"", b"[]", b"{", b"null", b'{"page": "p"}', b"[" * 60_000, b'{"page": "../x", "choice": {}}',
     json.dumps(ASK | {"number": "1"}).encode(), json.dumps(ASK | {"number": True}).encode(),
     json.dumps(ASK | {"path": "x"}).encode(),
     b'{"page": "p", "choice": {"wish": {"splats": NaN}}}'],
)  # fmt: skip
def test_malformed_requests_are_refused_with_a_message(studio, body):
    status, _, answer = studio.request("POST", "ask", body)
    assert status == 422
    assert json.loads(answer)["message"].endswith(".")


@pytest.mark.parametrize("pace", [None, 1e-6, 1])
def test_a_page_may_report_its_drawing_speed(studio, pace):
    body = {"page": "p", "model": "m", "pace": pace}
    assert studio.request("POST", "seen", body)[0] == 204


@pytest.mark.parametrize("pace", [0, -1, "1", True, float("nan"), float("inf"), []])
def test_invalid_drawing_speeds_are_refused(studio, pace):
    status, _, answer = studio.request("POST", "seen", {"page": "p", "model": "m", "pace": pace})
    assert status == 422
    assert "seconds" in json.loads(answer)["message"]


@pytest.mark.parametrize("model", [None, 1, ["m"]])
def test_reports_of_drawn_models_need_a_name(studio, model):
    status, _, answer = studio.request("POST", "seen", {"page": "p", "model": model})
    assert status == 422
    assert "name" in json.loads(answer)["message"]


def test_too_long_requests_are_refused(studio):
    assert studio.request("POST", "ask", b" " * 70_000)[0] == 413
    assert studio.request("POST", "ask", b"", headers={"Content-Length": "x"})[0] in (400, 411)


def listed(studio, folder):
    status, _, body = studio.request("GET", f"files?folder={folder}")
    return status, json.loads(body)


def test_the_dialogue_lists_the_folder_and_its_subfolders(studio):
    status, found = listed(studio, "")
    assert status == 200
    assert (found["folder"], found["parent"]) == ("", None)
    names = {entry["name"]: entry["kind"] for entry in found["entries"]}
    assert names["sub"] == "folder"
    assert names["scene.ply"] == "model"
    assert names["note.txt"] == "file"
    assert ".hidden" not in names
    assert not {"leak.ply", "out"} & names.keys()
    status, below = listed(studio, "sub/deep")
    assert (below["folder"], below["parent"], below["entries"]) == ("sub/deep", "sub", [])


OUTSIDE = ["..", "sub/../..", "/", "/etc", "sub/../../work", "..%2f", "%00", "..\\", "C:%5C"]
if os.name != "nt":
    OUTSIDE += ["out", "out/", "near/../../secret.ply"]


@pytest.mark.parametrize("folder", OUTSIDE)
def test_no_folder_outside_is_listed(studio, folder):
    status, found = listed(studio, folder)
    assert status == 422
    assert "secret" not in json.dumps(found).replace("near/../../secret.ply", "")


SAVES = ["../x.ply", "/tmp/x.ply", "sub/../../x.ply", "", ".", None, 3, "a\0.ply", "..\\x.ply"]
if os.name != "nt":
    SAVES += ["out/x.ply", "leak.ply"]


@pytest.mark.parametrize("path", SAVES)
def test_nothing_is_saved_outside_the_folder(studio, path):
    body = ASK | {"path": path, "overwrite": True}
    status, _, answer = studio.request("POST", "save", body)
    assert status == 422
    assert json.loads(answer)["message"].endswith(".")


def test_saving_over_the_scene_or_to_invalid_paths_is_refused(studio):
    for path, overwrite, message in (
        ("scene.ply", True, "scene that is open"),
        ("sub/../scene.ply", True, "out of the folder"),
        ("note.txt", True, "is not the name of a .ply"),
        ("nowhere/x.ply", False, "does not exist"),
        ("", False, "Name a file to save to"),
        ("x.ply", "yes", "overwrite is true or false"),
    ):
        body = ASK | {"path": path, "overwrite": overwrite}
        status, _, answer = studio.request("POST", "save", body)
        assert status == 422, path
        assert message in json.loads(answer)["message"]


def test_the_command_of_a_save_is_available_before_saving(studio):
    def command_answer(path, **choice):
        body = {"page": "p", "choice": ASK["choice"] | choice, "path": path}
        status, _, answer = studio.request("POST", "command", body)
        assert status == 200
        return json.loads(answer)

    assert command_answer("sub/a b.ply") == {
        "command": "nanogs simplify scene.ply 'sub/a b.ply' --count 50", "message": None,
        "exists": False,
    }  # fmt: skip
    (studio.folder / "there.ply").write_bytes(b"something")
    assert command_answer("there.ply")["exists"]
    assert command_answer("there.ply")["command"].endswith("there.ply --count 50")
    assert (
        "nanogs lod"
        in command_answer("x/tileset.json", format="tileset.json", levels="1,0.5")["command"]
    )
    shown = command_answer(None, preset="fast")["command"]
    assert shown == "nanogs simplify scene.ply out.ply --count 50 --preset fast"
    for path in (*filter(None, SAVES), "x.sog", "scene.ply", ""):
        found = command_answer(path)
        assert found["command"] is None
        assert found["message"].endswith(".")


def test_paths_inside_the_folder_are_resolved(tmp_path):
    folder = Folder(tmp_path.resolve())
    assert folder.inside("") == tmp_path.resolve()
    assert folder.inside("a/b.ply") == tmp_path.resolve() / "a" / "b.ply"
    with pytest.raises(OptionError, match="No such file"):
        folder.listed("nowhere")
    for wrong in ("a\0.ply", "\ud800.ply", "sub\\a.ply", 3):
        for call in (folder.inside, folder.listed):
            with pytest.raises(OptionError, match="named by a path relative to the folder"):
                call(wrong)


@pytest.fixture
def beside(tmp_path):
    """A folder, and beside it one whose name begins with the name of the folder."""
    for name in ("work", "workshop"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "b.ply").write_bytes(b"a model")
    return Folder((tmp_path / "work").resolve())


@pytest.mark.skipif(os.name == "nt", reason="links and pipes of POSIX")
def test_a_folder_is_listed_in_order_and_without_what_cannot_be_opened(beside):
    root = beside.root
    for name in ("z", "Y"):
        (root / name).mkdir()
    (root / "A.txt").write_bytes(b"abc")
    (root / "C.html").write_bytes(b"")
    for link, target in (
        ("link.ply", "b.ply"), ("nothing", "missing"), ("loop", "loop"), ("out", "../workshop"),
        ("out.ply", "../workshop/b.ply"),
    ):  # fmt: skip
        (root / link).symlink_to(target)
    os.mkfifo(root / "pipe")
    assert [tuple(entry.values()) for entry in beside.listed("")["entries"]] == [
        ("Y", "folder", None), ("z", "folder", None), ("A.txt", "file", 3), ("b.ply", "model", 7),
        ("C.html", "file", 0), ("link.ply", "model", 7),
    ]  # fmt: skip
    for outside in ("out", "out/b.ply", "out.ply", str(root / "b.ply"), "C:b.ply"):
        with pytest.raises(OptionError, match="leads out of the folder of the studio"):
            beside.inside(outside)
    with pytest.raises(OptionError, match=r"^b\.ply: Not a directory; choose another folder\.$"):
        beside.listed("b.ply")


def test_an_entry_that_cannot_be_looked_at_is_not_listed(beside, monkeypatch):
    usual = type(beside.root).stat

    def stat(path, **options):
        if path.name == "b.ply":  # as in a folder that may be read and not searched
            raise PermissionError(13, "Permission denied")
        return usual(path, **options)

    monkeypatch.setattr(type(beside.root), "stat", stat)
    assert beside.listed("")["entries"] == []


def test_page_names_are_checked_and_many_pages_are_accepted_one_after_another(studio):
    for name in ("", "a b", "x" * 65, "../x", "x%0A"):
        assert studio.request("GET", f"events?page={name.replace(' ', '%20')}")[0] == 422
    for number in range(40):  # pages without a connection are dropped
        body = {"page": f"page{number}"}
        assert studio.request("POST", "cancel", body)[0] == 204
    assert studio.request("POST", "cancel", {"page": "aZ09-_" + "x" * 58})[0] == 204


def test_only_the_models_of_the_latest_scene_are_kept_for_all_pages():
    """A worker process that is started anew opens the scene again, with other IDs."""
    pages = Pages()
    pages.deliver("", {"type": "scene", "number": 1}, {"old": b"bytes"})
    pages.deliver("", {"type": "scene", "number": 2}, {"new": b"bytes"})
    pages.deliver("", {"type": "note"}, {})
    assert (pages.model("old"), pages.model("new")) == (None, b"bytes")


def test_too_many_pages_replace_the_one_that_was_closed_first_and_never_an_open_one():
    pages = Pages()
    for number in range(MOST):
        page = pages.get(f"page{number}")
        page.left = None if number == 3 else float(MOST - number)
        pages.deliver(f"page{number}", {"type": "draft"}, {f"model{number}": b"bytes"})
    for new in range(MOST - 1):
        pages.get(f"new{new}").left = None
        closed = [number for number in range(MOST) if number != 3]
        kept = sorted([3, *closed[: MOST - 2 - new]])
        assert [n for n in range(MOST) if pages.model(f"model{n}")] == kept
    with pytest.raises(OptionError, match="16 pages are open already; close one"):
        pages.get("another")
    assert pages.model("model3")


def test_the_latest_models_of_each_kind_are_kept():
    pages = Pages()
    pages.get("a")
    for number in range(6):
        for kind in KEPT:
            pages.deliver("a", {"type": kind}, {f"{kind}{number}": b"bytes"})
    kept = {kind: [n for n in range(6) if pages.model(f"{kind}{n}")] for kind in KEPT}
    assert kept == {"filtered": [4, 5], "draft": [2, 3, 4, 5], "made": [2, 3, 4, 5]}


def test_only_a_page_that_is_closed_for_a_while_is_gone(monkeypatch):
    pages = Pages()
    monkeypatch.setattr("time.monotonic", lambda: 100.0)
    for name, left in (("open", None), ("long ago", 89.9), ("just now", 90.1)):
        pages.get(name.replace(" ", "_")).left = left
    assert pages.gone() == ["long_ago"]


async def reaches(length, said):
    """Wait until a list has a length."""
    while len(said) < length:
        await asyncio.sleep(0.001)


@contextlib.asynccontextmanager
async def listening(pages):
    """A stream of the page `a` that has begun, and the list of what it says."""
    said = []

    async def say(text):
        said.append(text)

    stream = asyncio.create_task(pages.stream(pages.get("a"), say))
    await reaches(1, said)
    yield stream, said
    stream.cancel()
    await asyncio.wait({stream})


def test_a_stream_begins_with_the_scene_and_passes_on_the_events_of_its_page_and_of_all():
    async def session():
        pages = Pages()
        async with listening(pages) as (_, said):
            pages.get("b")
            pages.deliver("", {"type": "scene", "splats": 5}, {})
            pages.deliver("b", {"type": "draft"}, {})
            pages.deliver("c", {"type": "measured"}, {})
            pages.deliver("a", {"type": "made"}, {})
            await reaches(3, said)
        scene = 'data: {"type": "scene", "splats": 5}\n\n'
        assert said == [": here\n\n", scene, 'data: {"type": "made"}\n\n']
        async with listening(pages) as (_, said):
            pass
        assert said == [scene]

    asyncio.run(asyncio.wait_for(session(), 20))


def test_an_idle_stream_sends_a_sign_of_life(monkeypatch):
    monkeypatch.setattr("nanogs.studio.pages.BEAT", 0.001)

    async def session():
        async with listening(Pages()) as (_, said):
            await reaches(3, said)
        assert {*said} == {": here\n\n"}

    asyncio.run(asyncio.wait_for(session(), 20))


def test_a_page_whose_stream_is_replaced_is_open_until_the_newer_one_is_closed():
    async def session():
        pages = Pages()
        pages.get("b")  # which nobody has open
        async with listening(pages) as (older, _):
            async with listening(pages) as (newer, _):
                await asyncio.wait({older}, timeout=5)  # at once, not at the next sign of life
                assert (older.done(), newer.done()) == (True, False)
                assert (pages.get("a").left, pages.last_left, pages.watched) == (None, None, True)
            assert pages.get("a").left == pages.last_left is not None
            assert not pages.watched

    asyncio.run(session())


def test_a_replaced_stream_leaves_the_remaining_events_to_the_newer_one():
    said = {"older": [], "newer": []}

    async def session():
        pages, go_on = Pages(), asyncio.Event()
        page = pages.get("a")

        async def say_late(text):
            said["older"].append(text)
            if "draft" in text:
                await go_on.wait()  # the connection takes no more for a while

        async def say(text):
            await asyncio.sleep(0)
            said["newer"].append(text)

        for kind in ("draft", "made", "measured"):
            pages.deliver("a", {"type": kind}, {})
        older = asyncio.create_task(pages.stream(page, say_late))
        await asyncio.sleep(0)
        newer = asyncio.create_task(pages.stream(page, say))
        await asyncio.sleep(0)
        go_on.set()
        await asyncio.wait_for(older, 20)
        await asyncio.sleep(0.01)
        newer.cancel()

    asyncio.run(session())
    sent = {name: re.findall('"type": "([a-z]+)"', "".join(said[name])) for name in said}
    assert sent == {"older": ["draft"], "newer": ["made", "measured"]}


def test_a_closed_connection_leaves_the_remaining_events_to_the_next_one():
    pages = Pages()
    page = pages.get("a")

    async def session():
        lost = asyncio.Event()

        async def receive():
            await lost.wait()
            return {"type": "http.disconnect"}

        async def send(message):
            if b"draft" in message.get("body", b""):
                await lost.wait()  # the connection takes no more until it is lost

        for kind in ("draft", "made", "measured"):
            pages.deliver("a", {"type": kind}, {})
        stream = asyncio.create_task(EventStream(partial(pages.stream, page))({}, receive, send))
        await asyncio.sleep(0.01)
        lost.set()
        await asyncio.wait_for(stream, 20)

    asyncio.run(session())
    assert re.findall('"type": "([a-z]+)"', "".join(page.events)) == ["made", "measured"]
    assert page.left is not None
