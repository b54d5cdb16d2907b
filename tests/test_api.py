"""The Python interface: public names, paths in place of models, scores and pictures."""

import dataclasses
import inspect
import json
import pickle
import pkgutil
import subprocess
import sys
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

import nanogs
from builders import cloud_pair, random_splats
from launch import run
from nanogs.clock import StageClock
from nanogs.errors import FormatError, ModelError, OptionError
from nanogs.pipeline.files import _around
from nanogs.pipeline.options import presets
from nanogs.raster.rendering import prepare
from nanogs.scoring.scores import EXTRA_METRICS
from nanogs.views.automatic import automatic_cameras
from nanogs.views.cameras import cameras_for
from strategies import assert_same

SMALL = {"views": 2, "pixels": (48, 32)}


@pytest.fixture(scope="module")
def pair():
    return cloud_pair()


@pytest.fixture(scope="module")
def files(pair, tmp_path_factory):
    """The two models as files."""
    folder = tmp_path_factory.mktemp("pair")
    paths = folder / "large.ply", folder / "small.spz"
    for model, path in zip(pair, paths, strict=True):
        nanogs.save(model, path)
    return paths


def python(code, *, exit_code=0):
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == exit_code, result.stderr
    return result.stdout


# ---- names ----------------------------------------------------------------------------------


def test_importing_nanogs_imports_no_heavy_modules():
    python(
        "import sys, nanogs\n"
        "heavy = {'numpy', 'numba', 'scipy', 'PIL', 'rich', 'typer', 'jinja2', 'nanogs.splats'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
        "nanogs.Splats, nanogs.info, nanogs.presets, nanogs.compare, nanogs.render\n"
        "assert 'numba' not in sys.modules\n"
    )


@pytest.mark.parametrize(
    "first", ["", "nanogs.simplify, nanogs.refit, nanogs.render, nanogs.compare"]
)
def test_every_module_can_be_imported_by_its_name(first):
    # Modules of `nanogs.card` import Warp, which is optional; `tests/test_layers.py` checks these.
    left_out = "('__main__',)" if find_spec("warp") else "('__main__', *card)"
    python(
        "import importlib, pkgutil\n"
        "import nanogs\n"
        f"{first}\n"
        "found = list(pkgutil.walk_packages(nanogs.__path__, 'nanogs.'))\n"
        "card = [one.name for one in found if one.name.startswith('nanogs.card.')]\n"
        f"names = [one.name for one in found if not one.name.endswith({left_out})]\n"
        "assert 'nanogs.pipeline.options.presets' in names and len(names) > 200\n"
        "for name in names:\n"
        "    exec(f'import {name} as one\\nimport {name}')\n"
        "    assert one is importlib.import_module(name) is pkgutil.resolve_name(name)\n"
        "    assert one is eval(name), name\n"
    )


def test_completion_offers_public_names_alone():
    offered = {name for name in dir(nanogs) if not name.startswith("_")}
    public = {name for name in nanogs.__all__ if not name.startswith("_")}
    assert public <= offered
    assert all(inspect.ismodule(getattr(nanogs, name)) for name in offered - public)
    assert "import_module" not in offered


def test_no_function_has_the_name_of_a_module():
    modules = {one.name for one in pkgutil.iter_modules(nanogs.__path__)}
    public_names = {name for name in nanogs.__all__ if not inspect.ismodule(getattr(nanogs, name))}
    assert not public_names & modules


def test_functions_have_the_usual_attributes_and_can_be_pickled():
    for name in ("compare", "refit", "render", "simplify"):
        function = getattr(nanogs, name)
        assert function.__name__ == function.__qualname__ == name
        assert function.__module__.endswith(".api")
        assert "Args:" in inspect.getdoc(function)
        assert "threads" in inspect.signature(function).parameters
        assert pickle.loads(pickle.dumps(function)) is function
    assert nanogs.info.__name__ == "info"
    assert inspect.isfunction(nanogs.info)


def test_presets_can_be_read_and_not_changed():
    assert list(nanogs.presets) == ["default", "fast", "best", "paper"]
    assert nanogs.presets["paper"].k == 16
    with pytest.raises(TypeError):
        nanogs.presets["own"] = nanogs.presets["fast"]
    with pytest.raises(AttributeError):
        nanogs.presets["fast"].k = 3


def test_every_public_name_is_documented_in_the_reference():
    reference = Path(__file__).resolve().parents[1] / "docs" / "reference"
    text = "".join(page.read_text() for page in reference.glob("*.md"))
    for name in set(nanogs.__all__) - {"__version__"}:
        assert f"nanogs.{name}\n" in text or f"`nanogs.{name}`" in text, name


def test_info_takes_a_path_and_describes_the_file(files):
    found = nanogs.info(str(files[0]))
    assert (found.file.splats, found.file.sh_degree, found.nonfinite) == (400, 1, 0)
    with pytest.raises(FormatError, match="no such file"):
        nanogs.info("missing.ply")


@pytest.mark.parametrize("read", [nanogs.load, nanogs.info])
def test_a_name_that_is_too_long_for_the_system_is_no_file(read):
    with pytest.raises(FormatError, match="no such file or folder"):
        read(1000 * "a")


# ---- paths in place of models ---------------------------------------------------------------


def test_paths_are_accepted_in_place_of_models(files):
    large, small = files
    for path in (large, str(large)):
        from_path, _ = nanogs.simplify(path, ratio=0.25, preset="fast")
        assert_same(from_path, nanogs.simplify(nanogs.load(large), ratio=0.25, preset="fast")[0])
    levels = [len(model) for model, _ in nanogs.levels(large, [0.5, 0.1], preset="fast")]
    assert levels == [200, 40]
    options = {"parameters": nanogs.RefitParameters(views=2, steps=2, size=32)}
    fitted, _ = nanogs.refit(large, small, **options)
    assert_same(fitted, nanogs.refit(nanogs.load(large), nanogs.load(small), **options)[0])


def test_a_file_size_may_be_a_number_or_text(pair):
    options = {"format": ".splat", "preset": "fast"}
    small, report = nanogs.simplify(pair[0], size="3.2kB", **options)
    assert (len(small), report.asked_size) == (100, 3200)
    assert len(nanogs.simplify(pair[0], size=3200, **options)[0]) == 100
    with pytest.raises(OptionError, match=r"like 20MB.*not 'a lot'"):
        nanogs.simplify(pair[0], size="a lot")


def test_a_memory_limit_may_be_a_number_or_text(files, tmp_path):
    contents = []
    for index, limit in enumerate((2_000_000_000, "2GB")):
        report = nanogs.simplify_blocks(
            files[0], tmp_path / f"{index}.ply", ratio=0.5, preset="fast", max_memory=limit
        )
        contents.append((tmp_path / f"{index}.ply").read_bytes())
    assert contents[0] == contents[1]
    assert report.achieved_count == 200
    with pytest.raises(OptionError, match="not 'much'"):
        nanogs.simplify_blocks(files[0], tmp_path / "c.ply", ratio=0.5, max_memory="much")


def test_invalid_options_are_refused_before_a_file_is_read():
    with pytest.raises(OptionError, match="ratio"):
        nanogs.simplify("missing.ply", ratio=2)
    with pytest.raises(OptionError, match="There is no preset"):
        nanogs.levels("missing.ply", [0.5], preset="fst")


@pytest.mark.parametrize(
    "call",
    [
        lambda given: nanogs.simplify(given, ratio=0.5),
        lambda given: nanogs.levels(given, [0.5]),
        lambda given: nanogs.refit(given, given),
        nanogs.render,
        lambda given: nanogs.compare(given, given),
    ],
)
def test_an_argument_that_is_no_model_is_refused_with_its_type(call):
    with pytest.raises(ModelError, match=r"must be Splats, a Source or a path, not ndarray"):
        call(np.zeros((3, 3)))
    with pytest.raises(ModelError, match=r"not dict; .*Splats\.from_gsplat of a dictionary"):
        call(random_splats(3).to_gsplat())
    with pytest.raises(FormatError, match=r"missing\.ply: no such file"):
        call("missing.ply")


@pytest.mark.parametrize(
    "call",
    [
        nanogs.io.losses,
        nanogs.io.encoded_bytes,
        nanogs.io.round_trip,
        nanogs.save,
    ],
)
def test_functions_of_io_refuse_what_is_no_model(tmp_path, call):
    for suffix in (".spz", ".ply"):
        path = tmp_path / f"out{suffix}"
        with pytest.raises(
            ModelError, match=r"A model is needed, not the path 'a\.ply'; nanogs\.l"
        ):
            call("a.ply", path)
        with pytest.raises(ModelError, match="A model is needed, Splats, not NoneType"):
            call(None, path)
    assert not list(tmp_path.iterdir())


def test_the_message_says_how_to_get_a_model_from_what_was_given(tmp_path):
    both = nanogs.simplify(random_splats(20), ratio=0.5, preset="fast")
    tensors = random_splats(3).to_gsplat()
    for call in (
        lambda given: nanogs.save(given, tmp_path / "a.ply"),
        lambda given: nanogs.render(given, "orbit"),
        lambda given: nanogs.simplify(given, ratio=0.5),
    ):
        with pytest.raises(ModelError, match=r"not tuple; .*`small, report = nanogs\.simplify"):
            call(both)
        with pytest.raises(ModelError, match=r"not dict; .*nanogs\.Splats\.from_gsplat of a"):
            call(tensors)
    with pytest.raises(ModelError, match=r"^The small model must be Splats"):
        nanogs.refit(random_splats(3), None)


def test_a_path_where_a_model_is_needed_is_refused(tmp_path):
    path = tmp_path / "a.ply"
    with pytest.raises(ModelError, match=r"A model is needed, not the path '.*nanogs.load"):
        nanogs.save(str(path), random_splats(3))
    with pytest.raises(ModelError, match="A model is needed, Splats, not NoneType"):
        nanogs.save(None, path)
    grown = nanogs.grow(random_splats(9), preset="fast")
    for call in (
        grown.measure,
        lambda given: nanogs.filters.min_opacity(given, 0.5),
        lambda given: nanogs.frames.change_frame(given, "rdf", "rub"),
        automatic_cameras,
        prepare,
    ):
        with pytest.raises(ModelError, match=r"not the path 'a\.ply'; nanogs\.load\('a\.ply'\)"):
            call("a.ply")
    assert not list(tmp_path.iterdir())


def test_a_misspelt_argument_is_named_with_the_one_that_was_meant(pair, files, tmp_path):
    for call in (
        lambda **given: nanogs.simplify(pair[0], **given),
        lambda **given: nanogs.simplify_blocks(files[0], tmp_path / "a.ply", **given),
    ):
        with pytest.raises(OptionError, match=r"'ration' \(did you mean 'ratio'\?\)"):
            call(ration=0.1)
    with pytest.raises(OptionError, match=r"'treads' \(did you mean 'threads'\?\)"):
        nanogs.levels(pair[0], [0.5], treads=1)
    with pytest.raises(OptionError, match="no parameter 'ratio'; choose from k"):
        nanogs.grow(pair[0], ratio=0.5)


def test_every_argument_can_be_meant():
    calls = nanogs.simplify, nanogs.simplify_blocks, nanogs.grow, nanogs.levels, nanogs.write_levels
    known = {
        argument.name
        for call in calls
        for argument in inspect.signature(call).parameters.values()
        if argument.kind is argument.KEYWORD_ONLY
    }
    assert sorted(presets._ARGUMENTS) == sorted(known)


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        ({"count": 10.0}, r"count must be a whole number, not 10\.0"),
        ({"count": True}, "count must be a whole number"),
        ({"ratio": "0.1"}, "`ratio` must be a number, not '0.1'"),
        ({"psnr": "30"}, "`psnr` must be a number"),
    ],
)
def test_a_target_that_is_no_number_is_refused(pair, goal, message):
    with pytest.raises(OptionError, match=message):
        nanogs.simplify(pair[0], preset="fast", **goal)


@pytest.mark.parametrize("goal", [{"count": np.int64(9)}, {"ratio": np.float32(0.25)}])
def test_a_report_with_a_numpy_target_can_be_written_as_json(pair, goal):
    _, report = nanogs.simplify(pair[0], preset="fast", **goal)
    assert json.loads(json.dumps(report.to_dict()))["achieved_count"] == report.achieved_count


def test_ratios_in_single_precision_stand_for_the_decimals_that_they_show(pair):
    shares = np.array([0.3, 0.1], np.float32)
    sizes = [len(small) for small, _ in nanogs.levels(pair[0], shares, preset="fast")]
    assert sizes == [120, 40]
    _, report = nanogs.simplify(pair[0], ratio=np.float32(0.1), preset="fast")
    assert (report.achieved_count, report.asked_ratio) == (40, 0.1)


def test_views_may_be_named_or_given_and_are_refused_where_unused(pair, files, tmp_path):
    quick = {"view_size": 64, "views": 4, "further": 0, "around": 0, "steps": 1}
    _, named = nanogs.simplify(pair[0], count=9, cameras="orbit", **quick)
    cameras = cameras_for(pair[0], "orbit", count=4, width=64, height=64, split="fit")
    _, with_cameras = nanogs.simplify(pair[0], count=9, cameras=cameras, **quick)
    assert named.fit.fit_views == with_cameras.fit.fit_views
    assert named.shown == pytest.approx(with_cameras.shown, rel=0.2)
    with pytest.raises(OptionError, match="or at least one nanogs"):
        nanogs.simplify(pair[0], count=9, cameras=[])
    for views in ({"cameras": "roam"}, {"cameras": cameras}):
        with pytest.raises(OptionError, match="renders nothing here"):
            nanogs.simplify(pair[0], count=9, preset="fast", **views)
        with pytest.raises(OptionError, match="renders nothing here"):
            list(nanogs.levels(pair[0], [0.5], preset="fast", **views))
        with pytest.raises(OptionError, match="renders nothing here"):
            nanogs.write_levels(pair[0], tmp_path / "l", [0.5], preset="fast", **views)
    out = tmp_path / "out.ply"
    for views in ({"cameras": "roam"}, {"up": (0, 0, 1)}):
        with pytest.raises(OptionError, match="renders nothing here"):
            nanogs.simplify_blocks(files[0], out, count=9, preset="fast", **views)
    nanogs.simplify_blocks(files[0], out, count=9, preset="fast", cameras="auto")
    nanogs.simplify(pair[0], count=9, preset="fast", cameras="auto")


@pytest.mark.parametrize(
    ("function", "given", "message"),
    [
        ("simplify", {"preset": ["fast"]}, r"no preset \['fast'\] .*; choose one of default, fast"),
        ("simplify", {"format": 3}, "named by its suffix, as '.sog', not 3"),
        ("simplify", {"format": None}, "named by its suffix, as '.sog', not None"),
        ("compare", {"cameras": None}, "or at least one nanogs"),
        ("compare", {"cameras": 3}, "or at least one nanogs"),
        ("compare", {"metrics": None}, "no metric None"),
        ("compare", {"names": 3}, "Give one name for each model, 1 in all, not 3"),
        ("compare", {"names": [3]}, r"Give one name for each model, 1 in all, not \[3\]"),
        ("convert", {"format_options": 3}, "options are a dictionary, as {'bits': 6}, not 3"),
        ("blocks", {"job": 3}, "`job` is a path, not int"),
        ("blocks", {"scratch": ["s"]}, "`scratch` is a path, not list"),
        ("blocks", {"scratch": b"s"}, "`scratch` is a path, not bytes"),
        ("blocks", {"scratch": ""}, "`scratch` is empty; name a place"),
        ("levels", {"job": 3}, "`job` is a path, not int"),
        ("levels", {"suffix": None}, "named by its suffix, as '.sog', not None"),
        ("levels", {"source": b"a"}, "`source` is the name of the model, not b'a'"),
    ],
)
def test_values_of_other_types_are_refused_in_one_sentence(
    pair, files, tmp_path, function, given, message
):
    calls = {
        "simplify": lambda: nanogs.simplify(pair[0], count=9, **given),
        "compare": lambda: nanogs.compare(*pair, views=1, pixels=16, **given),
        "convert": lambda: nanogs.convert(files[0], tmp_path / "a.spz", **given),
        "blocks": lambda: nanogs.simplify_blocks(files[0], tmp_path / "a.ply", count=9, **given),
        "levels": lambda: nanogs.write_levels(pair[0], tmp_path / "l", [0.5], **given),
    }
    with pytest.raises(OptionError, match=message):
        calls[function]()
    assert list(tmp_path.iterdir()) == []


class Tensor:
    """A tensor of another library, which NumPy can convert but not index as its own."""

    def __init__(self, values):
        self.values = np.asarray(values)
        self.ndim = self.values.ndim

    def detach(self):
        return self

    def cpu(self):
        return self

    def item(self):
        return self.values.item()

    def __array__(self, dtype=None, copy=None):
        return self.values.astype(dtype or self.values.dtype)


POSE = np.eye(4) + np.eye(4, k=3) * [0, 0, 0, 0.5]
PINHOLE = {"width": 32, "height": 24, "fx": 30.0, "fy": 30.0, "cx": 16.0, "cy": 12.0}


def test_cameras_of_a_loop_can_share_one_array():
    pose = POSE.copy()
    cameras = []
    for step in range(2):
        pose[2, 3] = step
        cameras.append(nanogs.Camera(**PINHOLE, world_to_camera=pose))
    assert [camera.world_to_camera[2, 3] for camera in cameras] == [0, 1]


def test_cameras_may_be_made_of_lists_and_tensors(pair):
    expected = nanogs.Camera(**PINHOLE, world_to_camera=POSE)
    tensors = {name: Tensor(value) for name, value in PINHOLE.items()}
    cameras = [
        nanogs.Camera(**PINHOLE, world_to_camera=POSE.tolist()),
        nanogs.Camera(**tensors, world_to_camera=Tensor(POSE.astype(np.float32))),
    ]
    for camera in cameras:
        assert camera.position.tolist() == expected.position.tolist()
        assert (
            pickle.loads(pickle.dumps(camera)).intrinsics.tolist() == expected.intrinsics.tolist()
        )
        assert (nanogs.render(pair[0], camera)[0] == nanogs.render(pair[0], expected)[0]).all()


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ({"width": 32.0}, "width of camera 'a' must be a whole number of pixels, not 32.0"),
        ({"fx": "30"}, "fx of camera 'a' must be a number, not '30'"),
        ({"world_to_camera": None}, "must be a .4, 4. array of numbers, not object"),
        ({"world_to_camera": "pose"}, "world_to_camera is the path 'pose', not an array"),
        ({"whole": (1.0, 2.0)}, "whole of camera 'a' must be four numbers"),
        ({"whole": 5.0}, r"whole of camera 'a' must be four numbers, not 5\.0"),
        ({"dilation": "wide"}, "dilation of camera 'a' must be a number, not 'wide'"),
        ({"name": 7}, "name of camera 7 must be text, not 7"),
        ({"lens": "OPENCV"}, "lens of camera 'a' must be a nanogs.raster.lens.Lens"),
    ],
)
def test_a_camera_of_other_types_is_refused_when_it_is_made(field, message):
    with pytest.raises(OptionError, match=message):
        nanogs.Camera(**{**PINHOLE, "world_to_camera": POSE, "name": "a", **field})


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ({"world_to_camera": 2 * POSE}, "is not a rotation and a translation"),
        ({"world_to_camera": POSE.T}, "is not a rotation and a translation"),
        ({"world_to_camera": POSE[:3]}, "a finite 4 x 4"),
        ({"world_to_camera": POSE.ravel()}, "a finite 4 x 4"),
        ({"width": -3}, "1 to 524,272 pixels"),
        ({"dilation": 0}, "focal lengths, near and dilation must be above 0"),
    ],
)
@pytest.mark.parametrize(
    "call",
    [
        nanogs.render,
        nanogs.draw_cost,
        lambda m, cameras: nanogs.compare(m, m, cameras=cameras),
        lambda m, cameras: nanogs.simplify(m, ratio=0.1, cameras=cameras),
        lambda m, cameras: nanogs.refit(m, m, cameras=cameras),
    ],
)
def test_an_invalid_camera_is_refused_before_anything_is_computed(pair, call, field, message):
    camera = nanogs.Camera(**{**PINHOLE, "world_to_camera": POSE, **field})
    with pytest.raises(OptionError, match=message):
        call(pair[0], [camera, camera])


@pytest.mark.parametrize(
    "made",
    [
        nanogs.filters.box((-1, -2, -3), (1, 2, 3.5)),
        nanogs.filters.sphere((0, 0, 1), 2.5),
        nanogs.filters.within((0, 0, 1), 2.5),
        nanogs.filters.beyond((0, 0, 1), 2.5),
        nanogs.filters.opaque_enough(0.1),
        nanogs.filters.in_company(4, 3.0),
    ],
)
def test_filters_can_be_sent_to_other_processes(pair, made):
    again = pickle.loads(pickle.dumps(made))
    assert (again.name, again.argument, again.whole) == (made.name, made.argument, made.whole)
    assert again.plain == made.plain
    assert (again.keep(pair[0]) == made.keep(pair[0])).all()


def test_a_filter_of_the_callers_own_can_be_copied(pair):
    own = nanogs.filters.Filter("own", "", nanogs.Splats.finite, whole=True)
    again = pickle.loads(pickle.dumps(own))
    assert again == own


def test_a_grown_model_shows_its_counts(pair):
    grown = nanogs.grow(pair[0], preset="fast")
    text = f"Grown({len(pair[0]):,} splats, which can become {grown.fewest:,} or more; preset fast)"
    assert repr(grown) == text


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m: nanogs.simplify(m, count=9, preset="fast", k=3.5), "k must be a whole number"),
        (lambda m: nanogs.simplify(m, count=9, preset="fast", growth="a"), "growth must be a num"),
        (lambda m: nanogs.save(m, "o.sog", format_options={"bits": 6.0}), "`bits` must be a whole"),
        (lambda m: nanogs.render(m, "orbit", background="white"), "three finite numbers, not 'whi"),
        (lambda m: nanogs.render(m, background=(0, 128, 255)), r"to 1, not \(0, 128, 255\); divi"),
        (lambda m: nanogs.compare(m, m, background=(-0.1, 0, 0)), "0 to 1, not .*; divide 8-bit"),
        (lambda m: nanogs.levels(m, 0.5), r"such as \[0.5, 0.1\], not 0.5"),
        (lambda m: nanogs.filters.crop_box(m, 1, 2), "three finite numbers x,y,z, not 1"),
        (lambda m: nanogs.filters.crop_box(m, "abc", "d"), "three finite numbers x,y,z, not 'abc'"),
        (lambda m: nanogs.filters.sphere((0, 0, 0), "1"), "above 0 and finite, not '1'"),
        (lambda m: nanogs.filters.sphere((0, 0, 0), -1.0), "above 0 and finite, not -1"),
        (lambda m: nanogs.filters.min_opacity(m, None), "from 0 to 1, not None"),
        (lambda m: nanogs.filters.drop_floaters(m, neighbours=8.0), "a whole number, not 8.0"),
        (lambda m: nanogs.filters.drop_floaters(m, deviations="5"), "above 0 and finite, not '5'"),
        (lambda m: m.with_sh_degree("1"), "SH degree must be a whole number, not '1'"),
        (lambda m: nanogs.filters.apply(m, nanogs.filters.opaque_enough(0.1)), "a list of filters"),
        (lambda m: nanogs.refit(m, m, parameters={"steps": 3}), "must be nanogs.RefitParameters"),
        (lambda m: nanogs.compare(m, m, pixels=0), "of 1 pixel or more, not 0 x 0"),
        (lambda m: nanogs.compare(m, m, pixels=[]), "at least one size, .* not none"),
        (lambda m: nanogs.simplify_blocks(m, "o.ply", ratio=0.1), "path or URL is needed, not Sp"),
        (lambda m: nanogs.simplify_blocks([m], "o.ply", ratio=0.1), "path or URL is needed, not S"),
        (lambda m: nanogs.simplify_blocks(None, "o.ply", ratio=0.1), "is needed, not NoneType"),
        (lambda m: nanogs.simplify(m, ratio=10), "at most 1, not 10 .10 percent are 0.1."),
        (lambda m: nanogs.simplify(m, draw_cost=50), "at most 1, not 50 .50 percent are 0.5."),
        (lambda m: nanogs.simplify(m, ratio=200), "at most 1, not 200.$"),
        (lambda m: nanogs.write_levels(m.means, "levels"), "path or URL is needed, not ndarray"),
        (lambda m: nanogs.write_levels(None, "levels"), "path or URL is needed, not NoneType"),
        (lambda m: nanogs.convert(m, "o.ply"), "not Splats; nanogs.save writes a model into a"),
        (nanogs.info, "path or URL is needed, not Splats"),
        (
            lambda m: nanogs.Place("1", 2.0),
            "longitude of a place must be from -180 to 180 degrees, not '1'",
        ),
        (
            lambda m: nanogs.compare_mixed(m, "lod-meta.json", budget="5"),
            "1 splat or more, not '5'",
        ),
        (
            lambda m: nanogs.write_levels(
                m, "o", [1], layout="streamed sog", environment_ratio="1", preset="fast"
            ),
            "above 0 and at most 1, not '1'",
        ),
    ],
)
def test_an_invalid_argument_is_refused_in_one_sentence(pair, call, message):
    with pytest.raises(OptionError, match=message):
        call(pair[0])


@pytest.mark.parametrize("several", [np.array, iter, tuple])
def test_ratios_may_be_an_array_an_iterator_or_a_tuple(pair, files, tmp_path, several):
    ratios = [0.5, 0.1]
    levels = [len(small) for small, _ in nanogs.levels(pair[0], several(ratios), preset="fast")]
    assert levels == [200, 40]
    folder = tmp_path / "levels"
    manifest, _ = nanogs.write_levels(files[0], folder, several(ratios), preset="fast")
    assert [level.ratio for level in manifest.levels] == ratios


def test_paths_of_a_scene_may_be_an_iterator(files, tmp_path):
    manifest, _ = nanogs.write_levels(iter([files[0]]), tmp_path / "levels", preset="fast")
    assert manifest.levels[0].count == len(nanogs.load(files[0]))


@pytest.mark.parametrize("block", [None, 300])
def test_filters_may_be_an_iterator(files, tmp_path, block):
    low, high = (-1, -1, -1), (0.2, 1, 1)
    left = len(nanogs.filters.crop_box(nanogs.load(files[0]), low, high))
    filters = iter([nanogs.filters.box(low, high)])
    out = tmp_path / "out.ply"
    report = nanogs.simplify_blocks(
        files[0], out, ratio=0.5, preset="fast", filters=filters, block=block
    )
    assert report.filters[0].left == left
    filters = iter([nanogs.filters.box(low, high)])
    assert nanogs.convert(files[0], out, filters=filters, overwrite=True).splats == left


def test_a_job_takes_numpy_numbers_and_a_scratch_folder(files, tmp_path):
    fast = {"preset": "fast", "block": np.int64(300)}
    out, scratch = tmp_path / "out.ply", tmp_path / "scratch"
    report = nanogs.simplify_blocks(files[0], out, count=9, scratch=scratch, **fast)
    assert (report.blocks.blocks, report.blocks.allowed) == (2, 300)
    many = {"layout": "3d tiles", "chunk": np.int64(100), "chunk_min": np.int32(20)}
    folder = tmp_path / "tiles"
    nanogs.write_levels(files[0], folder, [0.5], scratch=scratch, **fast, **many)
    assert (folder / "tileset.json").exists()
    assert sorted(tmp_path.iterdir()) == sorted([out, folder])
    for wrong in ("100", 100.0, True):
        with pytest.raises(
            OptionError, match="The size of a chunk must be a whole number of splats, not"
        ):
            nanogs.write_levels(files[0], tmp_path / "no", [0.5], **fast, **many | {"chunk": wrong})


def test_parameters_may_be_numpy_numbers(pair, files, tmp_path):
    """JSON cannot hold numpy numbers, so reports and the files of a job have to convert them."""
    quick = {"steps": np.int64(1), "views": np.int32(4), "further": np.int64(0)}
    quick |= {"view_size": np.int64(64), "lambda_app": np.float32(0.5)}
    _, report = nanogs.simplify(pair[0], count=9, **quick)
    assert json.loads(json.dumps(report.to_dict()))["parameters"]["lambda_app"] == 0.5
    out, blocks = tmp_path / "out.ply", {"block": 300, "sh_degree": np.int64(0)}
    report = nanogs.simplify_blocks(files[0], out, count=9, **blocks, **quick)
    assert json.loads(json.dumps(report.to_dict()))["parameters"]["steps"] == 1
    parameters = nanogs.RefitParameters(rounds=np.int64(1), steps=np.int64(2), rate=np.float32(0.5))
    _, report = nanogs.refit(*pair, parameters=parameters)
    assert json.loads(json.dumps(report.to_dict()))["parameters"]["rounds"] == 1
    _, report = nanogs.simplify(pair[0], count=9, preset="paper", k=np.int64(4))
    assert json.loads(json.dumps(report.to_dict()))["parameters"]["k"] == 4


def test_threads_may_be_a_numpy_number(pair, files, tmp_path):
    options = {"count": 9, "preset": "fast", "threads": np.int64(1)}
    _, report = nanogs.simplify(pair[0], **options)
    assert json.loads(json.dumps(report.to_dict()))["threads"] == 1
    report = nanogs.simplify_blocks(files[0], tmp_path / "out.ply", block=300, **options)
    assert json.loads(json.dumps(report.to_dict()))["threads"] == 1


def test_invalid_cameras_and_presets_are_refused_in_one_sentence(pair):
    with pytest.raises(OptionError, match=r"or at least one nanogs\.Camera"):
        nanogs.simplify(pair[0], count=9, cameras=5)
    with pytest.raises(OptionError, match="There is no preset None; choose one of"):
        nanogs.simplify(pair[0], count=9, preset=None)


def test_the_suffix_of_levels_may_lack_its_dot(files, tmp_path):
    nanogs.write_levels(files[0], tmp_path / "levels", [0.5], preset="fast", suffix="spz")
    assert (tmp_path / "levels" / "level_0.spz").exists()


def test_filters_that_are_no_list_are_refused(files, tmp_path):
    one, out = nanogs.filters.box((0, 0, 0), (1, 1, 1)), tmp_path / "out.ply"
    for wrong in (one, [nanogs.filters.box], "box", 5):
        with pytest.raises(OptionError, match="must be a list of filters, such as"):
            nanogs.simplify_blocks(files[0], out, ratio=0.5, filters=wrong)
        with pytest.raises(OptionError, match="must be a list of filters, such as"):
            nanogs.convert(files[0], out, filters=wrong)


def test_one_format_or_one_metric_needs_no_list(pair):
    found = nanogs.compare(pair[0], pair[1], packed=".splat", **SMALL)
    listed = nanogs.compare(pair[0], pair[1], packed=[".splat"], **SMALL)
    assert found == listed
    with pytest.raises(OptionError, match="no metric 'flop'; choose from flip"):
        nanogs.compare(pair[0], pair[1], metrics="flop", **SMALL)


def test_metrics_that_cannot_be_computed_are_refused_before_anything_is_read(pair, monkeypatch):
    def missing(_reference, _test):
        raise OptionError("lpips needs a package.")

    monkeypatch.setitem(EXTRA_METRICS, "lpips", missing)
    steps = []
    for metric, said in (("flop", "no metric 'flop'"), ("lpips", "needs a package")):
        with pytest.raises(OptionError, match=said):
            nanogs.compare(pair[0], pair[1], metrics=metric, progress=steps.append, **SMALL)
    assert steps == []


@pytest.mark.parametrize(
    "call",
    [
        nanogs.render,
        nanogs.draw_cost,
        nanogs.mode_evidence,
        lambda m, **o: nanogs.compare(m, m, **o),
    ],
)
def test_views_and_pixels_may_be_numpy_numbers_and_nothing_but_numbers(pair, call):
    small = pair[0].take(np.arange(60))
    plain, numpys = call(small, views=1, pixels=(32, 16)), {"views": np.int64(1)}
    for pixels in (np.array([32, 16]), (np.int32(32), np.uint8(16))):
        assert np.array_equal(call(small, pixels=pixels, **numpys), plain)
    assert np.array_equal(
        call(small, views=1, pixels=np.int64(32)), call(small, views=1, pixels=32)
    )
    for pixels in (32.0, "32", (32,), (32, 16, 8), (32, "16"), None):
        with pytest.raises(OptionError, match="`pixels` must be a whole number, or two"):
            call(small, views=1, pixels=pixels)
    for views in ("2", 2.0, (1,)):
        with pytest.raises(OptionError, match="`views` must be a whole number, not"):
            call(small, views=views, pixels=32)


def test_compare_takes_arrays_for_up_and_pixels(pair):
    """Arrays too can be among the options that `compare` checks against its defaults."""
    small = pair[0].take(np.arange(60))
    for options in ({"up": (0, 0, 1)}, {"pixels": (32, 16)}):
        arrays = {name: np.array(value) for name, value in options.items()}
        assert nanogs.compare(small, small, **arrays) == nanogs.compare(small, small, **options)


def test_cameras_of_a_refit_may_be_an_iterator(pair):
    views = automatic_cameras(pair[0], count=4, width=32, height=32)
    parameters = nanogs.RefitParameters(rounds=1, steps=2)
    _, report = nanogs.refit(*pair, cameras=iter(views), parameters=parameters)
    assert len(report.fit_views) + len(report.validation_views) == 4
    for wrong in ("auto", 5, [*views, "roam"]):
        with pytest.raises(OptionError, match="must be a list of at least two nanogs"):
            nanogs.refit(*pair, cameras=wrong, parameters=parameters)
    with pytest.raises(
        OptionError, match="needs at least two cameras, one of them for validation, not 1"
    ):
        nanogs.refit(*pair, cameras=views[0], parameters=parameters)


def test_a_background_may_be_an_array_of_three_numbers(pair):
    white = {"views": 1, "pixels": 32, "background": np.ones(3)}
    found = nanogs.compare(pair[0], pair[1], **white)
    assert found.protocol.background == (1.0, 1.0, 1.0)
    assert json.dumps(found.to_dict())
    evidence = nanogs.mode_evidence(pair[0], **white)
    assert evidence.protocol.background == (1.0, 1.0, 1.0)
    for wrong in ("white", 1.0, (1, 1), (1, 1, np.nan), ("a", "b", "c")):
        for call in (nanogs.mode_evidence, lambda m, **o: nanogs.compare(m, m, **o)):
            with pytest.raises(OptionError, match="background must be three finite numbers, not"):
                call(pair[0], views=1, pixels=32, background=wrong)


@pytest.mark.parametrize(
    "frame", ["rub", "rdf:rub", ("rub",), ("rdf", None), ("rdf", "rub", "luf"), 5]
)
def test_a_change_of_frames_needs_two_names(pair, files, tmp_path, frame):
    out = tmp_path / "out.ply"
    for call in (
        lambda: nanogs.simplify(pair[0], count=9, preset="fast", frame=frame),
        lambda: nanogs.simplify_blocks(files[0], out, count=9, preset="fast", frame=frame),
        lambda: nanogs.write_levels(files[0], out, [0.5], preset="fast", frame=frame),
        lambda: nanogs.convert(files[0], out, frame=frame),
        lambda: nanogs.convert(files[0], out.with_suffix(".spz"), frame=frame),
    ):
        with pytest.raises(OptionError, match="`frame` must be the frames from and to which"):
            call()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"nan": "eror"}, "`nan` must be 'drop' or 'error', not 'eror'"),
        ({"nan": None}, "`nan` must be 'drop' or 'error', not None"),
        ({"sh_degree": 0.5}, "SH degree must be a whole number, not 0.5"),
        ({"sh_degree": "1"}, "SH degree must be a whole number, not '1'"),
        ({"threads": "1"}, "threads must be a whole number, not '1'"),
        ({"threads": True}, "threads must be a whole number, not True"),
        ({"max_memory": "much"}, "must be like 20MB"),
        ({"max_memory": 2.5}, "is a number of bytes or text"),
        ({"max_memory": -1}, 'size is a number of bytes or text like "20MB", not -1'),
        ({"progress": "yes"}, "`progress`, .* function or None, must be True or False, not 'yes'"),
    ],
)
def test_invalid_options_of_all_calls_are_refused_in_one_sentence(
    pair, files, tmp_path, options, message
):
    model, settings = pair[0], {"preset": "fast", **options}
    for call in (
        lambda: nanogs.simplify(model, count=9, **settings),
        lambda: list(nanogs.levels(model, [0.5], **settings)),
        lambda: nanogs.grow(model, **settings),
        lambda: nanogs.simplify_blocks(files[0], tmp_path / "a.ply", count=9, **settings),
        lambda: nanogs.write_levels(files[0], tmp_path / "l", [0.5], **settings),
    ):
        with pytest.raises(OptionError, match=message):
            call()
    assert not list(tmp_path.iterdir())
    assert len(nanogs.simplify(model, count=9, preset="fast", max_memory="2GB")[0]) == 9


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"block": -5}, "`block` must be a whole number of splats, 1 or more, not -5"),
        ({"block": 0}, "`block` must be a whole number of splats, 1 or more, not 0"),
        ({"block": 10.0}, r"`block` must be a whole number of splats, 1 or more, not 10\.0"),
        ({"patience": "x"}, "`patience` must be seconds, 0 or more, not 'x'"),
        ({"patience": -1}, "`patience` must be seconds, 0 or more, not -1"),
        ({"measured": "no"}, "`measured` must be True or False, not 'no'"),
        ({"resume": "no"}, "`resume` must be True or False, not 'no'"),
        ({"overwrite": [True]}, r"`overwrite` must be True or False, not \[True\]"),
        ({"guided": "no"}, "guided must be True or False, not 'no'"),
        ({"up": (1, 2), "block": 20}, r"three finite numbers, not all zero, not \(1, 2\)"),
        ({"up": (0, 0, 0), "block": 20}, "three finite numbers, not all zero"),
        ({"up": "z", "block": 20}, "three finite numbers, not all zero, not 'z'"),
    ],
)
def test_invalid_options_of_jobs_are_refused_before_anything_is_written(
    files, tmp_path, options, message
):
    settings = {"view_size": 64, "views": 2, "steps": 1, **options}
    with pytest.raises(OptionError, match=message):
        nanogs.simplify_blocks(files[0], tmp_path / "a.ply", count=9, **settings)
    assert not list(tmp_path.iterdir())


def test_an_up_direction_beside_given_cameras_is_refused(pair, files, tmp_path):
    model, out = pair[0], tmp_path / "a.ply"
    given = {"cameras": automatic_cameras(model, 2, width=64, height=64), "up": (0, 0, 1)}
    for call in (
        lambda: nanogs.simplify(model, count=9, **given),
        lambda: list(nanogs.levels(model, [0.5], **given)),
        lambda: nanogs.grow(model, **given),
        lambda: nanogs.simplify_blocks(files[0], out, count=9, block=20, **given),
        lambda: nanogs.render(model, **given),
        lambda: nanogs.draw_cost(model, **given),
        lambda: nanogs.mode_evidence(model, **given),
        lambda: nanogs.compare(model, model, **given),
    ):
        with pytest.raises(OptionError, match="`up` cannot be combined with given cameras"):
            call()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("given", [{"views": 3}, {"pixels": 64}, {"pixels": (64, 48)}])
def test_options_of_automatic_views_beside_given_cameras_are_refused(pair, tmp_path, given):
    model, name = pair[0], next(iter(given))
    cameras = automatic_cameras(model, 2, width=32, height=32)
    file = tmp_path / "cameras.json"
    pose = {"img_name": "a", "position": [0, 0, -3], "rotation": np.eye(3).tolist()}
    file.write_text(json.dumps([{**pose, "width": 32, "height": 32, "fx": 30, "fy": 30}]))
    for call in (
        nanogs.render,
        nanogs.draw_cost,
        nanogs.mode_evidence,
        lambda model, **options: nanogs.compare(model, model, **options),
    ):
        for views in (cameras, cameras[0], file):
            with pytest.raises(OptionError, match=f"`{name}` cannot be combined with given cam"):
                call(model, cameras=views, **given)
            call(model, cameras=views)


def test_options_without_what_they_are_for_are_refused(pair):
    with pytest.raises(OptionError, match="`format_options` work only with `packed`"):
        nanogs.compare(*pair, format_options={"bits": 6})
    for call in (nanogs.compare, lambda *models, **given: nanogs.mode_evidence(models[0], **given)):
        for given in ({"split": "train"}, {"images": "images_4"}):
            with pytest.raises(OptionError, match="work only with photographs"):
                call(*pair, **given)


@pytest.mark.parametrize("options", [[6], 6, "bits", {6: 6}])
def test_format_options_that_are_no_dictionary_are_refused(pair, files, tmp_path, options):
    model, given = pair[0], {"format_options": options}
    for call in (
        lambda: nanogs.simplify(model, size=9000, format=".spz", preset="fast", **given),
        lambda: nanogs.simplify_blocks(files[0], tmp_path / "a.spz", count=9, **given),
        lambda: nanogs.save(model, tmp_path / "a.spz", **given),
        lambda: nanogs.compare(model, model, packed=".spz", **given),
        lambda: nanogs.packing_cost(model, ".spz", **given),
    ):
        with pytest.raises(OptionError, match="Format options are a dictionary"):
            call()
    assert not list(tmp_path.iterdir())


def test_the_up_direction_turns_views_of_models_and_of_files_alike(files, tmp_path):
    up, small = (1, 0, 0), tmp_path / "a.ply"
    given = {"view_size": 64, "views": 4, "steps": 1, "further": 0}
    nanogs.simplify_blocks(files[0], small, count=9, up=up, **given)
    expected = nanogs.load(small)
    model = nanogs.load(files[0])
    made, _ = nanogs.simplify(model, count=9, up=up, **given)
    (level, _), *_ = nanogs.levels(model, [9 / len(model)], up=up, **given)
    grown = nanogs.grow(model, up=up, **given)
    for result in (made, level, grown.simplify(count=9)[0]):
        assert np.array_equal(result.means, expected.means)
        assert np.array_equal(result.sh, expected.sh)
    other, _ = nanogs.simplify(model, count=9, **given)
    assert not np.array_equal(other.sh, expected.sh)
    for call in (nanogs.simplify, nanogs.grow, partial(nanogs.levels, ratios=[0.5])):
        goal = {"ratio": 0.5} if call is nanogs.simplify else {}
        with pytest.raises(OptionError, match="have no effect, because the preset fast"):
            call(model, **goal, preset="fast", up=up)


def test_a_text_as_a_switch_is_refused_and_nothing_is_replaced(pair, files, tmp_path):
    target = tmp_path / "a.ply"
    target.write_text("mine")
    settings = {"overwrite": "no"}
    for call in (
        lambda: nanogs.save(pair[0], target, **settings),
        lambda: nanogs.io.check_writable(target, **settings),
        lambda: nanogs.convert(files[0], target, **settings),
    ):
        with pytest.raises(OptionError, match="`overwrite` must be True or False, not 'no'"):
            call()
    for name, call in (
        ("transparent", nanogs.render),
        ("plain", partial(nanogs.write_levels, folder=tmp_path / "l", layout="3d tiles")),
    ):
        with pytest.raises(OptionError, match=f"`{name}` must be True or False, not 'no'"):
            call(pair[0], **{name: "no"})
    assert target.read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]
    nanogs.save(pair[0], target, overwrite=np.bool_(True))
    assert len(nanogs.load(target)) == len(pair[0])


def test_progress_that_is_no_function_or_switch_is_refused(pair, tmp_path):
    for progress in ("yes", True):
        with pytest.raises(OptionError, match="`progress` must be a function or None"):
            nanogs.save(pair[0], tmp_path / "a.ply", progress=progress)
    for call in (nanogs.render, nanogs.draw_cost):
        with pytest.raises(OptionError, match="function or None, must be True or False"):
            call(pair[0], progress="yes")
    with pytest.raises(OptionError, match="function or None, must be True or False"):
        nanogs.levels(pair[0], [0.5], progress="yes")  # before a level is asked for
    assert not list(tmp_path.iterdir())
    assert nanogs.render(pair[0], views=1, pixels=16, progress=np.bool_(False))


def test_numpy_booleans_are_accepted_as_switches():
    chosen = nanogs.presets["best"]
    assert dataclasses.replace(chosen, guided=np.bool_(False), halves=1) == dataclasses.replace(
        chosen, guided=False, halves=True
    )
    assert type(dataclasses.replace(chosen, guided=np.bool_(False)).guided) is bool


def test_packing_cost_takes_one_format_without_a_list(pair):
    cost = nanogs.packing_cost(pair[0], ".spz")
    assert [file.format for file in cost.files] == [".spz"]


def test_a_model_without_splats_is_refused(pair):
    with pytest.raises(ModelError, match="has no splats"):
        nanogs.simplify(pair[0].take(np.zeros(0, np.int64)), count=1, preset="fast")


def test_the_seconds_of_a_stage_are_added_up():
    """The method and the code that calls it may both time a stage of the same name."""
    around = StageClock({"read": 1.0, "measure": 0.25, "write": 2.0})
    found = _around(around, {"fit": 4.0, "measure": 8.0})
    assert found == {"read": 1.0, "fit": 4.0, "measure": 8.25, "write": 2.0}
    assert list(found) == ["read", "fit", "measure", "write"]


# ---- compare --------------------------------------------------------------------------------


def test_compare_gives_the_numbers_of_the_command(files):
    printed = json.loads(run("compare", *files, "--views", "3", "--pixels", "96", "--json").stdout)
    found = nanogs.compare(*files, views=3, pixels=96)
    assert json.loads(json.dumps(found.to_dict())) == printed
    assert found.models[0].name == "small.spz"
    assert found.models[0].file_bytes == files[1].stat().st_size
    [model] = nanogs.compare(*map(nanogs.load, files), views=3, pixels=96).models
    assert (model.psnr, model.ssim) == (found.models[0].psnr, found.models[0].ssim)
    assert (model.name, model.file_bytes) == ("model 1", None)


def test_compare_describes_each_model_in_one_line(pair):
    large, small = pair
    found = nanogs.compare(large, small, large, names=["small", "same"], **SMALL)
    assert [model.name for model in found.models] == ["small", "same"]
    assert found.models[1].psnr == np.inf
    first, second = str(found).splitlines()
    assert repr(found) == str(found)
    assert first.startswith(f"small: 100 splats, {found.models[0].psnr:.2f} dB on 2 held-out views")
    assert second.startswith("same: 400 splats, ∞ dB")
    assert found.protocol.pixels == (48, 32)


def test_compare_takes_given_cameras(pair):
    large, small = pair
    cameras = automatic_cameras(large, 2, width=48, height=32, split="test")
    with_cameras = nanogs.compare(large, small, cameras=cameras)
    found = nanogs.compare(large, small, **SMALL)
    assert with_cameras.models[0].psnr == found.models[0].psnr
    assert (with_cameras.protocol.kind, found.protocol.kind) == ("given", "auto")
    assert len(nanogs.compare(large, small, cameras=cameras[1]).views) == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"names": ["one", "two"]}, "one name for each model, 1 in all"),
        ({"names": "small"}, "one name for each model"),
        ({"cameras": "missing.json"}, "no camera file 'missing.json'"),
        ({"cameras": []}, "at least one nanogs.Camera"),
        ({"cameras": [1]}, "at least one nanogs.Camera"),
        ({"metrics": ["msssim"]}, "no metric 'msssim'"),
        ({"views": 0}, "count and a size of 1 or more"),
        ({"background": (0, 0)}, "background must be three"),
        ({"threads": 0}, "thread"),
    ],
)
def test_compare_refuses_invalid_options(pair, options, message):
    with pytest.raises(OptionError, match=message):
        nanogs.compare(*pair, **SMALL | options)


def test_compare_needs_a_model(pair):
    with pytest.raises(OptionError, match="at least one model"):
        nanogs.compare(pair[0])


# ---- render ---------------------------------------------------------------------------------


def test_render_gives_the_pictures_of_the_command(files, tmp_path):
    from PIL import Image

    from nanogs.raster.images import to_bytes

    options = ("--views", "2", "--pixels", "48x32")
    assert run("render", files[0], tmp_path / "pictures", *options).returncode == 0
    images = nanogs.render(files[0], **SMALL)
    assert [image.shape for image in images] == [(32, 48, 3)] * 2
    assert all(image.dtype == np.float32 for image in images)
    for image, path in zip(images, sorted((tmp_path / "pictures").iterdir()), strict=True):
        np.testing.assert_array_equal(to_bytes(image), np.asarray(Image.open(path)))


def test_render_blends_over_a_background_or_leaves_it_transparent(pair):
    cameras = automatic_cameras(pair[0], 2, width=48, height=32, split="test")
    [black], [white] = (
        nanogs.render(pair[0], cameras[0], background=background)
        for background in ((0, 0, 0), (1, 1, 1))
    )
    [straight] = nanogs.render(pair[0], cameras[:1], transparent=True, background=(1, 0, 0))
    assert straight.shape == (32, 48, 4)
    color, alpha = straight[..., :3], straight[..., 3:]
    assert 0 < alpha.mean() < 1
    shown = (color < 1).all(axis=2)  # a colour above 1 is clipped before it is divided by alpha
    np.testing.assert_allclose((color * alpha)[shown], black[shown], atol=1e-5)
    np.testing.assert_allclose((color * alpha + 1 - alpha)[shown], white[shown], atol=1e-5)


def test_render_gives_pictures_of_the_requested_number_and_size(pair):
    square, wide = nanogs.render(pair[0], views=1, pixels=24), nanogs.render(pair[0], **SMALL)
    assert square[0].shape == (24, 24, 3)
    assert len(wide) == 2
    assert not np.array_equal(*wide)
    assert all(image.min() >= 0 and 0.05 < image.max() <= 1 for image in (*square, *wide))
