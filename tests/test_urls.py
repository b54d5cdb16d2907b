"""URLs as inputs and outputs: downloaded first, uploaded at the end, never shown with secrets."""

import gzip
import json
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from base64 import b64decode
from contextlib import contextmanager
from functools import partial
from http.server import BaseHTTPRequestHandler, SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import launch
import nanogs
import radfiles
from builders import random_splats
from nanogs.errors import FormatError, OptionError, OutputError
from nanogs.io.urls import Address, UrlFile, as_path, is_url, redacted, short_names
from nanogs.memory import LIBRARIES

SECRETS = ("PASSWORD", "SIGNATURE")
QUERY = "?X-Amz-Signature=SIGNATURE#part"


@contextmanager
def serving(handler):
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()


class Files(SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("hosted")
    splats = random_splats(300, degree=1)
    nanogs.save(splats, path / "scene.ply")
    nanogs.save(splats, path / "my scene.spz")
    nanogs.save(splats, path / "bare.splat")
    nanogs.save(splats, path / "sog" / "meta.json")
    (path / "download").write_bytes((path / "scene.ply").read_bytes())
    (path / "blob").write_bytes((path / "bare.splat").read_bytes())
    (path / "cut.ply").write_bytes((path / "scene.ply").read_bytes()[:-5])
    (path / "page").write_text("<!doctype html><title>no model</title>")
    return path


@pytest.fixture(scope="module")
def host(folder):
    with serving(partial(Files, directory=folder)) as url:
        yield url


@pytest.fixture
def memory():
    """An empty in-memory file system of fsspec."""
    fsspec = pytest.importorskip("fsspec")
    files = fsspec.filesystem("memory")
    files.store.clear()
    yield files
    files.store.clear()


def run_checked(*arguments, **kwargs):
    result = launch.run(*arguments, **kwargs)
    assert result.returncode == 0, result.stderr
    return result


def assert_refused(result, *words):
    """Check for exit code 2 and a one-sentence error without secrets or temporary paths."""
    text = result.stderr
    assert (result.returncode, result.stdout) == (2, ""), text
    assert text.startswith("error: ")
    assert text.count("\n") == 1, text
    assert text.endswith(".\n")
    for word in words:
        assert word in text, text
    for word in (*SECRETS, "nanogs-"):
        assert word not in text, text


def test_info_of_a_url_equals_info_of_the_file(folder, host, temporary):
    by_url = json.loads(run_checked("info", f"{host}/scene.ply{QUERY}", "--json").stdout)
    by_path = json.loads(run_checked("info", folder / "scene.ply", "--json").stdout)
    assert by_url.pop("path") == f"{host}/scene.ply"
    assert by_path.pop("path") == str(folder / "scene.ply")
    assert by_url == by_path
    text = run_checked("info", f"{host}/scene.ply").stdout
    assert f"{host}/scene.ply (ply" in text


def test_the_format_of_a_url_without_suffix_comes_from_content_or_option(host, temporary):
    """The first bytes of the file decide, or --from."""
    assert "(ply" in run_checked("info", f"{host}/download?id=7").stdout
    assert_refused(launch.run("info", f"{host}/blob{QUERY}"), f"{host}/blob", "--from splat")
    assert "(splat" in run_checked("info", f"{host}/blob", "--from", "splat").stdout
    assert_refused(launch.run("render", f"{host}/blob", "a.png"), f"{host}/blob", "download it")
    assert_refused(launch.run("info", f"{host}/page"), f"{host}/page is a web page")


def test_file_names_from_urls_are_unquoted(host, temporary, tmp_path):
    result = run_checked(
        "convert", f"{host}/my%20scene.spz", "--out-dir", tmp_path / "o", "--format", "ply"
    )
    assert f"{host}/my%20scene.spz" in result.stderr
    assert (tmp_path / "o" / "my scene.ply").exists()


def test_a_sog_folder_is_downloaded_through_its_meta_json(folder, host, temporary):
    info = json.loads(run_checked("info", f"{host}/sog/meta.json{QUERY}", "--json").stdout)
    assert info["file_bytes"] == sum(each.stat().st_size for each in (folder / "sog").iterdir())
    for name in ("lod-meta.json", "tileset.json", "levels.json", "scan.lcc", "meta.lcc2"):
        assert_refused(
            launch.run("info", f"{host}/{name}"), f"{host}/{name}", "download the whole folder"
        )


def test_files_that_a_model_names_are_downloaded(folder, host, temporary, tmp_path):
    """A `.gltf` with its buffer in another file, and a `.rad` with its chunks in others."""
    nanogs.save(random_splats(30), folder / "packed.gltf")
    content = json.loads((folder / "packed.gltf").read_text())
    body = content["buffers"][0]["uri"].partition(",")[2]
    (folder / "parts" / "b").mkdir(parents=True)
    (folder / "parts" / "b" / "my buffer.bin").write_bytes(b64decode(body))
    content["buffers"][0]["uri"] = "b/my%20buffer.bin"
    (folder / "parts" / "a.gltf").write_text(json.dumps(content))
    chunks = radfiles.small_tree()[0]
    entries = [{"filename": f"a-{number}.radc"} for number in range(len(chunks))]
    (folder / "parts" / "a.rad").write_bytes(radfiles.rad([], 8, chunks=entries, lodTree=True))
    for entry, chunk in zip(entries, chunks, strict=True):
        (folder / "parts" / entry["filename"]).write_bytes(chunk)
    for name in ("a.gltf", "a.rad"):
        run_checked("convert", f"{host}/parts/{name}{QUERY}", tmp_path / "url.ply", "-w")
        nanogs.convert(folder / "parts" / name, tmp_path / "file.ply", overwrite=True)
        assert (tmp_path / "url.ply").read_bytes() == (tmp_path / "file.ply").read_bytes()


def test_levels_in_one_file_are_downloaded(folder, host, temporary, tmp_path):
    for name in ("levels.ssog", "tree.rad"):
        levels = ("--levels", "1,0.5", "--preset", "fast")
        run_checked("lod", folder / "scene.ply", folder / name, *levels)
        run_checked("convert", f"{host}/{name}{QUERY}", tmp_path / "url.ply", "--level", "1", "-w")
        run_checked("convert", folder / name, tmp_path / "file.ply", "--level", "1", "-w")
        assert len(nanogs.load(tmp_path / "url.ply")) == 150
        assert (tmp_path / "url.ply").read_bytes() == (tmp_path / "file.ply").read_bytes()


def test_commands_give_the_same_bytes_for_urls_and_files(folder, host, temporary, tmp_path):
    url, options = f"{host}/scene.ply{QUERY}", ("--ratio", "0.1", "--preset", "fast")
    first = run_checked("simplify", url, tmp_path / "a.ply", *options, "-v", "--json")
    run_checked("simplify", folder / "scene.ply", tmp_path / "b.ply", *options)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    report = json.loads(first.stdout)
    assert (report["input"], report["output"]) == (f"{host}/scene.ply", str(tmp_path / "a.ply"))
    run_checked("convert", url, tmp_path / "a.spz")
    run_checked("convert", folder / "scene.ply", tmp_path / "b.spz")
    assert (tmp_path / "a.spz").read_bytes() == (tmp_path / "b.spz").read_bytes()
    levels = ("--levels", "1,0.5", "--preset", "fast", "--no-measure")
    run_checked("lod", url, tmp_path / "lod", *levels)
    run_checked("lod", folder / "scene.ply", tmp_path / "lod_of_file", *levels)
    lod_files = launch.contents(tmp_path / "lod")
    assert len(lod_files) == 3
    assert lod_files == launch.contents(tmp_path / "lod_of_file")
    for path, data in launch.contents(tmp_path).items():
        assert not any(secret.encode() in data for secret in SECRETS), path


def test_a_url_is_simplified_in_blocks_like_the_file(folder, host, temporary, tmp_path):
    nanogs.save(random_splats(60_000, degree=0), folder / "large.ply")
    options = ("--ratio", "0.1", "--preset", "fast", "--max-memory", f"{int(1.075 * LIBRARIES)}B")
    paths = {"a.ply": f"{host}/large.ply{QUERY}", "b.ply": folder / "large.ply"}
    for name, path in paths.items():
        report = json.loads(
            run_checked("simplify", path, tmp_path / name, *options, "--json").stdout
        )
        assert report["blocks"]["blocks"] > 1
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    assert not any(secret.encode() in (tmp_path / "a.ply").read_bytes() for secret in SECRETS)
    assert sorted(path.name for path in tmp_path.glob("*.ply*")) == ["a.ply", "b.ply"]


def test_commands_that_render_take_urls(folder, host, temporary, tmp_path):
    url, views = f"{host}/scene.ply{QUERY}", ("--views", "1", "--pixels", "32")
    result = run_checked(
        "compare", url, f"half={url}", *views, "--report", tmp_path / "r.html", "--json"
    )
    assert [model["name"] for model in json.loads(result.stdout)["models"]] == ["half"]
    run_checked("render", url, tmp_path / "a.png", *views)
    run_checked("render", folder / "scene.ply", tmp_path / "b.png", *views)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    run_checked("refit", url, f"{host}/my%20scene.spz", tmp_path / "fit.ply", *views)
    assert not any(word in (tmp_path / "r.html").read_text() for word in SECRETS)
    assert_refused(launch.run("render", url, f"{host}/pictures"), "is a URL")
    assert_refused(launch.run("lod", url, "s3://bucket/lod"), "is a URL")
    for words in ((url,), ("--scene", f"a={url}"), ("--scene", f"a={url}:{folder}")):
        result = launch.run("bench", *words, "--out", tmp_path / "bench")
        assert_refused(
            result, f"{host}/scene.ply is a URL; every method reads a file", "download it"
        )
    assert not (tmp_path / "bench").exists()


def test_view_takes_a_url(host, temporary, tmp_path):
    from nanogs.view.bundle import is_built

    if not is_built():
        pytest.skip("the viewer was not built")
    run_checked("view", f"{host}/scene.ply{QUERY}", "--no-open", cwd=tmp_path)
    assert not any(word in (tmp_path / "scene.html").read_text() for word in SECRETS)


def test_urls_that_cannot_be_read_or_written_are_refused(host, temporary, tmp_path):
    assert_refused(launch.run("info", f"{host}/none.ply{QUERY}"), f"{host}/none.ply", "404")
    assert_refused(launch.run("info", "http://host.invalid/a.ply"), "there is no host host.invalid")
    assert_refused(launch.run("info", "http://127.0.0.1:1/a.ply"), "127.0.0.1:1 cannot be reached")
    assert_refused(launch.run("info", "http://[bad/a.ply"), "http://[bad/a.ply")
    assert_refused(launch.run("info", "http://127.0.0.1:port/a.ply"), "http://127.0.0.1:port/a.ply")
    assert_refused(launch.run("info", f"{host}/cut.ply{QUERY}"), f"{host}/cut.ply", "cut short")
    assert_refused(
        launch.run("convert", f"{host}/scene.ply", f"gs://b/b.ply{QUERY}"),
        "cannot have a ? or #; leave it out",
    )
    assert_refused(launch.run("info", "file://elsewhere/a.ply"), "machine elsewhere")
    assert_refused(
        launch.run("convert", f"{host}/scene.ply", f"{host}/b.ply"), "cannot write to web servers"
    )
    assert_refused(
        launch.run("convert", f"{host}/scene.ply", "s3://b/b.obj"), "does not write this format"
    )
    url = f"{host}/scene.ply{QUERY}"
    for option in (("--resume",), ("--job", tmp_path / "job"), ("--join",)):
        result = launch.run("simplify", url, tmp_path / "b.ply", "-r", "0.5", *option)
        assert_refused(result, f"{host}/scene.ply is a URL", option[0])
    assert_refused(
        launch.run("convert", url, tmp_path / "b.ply", "--to", "ply"), "--to works only if OUT is -"
    )
    assert not (tmp_path / "b.ply").exists()


def test_a_url_in_place_of_a_local_file_or_folder_is_refused(folder, tmp_path, monkeypatch):
    """It was taken for a path whose first folder is "s3:", and that folder was made."""
    monkeypatch.chdir(tmp_path)
    scene, out = folder / "scene.ply", tmp_path / "out.ply"
    for arguments in (
        ("convert", scene, "--out-dir", "s3://b/x", "--format", "ply"),
        ("simplify", scene, out, "-r", "0.5", "--job", "s3://b/x"),
        ("compare", scene, scene, "--photos", "s3://b/x"),
        ("compare", scene, scene, "--report", "s3://b/x.html"),
        ("info", scene, "--photos", "s3://b/x"),
        ("view", scene, "-o", "s3://b/x.html"),
        ("bench", scene, "-o", "s3://b/x"),
    ):
        assert_refused(launch.run(*arguments), "s3://b/x", "URL; name a file or folder of this mac")
    for options in ({"folder": "s3://b/x"}, {"folder": "levels", "job": "s3://b/x"}):
        with pytest.raises(OptionError, match="s3://b/x is a URL; name a file or folder"):
            nanogs.write_levels(scene, **options)
    with pytest.raises(OptionError, match="s3://b/x is a URL; name a file or folder"):
        nanogs.simplify_blocks(scene, out, ratio=0.5, job="s3://b/x")
    with pytest.raises(OptionError, match="A path or URL is needed, not int"):
        nanogs.write_levels(scene, 3)
    assert not [*tmp_path.iterdir()]


def test_if_one_of_several_urls_fails_the_others_are_converted(host, temporary, tmp_path):
    out = tmp_path / "out"
    result = launch.run("convert", f"{host}/scene.ply{QUERY}", f"{host}/none.ply{QUERY}",
                        "--out-dir", out, "--format", "spz")  # fmt: skip
    assert result.returncode == 2
    assert f"{host}/none.ply: there is no such file" in result.stderr
    assert not any(word in result.stderr for word in SECRETS)
    assert [each.name for each in out.iterdir()] == ["scene.spz"]


class UnusualServer(BaseHTTPRequestHandler):
    """A server that gives unusual answers, selected by the requested path."""

    data = b""
    seen: list[tuple[str, str | None]] = []  # noqa: RUF012

    def log_message(self, *_):
        pass

    def do_GET(self):
        self.seen.append((self.path, self.headers["Authorization"]))
        do = getattr(self, self.path.split("?")[0].strip("/").replace(".ply", ""))
        do()

    def answer(self, body, *, length=None, **headers):
        self.send_response(200)
        self.send_header("Content-Length", str(len(body) if length is None else length))
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        self.wfile.write(body)

    def broken(self):
        self.answer(self.data[:100], length=len(self.data))

    def huge(self):
        self.answer(b"ply", length=10**18)

    def packed(self):
        self.answer(gzip.compress(self.data), Content_Encoding="gzip")

    def halved(self):
        self.answer(gzip.compress(self.data)[:-20], Content_Encoding="gzip")

    def unmeasured(self):
        self.send_response(200)
        self.end_headers()
        self.wfile.write(self.data)

    def locked(self):
        if self.headers["Authorization"] is None:
            self.send_error(401)
        else:
            self.answer(self.data)

    def gone_on(self):
        self.send_response(302)
        self.send_header("Location", "/unmeasured.ply")
        self.end_headers()

    def busy(self):
        self.send_error(503)

    def endless(self):
        self.send_response(200)
        self.end_headers()
        while True:
            self.wfile.write(bytes(1 << 16))
            time.sleep(0.01)


@pytest.fixture
def unusual_server(folder):
    UnusualServer.data, UnusualServer.seen = (folder / "scene.ply").read_bytes(), []
    with serving(UnusualServer) as url:
        yield url


def test_unusual_server_answers_are_read_or_refused(unusual_server, temporary):
    assert_refused(
        launch.run("info", f"{unusual_server}/broken.ply{QUERY}"), "connection broke after 100 of"
    )
    assert_refused(launch.run("info", f"{unusual_server}/huge.ply{QUERY}"), "TMPDIR", "free")
    assert_refused(launch.run("info", f"{unusual_server}/halved.ply"), "the download was cut short")
    assert_refused(launch.run("info", f"{unusual_server}/busy.ply{QUERY}"), "answers 503")
    assert_refused(
        launch.run("info", f"{unusual_server}/locked.ply{QUERY}"), "refuses access (401)"
    )
    for name in ("packed", "unmeasured", "gone_on"):
        assert len(nanogs.load(f"{unusual_server}/{name}.ply")) == 300


def test_a_password_is_sent_only_to_the_url_it_was_given_for(unusual_server, temporary):
    url = unusual_server.replace("http://", "http://me:PASSWORD@")
    result = run_checked("info", f"{url}/locked.ply", "--json")
    assert json.loads(result.stdout)["path"] == f"{unusual_server}/locked.ply"
    run_checked("info", f"{url}/gone_on.ply")
    keys = [key for _path, key in UnusualServer.seen]
    assert keys == ["Basic bWU6UEFTU1dPUkQ=", "Basic bWU6UEFTU1dPUkQ=", None]
    assert_refused(launch.run("info", f"{url}/busy.ply"), f"{unusual_server}/busy.ply")


@pytest.mark.skipif(sys.platform == "win32", reason="signals are otherwise there")
def test_a_cancelled_download_leaves_no_temporary_file(unusual_server, temporary):
    command = [sys.executable, "-m", "nanogs", "info", f"{unusual_server}/endless.ply{QUERY}"]
    run = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=dict(os.environ))
    deadline = time.monotonic() + 60
    while not list(temporary.rglob("endless.ply")):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    time.sleep(2.5)  # until progress is shown
    run.send_signal(signal.SIGTERM)  # a background process may ignore SIGINT
    stderr = run.communicate(timeout=30)[1]
    assert run.returncode == 143
    assert "1/1 fetch" in stderr
    assert "cancelled" in stderr
    assert not any(word in stderr for word in SECRETS)


def test_open_keeps_the_downloaded_file_until_the_source_is_closed(folder, host, temporary):
    whole = nanogs.load(folder / "my scene.spz")
    source = nanogs.open(f"{host}/my%20scene.spz{QUERY}")
    assert len(list(temporary.iterdir())) == 1
    assert source.name == f"{host}/my%20scene.spz"
    assert np.array_equal(source.read(5, 9).means, whole.means[5:9])
    source.close()
    assert list(temporary.iterdir()) == []
    with nanogs.open(f"{host}/scene.ply", render_mode="mip") as source:
        assert source.load().render_mode == "mip"
    forgotten = nanogs.open(f"{host}/scene.ply")
    del forgotten
    assert list(temporary.iterdir()) == []
    with pytest.raises(FormatError, match="404"):
        nanogs.open(f"{host}/none.ply")


def test_library_functions_take_urls(folder, host, temporary, memory, tmp_path):
    url = f"{host}/scene.ply{QUERY}"
    report = nanogs.convert(url, "memory://x/out.spz")
    assert (report.input, report.output) == (f"{host}/scene.ply", "memory://x/out.spz")
    nanogs.convert(folder / "scene.ply", tmp_path / "out.spz")
    assert memory.cat_file("/x/out.spz") == (tmp_path / "out.spz").read_bytes()
    assert str(nanogs.info(url).file.path) == f"{host}/scene.ply"
    options = {"ratio": 0.1, "preset": "fast"}
    nanogs.simplify_blocks(url, "memory://x/small.ply", **options)
    nanogs.simplify_blocks(folder / "scene.ply", tmp_path / "small.ply", **options)
    assert memory.cat_file("/x/small.ply") == (tmp_path / "small.ply").read_bytes()
    for source, name in ((url, "a.ply"), (folder / "scene.ply", "b.ply")):
        report = nanogs.simplify_blocks(source, tmp_path / name, block=150, threads=1, **options)
        assert report.blocks.blocks > 1
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    with pytest.raises(OptionError, match="is a URL; give the source"):
        nanogs.write_levels(url, tmp_path / "levels")
    compared = nanogs.compare(url, url, views=1, pixels=32)
    assert [model.name for model in compared.models] == ["scene.ply"]
    with pytest.raises(OptionError, match="`resume`"):
        nanogs.simplify_blocks(url, tmp_path / "b.ply", resume=True, **options)
    splats = nanogs.load("memory://x/small.ply")
    with pytest.raises(OutputError, match="exists already; pass overwrite=True"):
        nanogs.save(splats, "memory://x/small.ply")
    nanogs.save(splats, "memory://x/small.ply", overwrite=True)
    nanogs.io.check_writable("memory://x/small", format=".spz")
    nanogs.save(splats, "memory://x/small", format=".spz")
    with pytest.raises(OutputError, match="exists already"):
        nanogs.io.check_writable("memory://x/small", format=".spz")
    assert len(nanogs.load("memory://x/small", format="spz")) == 30
    nanogs.save(splats, f"file://{tmp_path}/a%20b.ply")
    assert len(nanogs.load(tmp_path / "a b.ply")) == 30


def test_commands_write_to_urls(folder, temporary, memory, capfd):
    scene, out = folder / "scene.ply", "memory://x/out.ply"
    assert launch.run_here("convert", scene, out, "--json") == 0
    assert json.loads(capfd.readouterr().out)["output"] == out
    assert memory.cat_file("/x/out.ply") == scene.read_bytes()
    assert launch.run_here("convert", scene, out, "--sh-degree", "0") == 2
    assert f"{out} exists already; add -w to replace it." in capfd.readouterr().err
    assert launch.run_here("convert", scene, out, "-w") == 0
    capfd.readouterr()
    small = ("-r", "0.1", "--preset", "fast")
    assert launch.run_here("simplify", scene, out, *small) == 2
    assert f"{out} exists already; add -w to replace it." in capfd.readouterr().err
    assert launch.run_here("simplify", scene, out, *small, "--dry-run", "-w") == 0
    assert len(memory.cat_file("/x/out.ply")) == scene.stat().st_size
    capfd.readouterr()
    assert launch.run_here("simplify", scene, out, *small, "-w") == 0
    assert f"30 splats in {out}" in capfd.readouterr().err
    views = ("--views", "1", "--pixels", "32")
    assert launch.run_here("refit", scene, out, "memory://x/fit.spz", *views) == 0
    assert len(nanogs.load("memory://x/fit.spz")) == 30
    assert launch.run_here("convert", scene, "memory://x/meta.json") == 2
    assert "name one file" in capfd.readouterr().err


def test_a_failed_upload_leaves_nothing_in_the_store(folder, temporary, memory, monkeypatch, capfd):
    from fsspec.implementations.memory import MemoryFile

    def fail(self, data):
        super(MemoryFile, self).write(data[:10])
        raise RuntimeError("the store is full")

    monkeypatch.setattr(MemoryFile, "write", fail)
    assert launch.run_here("convert", folder / "scene.ply", "memory://x/a.ply") == 2
    assert "memory://x/a.ply cannot be written (the store is full)" in capfd.readouterr().err
    assert memory.find("/") == []


def test_missing_packages_are_named(temporary, monkeypatch, capfd):
    from fsspec.registry import _registry  # which an earlier test may have filled

    monkeypatch.delitem(_registry, "s3", raising=False)
    monkeypatch.setitem(sys.modules, "s3fs", None)
    assert launch.run_here("info", "s3://bucket/a.ply") == 2
    assert 'pip install "nanogs[s3]"' in capfd.readouterr().err
    monkeypatch.setitem(sys.modules, "fsspec", None)
    assert launch.run_here("info", "s3://bucket/a.ply") == 2
    assert 'pip install "nanogs[s3]"' in capfd.readouterr().err
    assert launch.run_here("info", "gs://bucket/a.ply") == 2
    assert 'pip install "nanogs[urls]"' in capfd.readouterr().err


WORDS = st.text("abcXYZ019_-.", min_size=1, max_size=8)


@settings(max_examples=50)
@given(
    WORDS, WORDS, st.lists(WORDS, min_size=1, max_size=3), WORDS, st.sampled_from(["https", "s3"])
)
def test_addresses_hide_user_password_and_query(user, word, path, query, kind):
    plain = f"{kind}://host.org/{'/'.join(path)}.ply"
    url = f"{plain.replace('://', f'://{user}:<pass{word}>@')}?key=<key{query}>"
    address = as_path(url)
    assert is_url(url)
    assert (str(address), redacted(url)) == (plain, plain)
    assert address.url == url
    assert address.name.endswith("ply")
    assert Path(address.name).name == address.name
    assert pickle.loads(pickle.dumps(address)) == address
    assert "<" not in repr(address)
    assert "<" not in address.said(f"{url} was not found; of <key{query}>, <pass{word}>")
    assert address.beside("a b.webp").url.endswith(f"/a b.webp?key=<key{query}>") or kind == "https"


def test_paths_stay_paths(tmp_path):
    for text in ("scene.ply", "C:/scene.ply", "a=b/c.ply", "s3:/bucket/a.ply", str(tmp_path)):
        assert not is_url(text)
        assert type(as_path(text)) is type(Path(text))
    assert as_path("file:///a/b%20c.ply") == Path("/a/b c.ply") or os.name == "nt"
    assert as_path("https://h/..").name == "model"
    assert as_path("zip://a/b.ply::s3://bucket/all.zip?key").name == "b.ply"
    assert (
        str(as_path("zip://b.ply::s3://k:s@bucket/all.zip?key"))
        == "zip://b.ply::s3://bucket/all.zip"
    )


@pytest.mark.parametrize("text", ["a\0.ply", "file:///a%00.ply", "\ud800.ply"])
def test_a_path_that_no_file_can_have_is_refused(text):
    with pytest.raises(OptionError, match="cannot be the name of a file"):
        as_path(text)


def test_a_url_file_is_a_local_file_shown_under_its_url(tmp_path):
    (tmp_path / "a.ply").write_bytes(b"x")
    file = UrlFile(tmp_path / "a.ply", "https://h/b.ply")
    assert (str(file), os.fspath(file)) == ("https://h/b.ply", str(tmp_path / "a.ply"))
    assert file.read_bytes() == b"x"
    assert (file.parent, file.with_name("c")) == (tmp_path, tmp_path / "c")
    assert str(file.with_name("c")) == str(tmp_path / "c")
    again = pickle.loads(pickle.dumps(file))
    assert (again, str(again)) == (file, str(file))
    assert file != Address("https://h/b.ply")


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["x/a.ply", "y/b.ply"], ["a.ply", "b.ply"]),
        (["x/a.ply", "y/a.ply", "x/b.ply"], ["x/a.ply", "y/a.ply", "b.ply"]),
        (["a.ply", "x/a.ply", "/y/x/a.ply"], ["a.ply", "x/a.ply", "y/x/a.ply"]),
        (["/a.ply", "a.ply"], ["/a.ply", "a.ply"]),
        (["x/a.ply", "x/a.ply", "./x/a.ply"], ["a.ply"] * 3),
        (["s3://k@b/x/a.ply", "https://c/x/a.ply?s"], ["b/x/a.ply", "c/x/a.ply"]),
    ],
)
def test_files_have_the_shortest_names_that_tell_them_apart(paths, names):
    assert short_names([*map(as_path, paths)]) == names
