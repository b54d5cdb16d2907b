"""`-` for stdin and stdout: the same bytes as with files, nothing else on stdout."""

import io
import json
import os
import subprocess
import sys
import zipfile

import pytest

import launch
import nanogs
from builders import random_splats
from nanogs.io import registry
from nanogs.io.registry import sniff
from nanogs.io.spz import write as spz_write


def run(*arguments, data=b"", **kwargs):
    return launch.run(*arguments, text=False, data=data, **kwargs)


def assert_refused(result, *words):
    """Assert exit code 2, one sentence, nothing on stdout, and no name of a temporary file."""
    text = result.stderr.decode()
    assert (result.returncode, result.stdout) == (2, b""), text
    assert text.startswith("error: ")
    assert text.count("\n") == 1, text
    assert "nanogs-" not in text
    for word in words:
        assert word in text


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "scene.ply"
    nanogs.save(random_splats(300, degree=1), path)
    return path


def test_piped_results_have_the_bytes_of_files(scene, tmp_path):
    options = ("--ratio", "0.1", "--preset", "fast")
    piped = run("simplify", "-", "-", *options, "-v", data=scene.read_bytes())
    assert piped.returncode == 0
    run("simplify", scene, tmp_path / "a.ply", *options)
    assert piped.stdout == (tmp_path / "a.ply").read_bytes()
    text = piped.stderr.decode()
    assert "stdin: 300 splats" in text
    assert "stdout: 30 splats" in text
    quiet = run("simplify", "-", "-", *options, "--from", "ply", "--to", "ply", "-q",
                data=scene.read_bytes())  # fmt: skip
    assert (quiet.stdout, quiet.stderr) == (piped.stdout, b"")


def test_one_end_of_the_pipe_may_be_a_file(scene, tmp_path):
    out = run("convert", scene, "-", "--to", "splat")
    assert out.returncode == 0
    target = tmp_path / "a.splat"
    converted = run("convert", "-", target, "--from", ".splat", data=out.stdout)
    assert converted.returncode == 0, converted.stderr
    assert target.read_bytes() == out.stdout
    assert_refused(run("convert", "-", target, "--from", "splat", data=out.stdout), "a.splat", "-w")


def test_json_goes_to_stderr_if_the_model_goes_to_stdout(scene):
    result = run("convert", scene, "-", "--to", "spz", "--json")
    report = json.loads(result.stderr)
    assert (report["input"], report["output"]) == (str(scene), "stdout")
    assert report["output_bytes"] == len(result.stdout)
    read = run("convert", "-", os.devnull, "--json", data=scene.read_bytes())
    assert read.returncode == 2  # the null device is no regular file
    plan = run("simplify", scene, "-", "-r", "0.5", "--dry-run", "--json")
    assert (json.loads(plan.stderr)["asked_count"], plan.stdout) == (150, b"")


def test_levels_of_a_piped_model_can_be_in_another_frame(scene, tmp_path):
    options = ("--levels", "0.5", "--preset", "fast", "--frame", "rub:rdf", "-q", "--no-measure")
    for source, folder in (("-", "a"), (scene, "b")):
        result = run("lod", source, tmp_path / folder, *options, data=scene.read_bytes())
        assert result.returncode == 0, result.stderr
    levels = [(tmp_path / folder / "level_0.ply").read_bytes() for folder in "ab"]
    assert levels[0] == levels[1]


SNIFFED = {
    ".ply": {},
    ".compressed.ply": {},
    ".npz": {},
    ".glb": {},
    ".sog": {},
    ".spz": {"spz_version": 3},
    "v4.spz": {"spz_version": 4},
}


@pytest.mark.parametrize("name", SNIFFED)
def test_the_format_is_recognised_by_the_first_bytes(tmp_path, name):
    nanogs.save(random_splats(20), tmp_path / f"a{name}", format_options=SNIFFED[name])
    found = sniff(tmp_path / f"a{name}")
    expected = registry.find(tmp_path / f"a{name}").suffix
    assert found == expected.replace(".compressed", "")
    raw = (tmp_path / f"a{name}").read_bytes()
    (tmp_path / f"b{found}").write_bytes(raw)
    assert len(nanogs.load(tmp_path / f"b{found}")) == 20


@pytest.mark.parametrize("folder", ["", "web/"])
def test_an_archive_of_levels_is_not_taken_for_a_single_model(tmp_path, folder):
    """A zip of `lod-meta.json` has a `meta.json` for each of its models."""
    splats = random_splats(60)
    nanogs.write_levels(
        splats, tmp_path / "a.ssog", [1, 0.5], layout="streamed sog archive", preset="fast"
    )
    with zipfile.ZipFile(tmp_path / "a.ssog") as archive:
        files = {name: archive.read(name) for name in reversed(archive.namelist())}
    with zipfile.ZipFile(tmp_path / "b", "w") as zipped:
        for name, data in files.items():
            zipped.writestr(folder + name, data)
    assert sniff(tmp_path / "b") == ".ssog"
    assert len(nanogs.load(io.BytesIO((tmp_path / "a.ssog").read_bytes()))) == 60


@pytest.mark.parametrize("data", [b"", b"hello", b"PK\x03\x04 no zip", b"\x00" * 64])
def test_unknown_bytes_have_no_format(tmp_path, data):
    (tmp_path / "a").write_bytes(data)
    assert sniff(tmp_path / "a") is None


def test_spz_4_is_recognised_by_its_own_magic_number(tmp_path):
    with (tmp_path / "a").open("wb") as file:
        spz_write.write(random_splats(5), file, version=4)
    assert sniff(tmp_path / "a") == ".spz"


@pytest.mark.slow
def test_wrong_uses_of_pipes_are_refused(scene, tmp_path):
    data = scene.read_bytes()
    splat = run("convert", scene, "-", "--to", "splat").stdout
    assert_refused(run("convert", "-", "-", data=splat), "--from splat")
    assert_refused(run("convert", "-", "-"), "stdin is empty")
    assert_refused(run("convert", "-", "-", data=data[:-5]), "stdin", "cut short")
    assert_refused(run("convert", "-", "-", "--from", "obj", data=data), "read a format 'obj'")
    assert_refused(run("convert", "-", "-", "--to", "obj", data=data), "does not write")
    textures = run("convert", "-", "-", "--to", "meta.json", data=data)
    assert_refused(
        textures, "error: meta.json describes a folder of files; use a format with a single file"
    )
    assert_refused(
        run("convert", "-", "-", "--from", "ksplat", data=splat),
        "choose another for OUT, as in --to ply",
    )
    ksplat = ("--from", "ksplat", "--to", "ply")
    assert_refused(run("convert", "-", "-", *ksplat, data=splat), "stdin.ksplat")
    spz = run("convert", scene, "-", "--to", "spz").stdout
    assert_refused(
        run("convert", "-", "-", "--from", "ply", data=spz),
        "stdin begins like a .spz file, so it is no .ply file; name the format .spz.\n",
    )
    (tmp_path / "there.ply").touch()
    assert_refused(
        run("convert", "-", tmp_path / "there.ply", data=data), "already; add -w to replace it"
    )
    (tmp_path / "there.ply").unlink()
    assert_refused(
        run("convert", scene, tmp_path / "a.ply", "--to", "ply"), "--to works only if OUT is -"
    )
    assert_refused(
        run("convert", scene, "-", "--from", "ply"),
        "--from works only if IN is -",
        "states the format",
    )
    named = run("convert", "noext", "a.ply", "--from", "ply")
    assert_refused(
        named, "--from works only if IN is -; pipe the file into it, as in - --from ply < noext"
    )
    assert_refused(
        run("convert", scene, "out", "--to", "ply"), "--to works only if OUT is -; name out.ply"
    )
    assert_refused(run("convert", "-", "--out-dir", tmp_path, data=data), "--out-dir")
    assert_refused(run("simplify", "-", "-", "-r", "2", data=data), "ratio")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["meta.json", "lod-meta.json", "tileset.json", "lcc", "lcc2"])
def test_the_manifest_of_a_folder_cannot_be_piped(name):
    result = run("info", "-", "--from", name, data=b"{}")
    assert_refused(result, f"A {name} refers to other files", "name the file instead of -")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
@pytest.mark.parametrize("name", ["a.ply", "a.sog", "tileset.json", "a", "a.data"])
def test_a_named_pipe_is_refused_without_waiting_for_its_writer(tmp_path, name):
    os.mkfifo(tmp_path / name)
    assert_refused(run("info", tmp_path / name, timeout=60), f"{name} is no regular file")


def test_terminals_are_refused_for_models(scene):
    pty = pytest.importorskip("pty")
    leader, follower = pty.openpty()
    try:
        command = [sys.executable, "-m", "nanogs", "convert"]
        to = subprocess.run(
            [*command, scene, "-"], stdout=follower, stderr=subprocess.PIPE, timeout=60
        )
        assert to.returncode == 2
        assert b"stdout is a terminal" in to.stderr
        assert_refused(
            subprocess.run([*command, "-", "-"], stdin=follower, capture_output=True, timeout=60),
            "stdin is a terminal",
        )
    finally:
        os.close(leader)
        os.close(follower)


def test_no_temporary_file_is_left(scene, tmp_path):
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    for extra in ((), ("--min-opacity", "2")):
        run("convert", "-", "-", *extra, data=scene.read_bytes(), env=environment)
        assert [path for path in tmp_path.iterdir() if path.name.startswith("nanogs")] == []


@pytest.mark.skipif(sys.platform == "win32", reason="pipes end otherwise there")
@pytest.mark.parametrize(
    "arguments", [("info",), ("info", "--json"), ("convert", "-", "--to", "ply"), ("--help",)]
)
def test_a_closed_pipe_ends_the_command_quietly(scene, arguments):
    """With the exit code of programs that SIGPIPE ends, and without any output."""
    first, *rest = arguments
    command = [first, *([] if first == "--help" else [scene]), *rest]
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "nanogs", *map(str, command)]
    ended = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, timeout=60)
    os.close(writer)
    assert (ended.returncode, ended.stderr) == (141, b"")


def test_levels_of_a_piped_model_equal_those_of_its_file(scene, tmp_path):
    for source, data in (("-", scene.read_bytes()), (scene, None)):
        folder = tmp_path / str(data is None)
        result = run("lod", source, folder, "--preset", "fast", "--levels", "0.1", data=data)
        assert result.returncode == 0, result.stderr
    levels = [tmp_path / str(whole) / "level_0.ply" for whole in (False, True)]
    assert levels[0].read_bytes() == levels[1].read_bytes()


def test_levels_are_made_of_a_piped_model_whose_format_is_named(scene, tmp_path):
    splat, fast = tmp_path / "a.splat", ("--preset", "fast", "--levels", "0.1")
    nanogs.save(nanogs.load(scene), splat)
    assert_refused(run("lod", "-", tmp_path / "no", *fast, data=splat.read_bytes()), "--from splat")
    piped = ("lod", "-", tmp_path / "piped", "--from", "splat", *fast)
    for result in (
        run(*piped, data=splat.read_bytes()),
        run("lod", splat, tmp_path / "named", *fast),
    ):
        assert result.returncode == 0, result.stderr
    levels = [tmp_path / name / "level_0.ply" for name in ("piped", "named")]
    assert levels[0].read_bytes() == levels[1].read_bytes()
    assert_refused(run("lod", scene, tmp_path / "no", "--from", "ply", *fast), "leave it out")


def redirected(redirection, *arguments):
    """Run the command in a shell with a redirection, such as `>&-`."""
    command = [sys.executable, "-m", "nanogs", *map(str, arguments)]
    return subprocess.run(
        ["sh", "-c", f'"$@" {redirection}', "sh", *command], capture_output=True, timeout=120
    )


UNWRITABLE = pytest.mark.skipif(sys.platform != "linux", reason="needs /dev/full")


@UNWRITABLE
@pytest.mark.parametrize(
    "arguments",
    [
        ("--version",),
        ("--help",),
        ("presets",),
        ("info", "{}"),
        ("info", "{}", "--json"),
        ("convert", "{}", "-"),
        ("simplify", "{}", "-", "--preset", "fast", "-n", "30", "-q"),
    ],
)
def test_a_full_disk_at_stdout_is_named(scene, arguments):
    result = redirected(">/dev/full", *(word.format(scene) for word in arguments))
    assert_refused(result, "stdout: the disk or quota is full")


@UNWRITABLE
def test_a_closed_stdout_fails_only_what_writes_to_it(scene, tmp_path):
    small = ("simplify", scene, tmp_path / "a.ply", "--preset", "fast", "-n", "30", "-w")
    result = redirected(">&-", *small)
    assert (result.returncode, result.stdout) == (0, b"")
    assert nanogs.info(tmp_path / "a.ply").file.splats == 30
    assert_refused(redirected(">&-", *small, "--json"), "stdout cannot be written")
    assert_refused(redirected(">&-", "info", scene), "stdout cannot be written")


@UNWRITABLE
def test_a_current_folder_that_was_removed_is_named(scene, tmp_path):
    gone = f"mkdir {tmp_path}/gone && cd {tmp_path}/gone && rmdir {tmp_path}/gone"
    job = "--preset fast -r 0.5 --scratch s --job"
    words = f"{sys.executable} -m nanogs simplify {scene} {tmp_path}/a.ply {job} {tmp_path}/job"
    result = subprocess.run(["sh", "-c", f"{gone} && {words}"], capture_output=True, timeout=120)
    assert_refused(result, "The current folder does not exist any more; change to another one.")


@UNWRITABLE
def test_a_closed_stdin_is_refused(tmp_path):
    for words in (("info", "-"), ("convert", "-", tmp_path / "a.ply")):
        assert_refused(redirected("<&-", *words), "stdin is closed; pipe a model into it")


@UNWRITABLE
def test_a_full_disk_at_stderr_ends_no_run(scene, tmp_path):
    small = ("simplify", scene, tmp_path / "a.ply", "--preset", "fast", "-n", "30", "-w")
    result = redirected("2>/dev/full", *small)
    assert (result.returncode, result.stdout, result.stderr) == (0, b"", b"")
    assert nanogs.info(tmp_path / "a.ply").file.splats == 30
    assert redirected("2>/dev/full", *small[:-1]).returncode == 2  # the file exists
    assert redirected("2>&-", *small).returncode == 0
