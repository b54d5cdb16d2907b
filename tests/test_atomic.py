"""Outputs appear whole or not at all."""

import errno
import os
import pickle
import stat

import pytest

from nanogs.cli.wording import wording
from nanogs.errors import ExistsError, OptionError, OutputError
from nanogs.io.atomic import atomic_write, check_writable


@pytest.fixture
def target(tmp_path):
    return tmp_path / "out.ply"


def put(path, data=b"new", **options):
    with atomic_write(path, **options) as file:
        file.write(data)


def put_half(path, error, **options):
    with atomic_write(path, **options) as file:
        file.write(b"half")
        raise error


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_file_appears_and_nothing_else(target):
    put(target)
    assert target.read_bytes() == b"new"
    assert names(target.parent) == ["out.ply"]


def test_target_is_untouched_until_the_end(target):
    target.write_bytes(b"old")
    with atomic_write(target, overwrite=True) as file:
        file.write(b"new")
        file.flush()
        assert target.read_bytes() == b"old"
    assert target.read_bytes() == b"new"


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
def test_exception_leaves_the_old_file_and_no_temporary(target, error):
    target.write_bytes(b"old")
    with pytest.raises(error):
        put_half(target, error(), overwrite=True)
    assert target.read_bytes() == b"old"
    assert names(target.parent) == ["out.ply"]


@pytest.mark.parametrize("check", [put, check_writable])
def test_existing_target_names_the_argument_and_the_command_its_flag(target, check):
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
        ("`level=0` shows the finest", "--level 0 shows the finest"),
        ('leave them out with `nan="drop"`.', "leave them out with --nan drop."),
        (
            "fewer neighbours with `k`, and `ulimit -v`",
            "fewer neighbours with --k, and `ulimit -v`",
        ),
    ],
)
def test_arguments_are_options_in_the_words_of_the_command(python, command):
    assert wording(OptionError(python)) == command


def test_target_that_appears_meanwhile_is_kept(target):
    with pytest.raises(OutputError, match="exists already"), atomic_write(target):
        target.write_bytes(b"other")
    assert target.read_bytes() == b"other"
    assert names(target.parent) == ["out.ply"]


@pytest.mark.parametrize("check", [put, check_writable])
def test_missing_folder(tmp_path, check):
    with pytest.raises(OutputError, match="does not exist; create it"):
        check(tmp_path / "none" / "out.ply")


@pytest.mark.parametrize("check", [put, check_writable])
def test_folder_as_target(tmp_path, check):
    with pytest.raises(OutputError, match="is a folder"):
        check(tmp_path)


@pytest.mark.parametrize("check", [put, check_writable])
def test_file_as_folder(target, check):
    target.write_bytes(b"")
    with pytest.raises(OutputError, match="is no folder"):
        check(target / "out.ply")


@pytest.mark.parametrize("check", [put, check_writable])
def test_device_is_not_replaced(tmp_path, check):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OutputError, match="no regular file"):
        check(tmp_path / "pipe", overwrite=True)


@pytest.mark.parametrize("check", [put, check_writable])
@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere"
)
def test_read_only_folder(tmp_path, check):
    tmp_path.chmod(0o500)
    with pytest.raises(OutputError, match="cannot be written to"):
        check(tmp_path / "out.ply")


@pytest.mark.parametrize("code", [errno.EROFS, errno.EACCES])
def test_refusal_to_create(target, monkeypatch, code):
    def refuse(*args, **kwargs):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr("pathlib.Path.open", refuse)
    with pytest.raises(OutputError, match="cannot be written to; change its permissions"):
        check_writable(target)


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT])
def test_full_disk(target, code):
    with pytest.raises(OutputError, match="disk or quota is full"):
        put_half(target, OSError(code, os.strerror(code)))
    assert names(target.parent) == []


@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_new_file_follows_the_umask(target, umask):
    before = os.umask(umask)
    try:
        put(target)
    finally:
        os.umask(before)
    assert stat.S_IMODE(target.stat().st_mode) == 0o666 & ~umask


def test_replaced_file_keeps_its_permissions(target):
    target.write_bytes(b"old")
    target.chmod(0o640)
    put(target, overwrite=True)
    assert stat.S_IMODE(target.stat().st_mode) == 0o640


def test_link_is_written_through(tmp_path, target):
    folder = tmp_path / "real"
    folder.mkdir()
    (folder / "model.ply").write_bytes(b"old")
    target.symlink_to(folder / "model.ply")
    put(target, overwrite=True)
    assert target.is_symlink()
    assert (folder / "model.ply").read_bytes() == b"new"


def test_dangling_link_creates_its_target(tmp_path, target):
    target.symlink_to(tmp_path / "later.ply")
    put(target)
    assert (tmp_path / "later.ply").read_bytes() == b"new"


def test_check_leaves_nothing_behind(target):
    check_writable(target)
    assert names(target.parent) == []
