"""Reading `.lcc2`, against the tiny writer of `lcc2files` and against splat-transform."""

import json
from dataclasses import replace

import numpy as np
import pytest

import lcc2files
import nanogs
from builders import model_bytes, random_splats
from launch import run
from nanogs import io
from nanogs.errors import FormatError, OptionError
from nanogs.frames import change_frame
from nanogs.source import joined_rows
from nanogs.splats import ExtraElement, RenderMode
from npm_packages import splat_transform
from part_reading import in_parts
from strategies import assert_same
from test_gltf import covariances


@pytest.fixture(scope="module", params=[(".sog", False), (".spz", False), (".sog", True)])
def scan(request, tmp_path_factory):
    """The path of a model and the splats of its files: two of level 0, one of level 1, the sky."""
    kind, old = request.param
    folder = tmp_path_factory.mktemp("scan")
    return lcc2files.model(folder, np.random.default_rng(3), kind, old=old)


@pytest.fixture
def scene(tmp_path):
    """The path of a model that a test may damage."""
    return lcc2files.model(tmp_path / "scan", np.random.default_rng(3))[0]


def change(path, **changes):
    """Replace entries of the description; None removes one."""
    found = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({key: value for key, value in found.items() if value is not None}))


def tree_of(path, child, **changes):
    """Replace the nodes below the root."""
    root = json.loads(path.read_text())["root"]
    change(path, root=root | {"child": child} | changes)


def test_levels_and_the_environment_are_read_in_another_frame(scan):
    """In the files z is up; files follow each other in the order of the list."""
    path, (first, coarse, second, sky) = scan
    for level, parts in enumerate([(first, second, sky), (coarse, sky)]):
        expected = change_frame(joined_rows(parts), "rfu", "rdf")
        model = io.load(path, level=level)
        assert model_bytes(model) == model_bytes(expected)
        assert model.notes == ()
    [mean] = first.means[:1]
    assert io.load(path).means[0].tolist() == [mean[0], -mean[2], mean[1]]
    with pytest.raises(OptionError, match="levels 0 to 1; level 2"):
        io.load(path, level=2)


def test_a_level_is_described(scan):
    path, _ = scan
    info = io.inspect(path)
    assert (info.format, info.splats, info.sh_degree) == ("lcc2", 43, 1)
    with io.open(path) as source:
        assert (source.levels, source.environment) == ((43, 16), 4)
        assert [file.stem for file in source.files] == ["meta", "0", "0", "env"]
        assert info.file_bytes == sum(file.stat().st_size for file in source.files)


def test_rows_read_in_parts_equal_those_of_the_whole(scan, monkeypatch):
    path, _ = scan
    whole = io.load(path)
    monkeypatch.setattr("nanogs.io.lcc.octree.BLOCK_ROWS", 5)
    with in_parts(path) as read:
        for start in range(0, 43, 7):
            for stop in range(start, 44):
                assert model_bytes(read(start, stop)) == model_bytes(whole[start:stop])
    assert_same(io.load(path), whole)


@pytest.mark.parametrize("level", [0, 1])
def test_splat_transform_reads_the_same(scan, tmp_path, level):
    """Except for the environment, which it leaves out of a .ply."""
    path, _ = scan
    out = tmp_path / "out.ply"
    splat_transform("-L", level, path, out)
    theirs, ours = io.load(out), io.load(path, level=level)
    assert len(ours) == len(theirs) + 4
    ours = ours[: len(theirs)]
    assert np.allclose(ours.means, theirs.means, atol=1e-6)
    assert ours.opacity_logits == pytest.approx(theirs.opacity_logits, abs=1e-5)
    assert np.abs(ours.sh - theirs.sh).max() < 1e-5
    expected = covariances(theirs)
    assert np.allclose(covariances(ours), expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())


def test_commands_read_lcc2(scan, tmp_path):
    path, _ = scan
    shown = run("info", path.parent)
    assert shown.returncode == 0, shown.stderr
    assert "0: 43, 1: 16 splats" in shown.stdout
    result = run("convert", path, tmp_path / "a.ply", "--level", "1")
    assert result.returncode == 0, result.stderr
    assert len(io.load(tmp_path / "a.ply")) == 16
    result = run("simplify", path, tmp_path / "b.spz", "-r", "0.5", "--preset", "fast")
    assert result.returncode == 0, result.stderr
    assert len(io.load(tmp_path / "b.spz")) == 22
    refused = run("convert", path, tmp_path / "b.lcc2")
    assert refused.returncode == 2
    assert "does not write this format" in refused.stderr


def test_blocks_give_the_result_of_the_same_model_as_ply(scan, tmp_path):
    path, _ = scan
    nanogs.save(io.load(path), tmp_path / "whole.ply")
    results = []
    for name in (path, tmp_path / "whole.ply"):
        out = tmp_path / f"{name.suffix}.out.ply"
        nanogs.simplify_blocks(name, out, ratio=0.5, preset="fast", block=20)
        results.append(out.read_bytes())
    assert results[0] == results[1]


def test_commas_may_follow_last_entries(scene):
    """Not in names, of which one here looks as if it had one."""
    (scene.parent / "a" / "1.sog").rename(scene.parent / "a" / "1,}.sog")
    text = scene.read_text().replace("a/1.sog", "a/1,}.sog").replace("]", " , ]")
    expected = io.load(scene)
    scene.write_text(text.replace("}}", ",},\n}"))
    with pytest.raises(json.JSONDecodeError):
        json.loads(scene.read_text())
    assert_same(io.load(scene), expected)
    assert len(io.load(scene, level=1)) == 16


def test_the_environment_may_be_missing(scene):
    (scene.parent / "env.sog").unlink()
    with io.open(scene) as source:
        assert (source.count, source.levels, source.environment) == (39, (39, 12), 0)


def test_files_without_stated_counts_are_read_whole(scene):
    expected = io.load(scene)
    fine = [lcc2files.node(0, None), lcc2files.node(0, 20), lcc2files.node(2, None)]
    files = ["./a/0.sog", "a/1.sog", "b/./0.sog", "/env.sog"]
    tree_of(scene, [{"child": fine}, lcc2files.node(1, 12)], splatFiles=files)
    assert_same(io.load(scene), expected)


def test_nodes_without_splats_and_of_the_environment_add_nothing(scene):
    expected = io.load(scene)
    fine = [lcc2files.node(index, count) for index, count in ((0, 30), (2, 9), (1, 0), (3, 4))]
    tree_of(scene, [lcc2files.node(1, 12, fine)])
    assert_same(io.load(scene), expected)


def test_extension_records_are_left_out_with_a_note(tmp_path):
    path, _ = lcc2files.model(tmp_path / "scan", np.random.default_rng(3), ".spz")
    element = ExtraElement("spz_record_12340001", np.frombuffer(b"hello", [("byte", "u1")]))
    part = replace(random_splats(30, degree=1), elements=[element])
    nanogs.save(part, path.parent / "a" / "0.spz", overwrite=True)
    note = "Extension records of its .spz files were left out: spz_record_12340001."
    assert io.load(path).notes == (note,)
    assert io.inspect(path).elements == ()
    assert io.load(path, level=1).notes == ()


def test_older_files_may_name_their_parts_with_the_suffix(tmp_path):
    path, _ = lcc2files.model(tmp_path / "scan", np.random.default_rng(3), old=True)
    expected = io.load(path)
    files = ["/a/0.sog", "/a/1.sog", "/b/0", "/env.sog"]
    change(path, root=json.loads(path.read_text())["root"] | {"files": files})
    assert_same(io.load(path), expected)


def test_notes_on_the_parts_are_kept(tmp_path):
    path, _ = lcc2files.model(tmp_path / "scan", np.random.default_rng(3), ".spz")
    part = replace(random_splats(30, degree=1), render_mode=RenderMode.MIP)
    nanogs.save(part, path.parent / "a" / "0.spz", overwrite=True)
    [note] = io.load(path).notes
    assert note.startswith("Its parts have different render modes (default, mip)")


FINE, COARSE = [{"child": [lcc2files.node(0, 30)]}], [lcc2files.node(0, 30)]
REFUSED = {
    "no json": (lambda path: path.write_text("{,"), "is no JSON"),
    "no levels": (lambda path: change(path, totalLevels=None), "totalLevels must be an integer"),
    "kind": (lambda path: change(path, splatType=".ply"), 'must be ".sog" or ".spz"'),
    "no root": (lambda path: change(path, root=None), "root must be a JSON object"),
    "no files": (lambda path: tree_of(path, FINE, splatFiles=[]), "names no file"),
    "outside": (lambda path: tree_of(path, FINE, splatFiles=["../a.sog"]), "below its own folder"),
    "twice": (lambda path: tree_of(path, FINE, splatFiles=["a", "/a"]), "names a file twice"),
    "child": (lambda path: tree_of(path, 7), "child must be a list"),
    "node": (lambda path: tree_of(path, [7]), "child must be a JSON object"),
    "index": (lambda path: tree_of(path, [lcc2files.node(4, 1)]), "must be an integer from 0 to 3"),
    "count": (lambda path: tree_of(path, [lcc2files.node(0, -1)]), "must be an integer from 0"),
    "empty": (lambda path: tree_of(path, COARSE), "has no splats of level 0"),
    "deep": (lambda path: tree_of(path, [{"child": FINE}]), "has splats below its 2 levels"),
    "other count": (
        lambda path: tree_of(path, [{"child": [lcc2files.node(0, 29)]}]),
        "has 30 splats, but meta.lcc2 says 29",
    ),
    "no file": (lambda path: (path.parent / "a" / "0.sog").unlink(), "0.sog: no such file"),
    "another format": (lambda path: change(path, splatType=".spz"), "is no .spz file"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_damaged_files_are_refused(scene, name):
    damage, words = REFUSED[name]
    damage(scene)
    with pytest.raises(FormatError, match=words) as caught:
        io.load(scene)
    assert "; " in str(caught.value)
