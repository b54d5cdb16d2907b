"""Output files appear complete or not at all."""

import errno
import io
import os
import pickle
import stat
import tempfile
from pathlib import Path

import pytest

import nanogs
from builders import random_splats
from nanogs.cli.wording import wording
from nanogs.errors import ExistsError, FormatError, OptionError, OutputError
from nanogs.io import file_objects, in_order, temporary
from nanogs.io.atomic import atomic_write, check_writable, move_into_place
from nanogs.io.folder import check_folder_writable
from nanogs.sink import move_file


@pytest.fixture
def target(tmp_path):
    return tmp_path / "out.ply"


def check_folder(path, **options):
    check_folder_writable(path, lambda _: None, **options)


def write_file(path, data=b"new", **options):
    with atomic_write(path, **options) as file:
        file.write(data)


def fail_half_way(path, error, **options):
    with atomic_write(path, **options) as file:
        file.write(b"half")
        raise error


def raise_error(code):
    raise OSError(code, os.strerror(code))


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("overwrite", [False, True])
def test_bytes_are_on_the_disk_before_the_file_has_its_name(target, monkeypatch, overwrite):
    """Otherwise a power cut could leave an empty file under the name."""
    synced = []
    monkeypatch.setattr("os.fsync", lambda _file: synced.append(target.exists()))
    write_file(target, overwrite=overwrite)
    assert (synced, target.read_bytes()) == ([False], b"new")


def test_the_file_appears_and_no_other_file(target):
    write_file(target)
    assert target.read_bytes() == b"new"
    assert names(target.parent) == ["out.ply"]


def test_the_old_file_is_unchanged_until_the_new_one_is_complete(target):
    target.write_bytes(b"old")
    with atomic_write(target, overwrite=True) as file:
        file.write(b"new")
        file.flush()
        assert target.read_bytes() == b"old"
    assert target.read_bytes() == b"new"


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
def test_an_exception_leaves_the_old_file_and_no_temporary_file(target, error):
    target.write_bytes(b"old")
    with pytest.raises(error):
        fail_half_way(target, error(), overwrite=True)
    assert target.read_bytes() == b"old"
    assert names(target.parent) == ["out.ply"]


@pytest.mark.parametrize("check", [write_file, check_writable])
def test_an_existing_file_is_refused_naming_the_argument_or_the_flag(target, check):
    target.write_bytes(b"old")
    with pytest.raises(ExistsError) as caught:
        check(target)
    assert str(caught.value) == f"{target} exists already; pass overwrite=True to replace it."
    assert wording(caught.value) == f"{target} exists already; add -w to replace it."
    again = pickle.loads(pickle.dumps(caught.value))
    assert str(again) == str(caught.value)
    assert target.read_bytes() == b"old"


@pytest.mark.parametrize(
    ("python", "command"),
    [
        ("raise `max_memory`.", "raise --max-memory."),
        ("`resume=True` continues it", "--resume continues it"),
        ("one of `ratio`, `count` and `psnr`.", "one of --ratio, --count and --psnr."),
        ('as with `images="images_4"`', "as with --images images_4"),
        ('give `frame=("rub", "rdf")`.', "give --frame rub:rdf."),
        ("`level=0` shows the finest", "--level 0 shows the finest"),
        ('leave them out with `nan="drop"`.', "leave them out with --nan drop."),
        (
            "fewer neighbours with `k`, and `ulimit -v`",
            "fewer neighbours with --k, and `ulimit -v`",
        ),
    ],
)
def test_messages_name_the_options_of_the_command_instead_of_arguments(python, command):
    assert wording(OptionError(python)) == command


def test_a_file_that_appears_during_writing_is_kept(target):
    with pytest.raises(OutputError, match="exists already"), atomic_write(target):
        target.write_bytes(b"other")
    assert target.read_bytes() == b"other"
    assert names(target.parent) == ["out.ply"]


@pytest.mark.parametrize("links", [True, False])
@pytest.mark.parametrize("move", [move_into_place, move_file])
def test_a_finished_file_is_moved(tmp_path, target, move, links, monkeypatch):
    """Also on file systems that have no links, such as FAT."""
    if not links:
        monkeypatch.setattr(os, "link", lambda *_: raise_error(errno.EPERM))
    for overwrite in (False, True):
        made = tmp_path / "made"
        made.write_bytes(b"new")
        move(made, target, overwrite=overwrite)
        assert names(tmp_path) == ["out.ply"]
        assert target.read_bytes() == b"new"
        target.write_bytes(b"old")


@pytest.mark.parametrize("move", [move_into_place, move_file])
def test_a_file_that_appears_at_the_last_moment_is_kept(tmp_path, target, move, monkeypatch):
    made, link = tmp_path / "made", os.link
    made.write_bytes(b"new")

    def link_late(*paths):
        target.write_bytes(b"other")
        link(*paths)

    monkeypatch.setattr(os, "link", link_late)
    with pytest.raises(ExistsError, match="exists already"):
        move(made, target, overwrite=False)
    assert (made.read_bytes(), target.read_bytes()) == (b"new", b"other")


def test_a_moved_file_reaches_the_disk_before_it_has_its_name(tmp_path, target, monkeypatch):
    made, flushed = tmp_path / "made", []
    made.write_bytes(b"new")
    monkeypatch.setattr(os, "fsync", lambda _: flushed.append(target.exists()))
    move_file(made, target, overwrite=False)
    assert flushed == [False]


@pytest.mark.parametrize("check", [write_file, check_writable])
def test_a_missing_folder_is_refused(tmp_path, check):
    with pytest.raises(OutputError, match="does not exist; create it"):
        check(tmp_path / "none" / "out.ply")


@pytest.mark.parametrize("check", [write_file, check_writable])
def test_a_folder_as_output_file_is_refused(tmp_path, check):
    with pytest.raises(OutputError, match="is a folder"):
        check(tmp_path)


@pytest.mark.parametrize("check", [write_file, check_writable])
def test_a_file_in_place_of_the_output_folder_is_refused(target, check):
    target.write_bytes(b"")
    with pytest.raises(OutputError, match="is no folder"):
        check(target / "out.ply")


@pytest.mark.parametrize("check", [write_file, check_writable])
def test_a_named_pipe_is_not_replaced(tmp_path, check):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OutputError, match="no regular file"):
        check(tmp_path / "pipe", overwrite=True)


@pytest.mark.parametrize("check", [write_file, check_writable])
@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere"
)
def test_a_read_only_folder_is_refused(tmp_path, check):
    tmp_path.chmod(0o500)
    with pytest.raises(OutputError, match="cannot be written to"):
        check(tmp_path / "out.ply")


@pytest.mark.parametrize("code", [errno.EROFS, errno.EACCES])
def test_an_error_of_the_system_on_creation_is_explained(target, monkeypatch, code):
    def refuse(*args, **kwargs):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr("pathlib.Path.open", refuse)
    with pytest.raises(OutputError, match="cannot be written to; change its permissions"):
        check_writable(target)


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_leaves_no_file(target, code):
    with pytest.raises(OutputError, match="disk or quota is full"):
        fail_half_way(target, OSError(code, os.strerror(code)))
    assert names(target.parent) == []


@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_new_file_follows_the_umask(target, umask):
    before = os.umask(umask)
    try:
        write_file(target)
    finally:
        os.umask(before)
    assert stat.S_IMODE(target.stat().st_mode) == 0o666 & ~umask


def test_replaced_file_keeps_its_permissions(target):
    target.write_bytes(b"old")
    target.chmod(0o640)
    write_file(target, overwrite=True)
    assert stat.S_IMODE(target.stat().st_mode) == 0o640


def test_a_symbolic_link_is_followed_and_kept(tmp_path, target):
    folder = tmp_path / "real"
    folder.mkdir()
    (folder / "model.ply").write_bytes(b"old")
    target.symlink_to(folder / "model.ply")
    write_file(target, overwrite=True)
    assert target.is_symlink()
    assert (folder / "model.ply").read_bytes() == b"new"


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("check", [write_file, check_writable, check_folder])
def test_links_that_lead_round_in_a_circle_are_refused_and_kept(tmp_path, check, overwrite):
    (tmp_path / "a").symlink_to(tmp_path / "b")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    with pytest.raises(OutputError, match="a is a symbolic link to itself; remove it first"):
        check(tmp_path / "a", overwrite=overwrite)
    assert (tmp_path / "a").is_symlink()
    (tmp_path / "b.ply").symlink_to(tmp_path / "b.ply")
    with pytest.raises(FormatError, match=r"b\.ply is a symbolic link to itself; name the file"):
        nanogs.load(tmp_path / "b.ply")


def test_the_target_of_a_dangling_link_is_created(tmp_path, target):
    target.symlink_to(tmp_path / "later.ply")
    write_file(target)
    assert (tmp_path / "later.ply").read_bytes() == b"new"


def test_check_writable_leaves_no_file(target):
    check_writable(target)
    assert names(target.parent) == []


def save_source(folder, name):
    nanogs.save(nanogs.open(folder / "a.ply"), folder / name)


NO_PLACE = r"(made|into a temporary file) \(.*\); free some space, or name another place in TMPDIR"


@pytest.mark.parametrize("name", ["b.rad", "b.npz", "b.compressed.ply"])
def test_the_place_for_temporary_files_is_named_if_it_is_missing(tmp_path, monkeypatch, name):
    nanogs.save(random_splats(9), tmp_path / "a.ply")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    with pytest.raises(OutputError, match=NO_PLACE):
        save_source(tmp_path, name)
    with pytest.raises(OutputError, match=NO_PLACE):
        nanogs.load(io.BytesIO(b"ply"))
    assert names(tmp_path) == ["a.ply"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
@pytest.mark.parametrize("name", ["b.rad", "b.npz", "b.compressed.ply"])
def test_the_place_for_temporary_files_is_named_if_it_is_full(tmp_path, monkeypatch, name):
    """The file is full when it is closed too, which must not hide the message."""

    def full(**_options):
        return Path("/dev/full").open("w+b")

    nanogs.save(random_splats(9), tmp_path / "a.ply")
    for module in (temporary, in_order):
        monkeypatch.setattr(module, "TemporaryFile", full)
    with pytest.raises(OutputError, match=r"temporary file \(No space left.*TMPDIR"):
        save_source(tmp_path, name)
    assert names(tmp_path) == ["a.ply"]


def test_the_place_for_what_an_open_file_gets_is_named_if_it_is_full(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    monkeypatch.setattr(file_objects, "_IN_MEMORY", 10)
    with pytest.raises(OutputError, match="TMPDIR"):
        nanogs.save(random_splats(9), io.BytesIO(), format="ply")
