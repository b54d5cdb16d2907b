"""`--render-mode`: overriding the render mode that the file of a model names."""

import io as streams
import json
from dataclasses import replace

import numpy as np
import pytest

import nanogs
from builders import model_bytes, random_splats
from launch import run
from nanogs.bench.worker import Job, do_job
from nanogs.errors import OptionError
from nanogs.io import registry
from nanogs.io.limits import lost_mode
from nanogs.memory_estimates import info_bytes, streaming_bytes
from nanogs.splats import RenderMode
from nanogs.views.automatic import automatic_cameras
from nanogs.views.plan import LEAST
from nanogs.views.streamed import drawable, renderings
from viewer_bundle import require_bundle

DEFAULT, MIP = RenderMode.DEFAULT, RenderMode.MIP
OTHER = {DEFAULT: MIP, MIP: DEFAULT}
READABLE = [
    known.suffix
    for known in registry.formats()
    if known.writable and known.readable and not known.write_folder
]


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """One model in two files: rightly tagged as default, and wrongly as mip, as trainers do it."""
    folder = tmp_path_factory.mktemp("models")
    model = random_splats(900, degree=1, seed=4)
    nanogs.save(model, folder / "right.ply")
    wrong = replace(model, render_mode=MIP, comments=["antialiased 1", "of a trainer"])
    nanogs.save(wrong, folder / "wrong.ply")
    nanogs.save(replace(model, comments=["of a trainer"]), folder / "right.ply", overwrite=True)
    return folder / "right.ply", folder / "wrong.ply"


def run_json(*arguments):
    """Run the command and return its JSON."""
    result = run(*arguments, "--json")
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def has_override_note(notes):
    return any("as requested" in note for note in notes)


@pytest.mark.parametrize("file_mode", [DEFAULT, MIP], ids=str)
@pytest.mark.parametrize("suffix", READABLE)
def test_every_format_can_be_read_in_another_render_mode(tmp_path, suffix, file_mode):
    model = replace(random_splats(40, degree=1), render_mode=file_mode)
    path = tmp_path / f"a{suffix}"
    nanogs.save(model, path)
    plain = nanogs.load(path)
    if plain.render_mode is not file_mode:  # the format has no tag
        assert file_mode is MIP
        assert lost_mode(model, suffix)
        return
    with nanogs.open(path, render_mode=OTHER[file_mode].value) as source:
        assert source.info.render_mode is OTHER[file_mode]
        columns = nanogs.open(path).columns
        comments = source.columns.comments
        assert source.columns == replace(
            columns, render_mode=OTHER[file_mode].value, comments=comments
        )
        parts = [source.read(3, 9), source.take(np.array([7, 2])), source.load(), *source.blocks(9)]
        assert {part.render_mode for part in parts} == {OTHER[file_mode]}
        assert all(has_override_note(part.notes) for part in parts)
        assert model_bytes(parts[1]) == model_bytes(plain[[7, 2]])
        with nanogs.open(path) as same:  # and the memory estimates are the same
            assert info_bytes(source) == info_bytes(same)
            assert streaming_bytes(source) == streaming_bytes(same)
    loaded = nanogs.load(path, render_mode=OTHER[file_mode].value)
    assert model_bytes(loaded) == model_bytes(plain)
    unchanged = nanogs.load(path, render_mode=file_mode.value)
    assert unchanged.notes == plain.notes, "there is nothing to tell where the file says so too"


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".spz", ".sog", ".npz", ".glb"])
def test_converted_files_have_the_requested_render_mode(tmp_path, models, suffix):
    right, wrong = models
    for mode, source in ((DEFAULT, wrong), (MIP, right)):
        path = tmp_path / f"{mode}{suffix}"
        report = run_json("convert", source, path, "--render-mode", mode)
        assert report["render_mode"] == mode
        assert has_override_note(report["notes"])
        assert nanogs.load(path).render_mode is mode
        assert path.read_bytes() == _converted(tmp_path, models[mode is MIP], suffix)


def _converted(tmp_path, source, suffix):
    path = tmp_path / f"plain{suffix}"
    model = nanogs.load(source)
    if model.render_mode is MIP:  # our own tag replaces the trainer's
        model = replace(model, comments=[c for c in model.comments if "antialiased" not in c])
    nanogs.save(model, path, overwrite=True)
    return path.read_bytes()


@pytest.mark.parametrize("blocks", [False, True])
def test_simplify_gives_the_result_of_the_rightly_tagged_file(tmp_path, models, blocks):
    right, wrong = models
    one, two = tmp_path / "one.ply", tmp_path / "two.ply"
    options = ["--preset", "fast", "--ratio", "0.3", "--measure"]
    options += ["--job", tmp_path / "job"] * blocks
    expected = run_json("simplify", right, one, *options)
    found = run_json("simplify", wrong, two, *options, "--render-mode", "default")
    assert bool(found["blocks"]) == blocks
    assert two.read_bytes() == one.read_bytes()
    assert found["judged"] == expected["judged"]
    assert has_override_note(found["notes"])
    assert not has_override_note(expected["notes"])


def test_a_job_is_not_continued_under_another_render_mode(tmp_path, models):
    right, _ = models
    options = {"preset": "fast", "ratio": 0.3, "block": 300, "threads": 1}

    def crash(step):
        if step.fraction > 0.3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        nanogs.simplify_blocks(right, tmp_path / "a.ply", progress=crash, **options)
    with pytest.raises(nanogs.errors.OutputError, match="render_mode"):
        nanogs.simplify_blocks(right, tmp_path / "a.ply", resume=True, render_mode="mip", **options)


def test_files_with_different_tags_are_joined_only_in_a_requested_mode(tmp_path, models):
    out, options = tmp_path / "a.ply", ["--join", "--preset", "fast", "-r", "0.5"]
    refused = run("simplify", *models, out, *options)
    assert refused.returncode == 2
    assert "--render-mode" in refused.stderr
    for more in ([], ["--job", tmp_path / "job"]):
        run_json("simplify", *models, out, *options, *more, "--render-mode", "mip", "-w")
        assert nanogs.load(out).render_mode is MIP


def test_lod_gives_the_levels_of_the_rightly_tagged_file(tmp_path, models):
    right, wrong = models
    options = ["--levels", "0.5,0.2", "--preset", "fast"]
    run_json("lod", right, tmp_path / "one", *options)
    run_json("lod", wrong, tmp_path / "two", *options, "--render-mode", "default")
    for level in ("level_0.ply", "level_1.ply"):
        assert (tmp_path / "two" / level).read_bytes() == (tmp_path / "one" / level).read_bytes()


def test_render_gives_the_image_of_the_rightly_tagged_file(tmp_path, models):
    right, wrong = models
    for name, options in {
        "right": [right],
        "wrong": [wrong],
        "asked": [wrong, "--render-mode", "default"],
    }.items():
        source, *more = options
        report = run_json("render", source, tmp_path / f"{name}.png", "--pixels", "64", *more)
        assert has_override_note(report["notes"]) == (name == "asked")
    pictures = {path.stem: path.read_bytes() for path in tmp_path.glob("*.png")}
    assert pictures["asked"] == pictures["right"] != pictures["wrong"]


def test_streamed_renders_use_the_requested_render_mode(models):
    right, wrong = models
    [camera] = automatic_cameras(nanogs.load(right), 1, width=48, height=48)
    with nanogs.open(wrong, render_mode="default") as source:
        [found] = renderings(drawable(source, LEAST), [camera])
    [expected] = nanogs.render(right, cameras=camera)
    assert found.shown().tobytes() == expected.tobytes()


def test_compare_draws_all_models_in_the_requested_mode(models):
    right, wrong = models
    options = ["--views", "2", "--sizes", "64"]
    tagged = run_json("compare", right, wrong, *options)
    overridden = run_json("compare", right, wrong, *options, "--render-mode", "default")
    assert tagged["models"][0]["psnr"] < 60
    assert overridden["models"][0]["psnr"] == "inf"
    assert [note for note in overridden["notes"] if note.startswith("wrong.ply: The render mode")]


def test_refit_and_view_use_the_requested_render_mode(tmp_path, models, small_views):
    from nanogs.view.bundle import is_built

    right, wrong = models
    fitted = run_json(
        "refit", right, wrong, tmp_path / "a.ply", "--render-mode", "default", "--views", "2",
        "--pixels", "32", "--rounds", "1",
    )  # fmt: skip
    assert nanogs.load(tmp_path / "a.ply").render_mode is DEFAULT
    assert fitted["notes"][0].startswith(f"{wrong}: The render mode is default, as requested")
    if is_built():
        report = run_json(
            "view", right, tmp_path / "a.ply", "-o", tmp_path / "a.html", "--no-open",
            "--render-mode", "mip", "--no-psnr",
        )  # fmt: skip
        assert all(has_override_note(model["notes"]) for model in report["models"])


@pytest.mark.parametrize(
    "words",
    [
        "info {wrong}",
        "convert {wrong} out.spz",
        "simplify {wrong} out.ply -r 0.5 --preset fast",
        "lod {wrong} levels --preset fast",
        "refit {right} {wrong} out.ply --views 2 --pixels 32 --rounds 1",
        "render {wrong} out --views 1 --pixels 32",
        "compare {right} {wrong} --views 1 --pixels 32",
        "view {wrong} -o out.html --no-open",
    ],
)
def test_every_command_prints_the_notes_on_its_inputs(tmp_path, models, words):
    if words.startswith("view"):
        require_bundle()
    arguments = words.format(right=models[0], wrong=models[1]).split()
    result = run(*arguments, "--render-mode", "default", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    noted = [line for line in result.stderr.splitlines() if line.startswith("note: ")]
    assert any("The render mode is default, as requested;" in line for line in noted), noted


def test_2dgs_models_can_be_read_as_default_but_not_as_mip(tmp_path, models):
    flat = tmp_path / "flat.ply"
    nanogs.save(replace(nanogs.load(models[0]), render_mode="2dgs"), flat)
    refused = run("convert", flat, tmp_path / "a.spz", "--render-mode", "mip")
    assert refused.returncode == 2
    assert "2dgs" in refused.stderr
    assert not (tmp_path / "a.spz").exists()
    refused = run("simplify", flat, tmp_path / "a.ply", "-r", "0.5", "--render-mode", "mip")
    assert refused.returncode == 2
    run_json("convert", flat, tmp_path / "a.ply", "--render-mode", "default")
    assert nanogs.load(tmp_path / "a.ply").render_mode is DEFAULT


def test_unknown_render_modes_are_refused_everywhere(tmp_path, models):
    right, _ = models
    refused = run("convert", right, tmp_path / "a.ply", "--render-mode", "2dgs")
    assert refused.returncode == 2
    file = streams.BytesIO(right.read_bytes())
    for call in (
        lambda: nanogs.open(right, render_mode="2dgs"),
        lambda: nanogs.load(file, render_mode="antialiased", format=".ply"),
        lambda: nanogs.convert(right, tmp_path / "a.spz", render_mode=""),
        lambda: nanogs.simplify_blocks(right, tmp_path / "a.ply", ratio=0.5, render_mode="MIP"),
        lambda: nanogs.info(right, render_mode="flat"),
    ):
        with pytest.raises(OptionError, match="`render_mode` must be"):
            call()
    assert not list(tmp_path.iterdir())


def test_file_objects_are_read_in_the_requested_render_mode(models):
    file = streams.BytesIO(models[1].read_bytes())
    assert nanogs.load(file, format=".ply", render_mode="default").render_mode is DEFAULT


@pytest.mark.parametrize(
    ("suffix", "location"),
    [
        (".ply", 'the comment "antialiased 1"'),
        (".spz", "the antialiased flag of its header, 1"),
        (".sog", '"model" in its meta.json'),
        (".npz", "its array render_mode"),
        (".glb", "SplatRenderMode in the extras of its splats"),
    ],
)
def test_info_says_where_the_tag_is(tmp_path, models, suffix, location):
    path = models[1]
    if suffix != ".ply":
        path = tmp_path / f"a{suffix}"
        nanogs.save(nanogs.load(models[1]), path)
    assert run_json("info", path)["render_tag"] == location
    overridden = run("info", path, "--render-mode", "default")
    assert "default, by the request" in overridden.stdout
    assert "as requested" in overridden.stderr
    assert "no tag" in run("info", models[0]).stdout


@pytest.mark.parametrize(
    ("flags", "location"),
    [
        ((), "the antialiased flag of its header, 1"),
        (("--plain",), "SplatRenderMode in the extras of its splats"),
    ],
)
def test_info_says_where_the_tag_of_3d_tiles_is(tmp_path, models, flags, location):
    """Compressed tiles have it in the SPZ data that they contain."""
    tiles = tmp_path / "tiles" / "tileset.json"
    assert run("lod", models[1], tiles, "--preset", "fast", *flags).returncode == 0
    for path in (tiles, tiles.with_name("0_0.glb")):
        found = run_json("info", path)
        assert (found["render_mode"], found["render_tag"]) == ("mip", location)


def test_a_tag_in_obj_info_is_read_with_parts_and_with_the_whole(tmp_path, models):
    path = tmp_path / "a.ply"
    start, mark, rest = models[0].read_bytes().partition(b"element vertex")
    path.write_bytes(start + b"obj_info SplatRenderMode: mip\n" + mark + rest)
    with nanogs.open(path) as source:
        assert source.columns.render_mode == source.read(0, 3).render_mode == MIP
        assert source.info.render_mode is source.load().render_mode is MIP


def test_bench_uses_the_requested_render_mode(models, tmp_path):
    """For originals, results and files of other tools; the table says so."""
    right, wrong = models
    nanogs.simplify_blocks(wrong, tmp_path / "small.ply", ratio=0.1, preset="fast")
    nanogs.convert(tmp_path / "small.ply", tmp_path / "plain.ply", render_mode="default")
    options = ("--ratios", "0.1", "--methods", "random", "--pixels", "48", "--views", "2",
               "--external", f"other={tmp_path}/small.ply",
               "--external", f"plain={tmp_path}/plain.ply")  # fmt: skip

    def rows(model, *more):
        found = run_json("bench", f"--scene=s={model}", *options, *more)["rows"]
        return [(row["method"], row["splats"], row["psnr"], row["ssim"]) for row in found]

    overridden = rows(wrong, "--render-mode", "default")
    assert [row[0] for row in overridden] == ["original", "random", "other", "plain"]
    assert overridden[2][1:] == overridden[3][1:]
    assert overridden == rows(right, "--render-mode", "default")
    as_tagged = rows(wrong)
    assert overridden[1][2] != as_tagged[1][2]
    assert as_tagged[2][2] != as_tagged[3][2]
    printed = run("bench", f"--scene=s={wrong}", *options, "--render-mode", "default")
    assert "All models are drawn as default, whatever their files say." in printed.stdout


@pytest.mark.parametrize("size", [None, 20_000])
def test_bench_methods_get_the_model_in_the_requested_render_mode(models, tmp_path, size):
    _, wrong = models
    job = Job(wrong, "fast", 0.1, tmp_path / "a.ply", size=size, render_mode="default")
    assert do_job(job).error == ""
    assert nanogs.load(tmp_path / "a.ply").render_mode is DEFAULT


def test_only_2dgs_is_explained_as_another_kind_of_model(models):
    refused = '`render_mode` must be "default" or "mip", not '
    for mode, why in (("2dgs", ": it is not another way to draw a model,"), ("mpi", r"\.$")):
        with pytest.raises(OptionError, match=f"^{refused}'{mode}'{why}"):
            nanogs.open(models[0], render_mode=mode)
