"""3D Tiles on Earth: the transform of a place, checked by pyproj and SciPy, and its options."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import nanogs
from builders import random_splats
from crashes import CrashError
from launch import contents, run
from nanogs import io
from nanogs.errors import OptionError, OutputError
from nanogs.levels_of_detail import write_levels
from nanogs.lod.layout import LodLayout
from nanogs.place import Place, columns, from_columns, text_of, transform_of
from test_cli import assert_refused

PLACES = {
    "Zurich": (8.5417, 47.3769, 408.0),
    "Null Island": (0.0, 0.0, 0.0),
    "north pole": (0.0, 90.0, 10.0),
    "north pole, from the east": (90.0, 90.0, 10.0),
    "south pole": (-60.0, -90.0, 2835.0),
    "date line from the west": (180.0, -16.5, 1.0),
    "date line from the east": (-180.0, -16.5, 1.0),
    "Quito": (-78.4678, -0.1807, 2850.0),
    "Sydney, below the ellipsoid": (151.2153, -33.8568, -35.0),
}
angles = st.floats(-720, 720, width=32)
places = st.builds(
    Place,
    st.floats(-180, 180),
    st.floats(-90, 90),
    st.floats(-11_000, 90_000),
    angles,
    angles,
    angles,
)


@pytest.fixture(scope="module")
def pyproj():
    return pytest.importorskip("pyproj", reason="pyproj is not installed: see the extra dev")


# The transform


@pytest.mark.parametrize("name", PLACES)
def test_the_origin_agrees_with_pyproj(pyproj, name):
    """From EPSG:4979 (longitude, latitude, height of WGS84) to EPSG:4978 (Earth-centred)."""
    transformer = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    expected = transformer.transform(*PLACES[name])
    assert Place(*PLACES[name]).matrix()[:3, 3] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("name", PLACES)
def test_the_axes_are_east_north_and_up_as_in_pyproj(pyproj, name):
    """Points 100 m along each axis agree with the topocentric frame of PROJ."""
    longitude, latitude, height = PLACES[name]
    topocentric = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=topocentric +ellps=WGS84"
        f" +lon_0={longitude} +lat_0={latitude} +h_0={height}"
    )
    matrix = Place(longitude, latitude, height).matrix()
    for point in 100 * np.eye(3):
        expected = topocentric.transform(*point, direction="INVERSE")
        assert (matrix @ [*point, 1])[:3] == pytest.approx(expected, abs=1e-6)


def test_axes_and_angles_move_points_as_on_a_map(pyproj):
    """Points along the axes of the scene, in metres to the east, north and up."""
    transformer = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)

    def moved(axis, **angles):
        place = Place(8.5417, 47.3769, 408.0, **angles)
        position = transformer.transform(*(place.matrix() @ [*(10 * np.eye(3)[axis]), 1])[:3])
        metres = 111_195 * np.cos(np.deg2rad(47.4)), 111_195, 1
        return (np.subtract(position, (8.5417, 47.3769, 408.0)) * metres).round(0).tolist()

    assert [moved(axis) for axis in range(3)] == [[10, 0, 0], [0, 10, 0], [0, 0, 10]]
    # A heading of 90 is clockwise: north becomes east, and east becomes south.
    assert [moved(axis, heading=90) for axis in range(2)] == [[0, -10, 0], [10, 0, 0]]
    # A pitch lifts the east side, a roll the north side.
    assert moved(0, pitch=90) == moved(1, roll=90) == [0, 0, 10]
    # First the roll (north to up), then the pitch (up to west), last the heading (west to north).
    assert moved(1, heading=90, pitch=90, roll=90) == [0, 10, 0]


@given(places)
@example(Place(0, 90, 0, 10, 90, 20))
def test_the_transform_of_a_place_is_rigid(place):
    matrix = place.matrix()
    rotation = matrix[:3, :3]
    assert rotation.T @ rotation == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1, abs=1e-12)
    assert (matrix[3] == [0, 0, 0, 1]).all()


@given(places)
def test_angles_agree_with_scipy(place):
    """SciPy's intrinsic rotations about z, y and then x."""
    angles = [-place.heading, -place.pitch, place.roll]
    level = replace(place, heading=0, pitch=0, roll=0).matrix()[:3, :3]
    expected = level @ Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
    assert place.matrix()[:3, :3] == pytest.approx(expected, abs=1e-12)


@given(places)
@example(Place(10, 50, 0, 30, 90, 40))
@example(Place(10, 50, 0, 30, -90, 40))
@example(Place(123, 90, 0, 30, 5, 0))
@example(Place(-180, -90, 0))
def test_a_place_is_recovered_from_its_transform(place):
    """The transform is the same, but its angles may be others that mean the same rotation."""
    matrix = place.matrix()
    assert np.abs(Place.of(matrix).matrix() - matrix).max() < 1e-6
    named = dict(field.split() for field in text_of(matrix).split(", "))
    again = Place(**{name: float(value) for name, value in named.items()}).matrix()
    assert np.abs(again - matrix)[:3, 3].max() < 2e-4
    assert np.abs(again - matrix)[:3, :3].max() < 1e-8


def test_transforms_that_are_no_place_are_described_by_their_numbers():
    scaled = np.diag([2.0, 2, 2, 1])
    scaled[:3, 3] = 6.4e6, 0.1, 0
    assert text_of(scaled) == "transform 2,0,0,0,0,2,0,0,0,0,2,0,6400000,0.1,0,1"
    assert Place.of(scaled) is None
    far = Place(0, 0, 2e5).matrix()
    assert Place.of(far) is None
    assert Place.of(Place(8, 47).matrix() @ np.diag([-1.0, 1, 1, 1])) is None


def test_angles_that_round_to_zero_have_no_sign():
    text = text_of(Place(8.5, 47, 400, heading=1e-9, pitch=-1e-9, roll=-1e-9).matrix())
    assert text == "longitude 8.5, latitude 47, height 400, heading 0, pitch 0, roll 0"


REFUSED = {
    "longitude": ({"longitude": 180.1, "latitude": 0}, "-180 to 180 degrees, not 180.1"),
    "latitude": ({"longitude": 0, "latitude": -91}, "-90 to 90 degrees, not -91"),
    "NaN": ({"longitude": math.nan, "latitude": 0}, "not nan"),
    "height": ({"longitude": 0, "latitude": 0, "height": math.inf}, "metres, not inf"),
    "heading": ({"longitude": 0, "latitude": 0, "heading": math.inf}, "finite number of degrees"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_invalid_places_are_refused(name):
    values, words = REFUSED[name]
    with pytest.raises(OptionError, match=words):
        Place(**values)


def changed(row, column, value):
    matrix = np.eye(4)
    matrix[row, column] = value
    return matrix


@pytest.mark.parametrize(
    ("transform", "message"),
    [
        (np.eye(3), "four rows of four"),
        ("here", "four rows of four"),
        ([[1, 2], [3]], "four rows of four"),
        (changed(0, 3, np.nan), "finite"),
        (changed(3, 0, 1), "affine"),
        (changed(3, 3, 2), "affine"),
        (changed(0, 0, -1), "mirrors or flattens"),
        (changed(0, 0, 0), "mirrors or flattens"),
        ([[1, 1, 0, 0], [0, 1e-7, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "mirrors or flattens"),
        (changed(0, 0, 1e13), "at most"),
    ],
)
def test_invalid_transforms_are_refused(transform, message):
    with pytest.raises(OptionError, match=message):
        transform_of(transform)


# Tiles


ZURICH = Place(8.5417, 47.3769, 408.0, 30.0, 2.0, -1.0)
OPTIONS = "--longitude 8.5417 --latitude 47.3769 --height 408 --heading 30 --pitch 2 --roll -1"
TILES = ("--levels", "0.5,0.1", "--preset", "fast", "--chunk", 60, "--plain")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "scene.ply"
    nanogs.save(random_splats(600, degree=2), path)
    return path


@pytest.fixture(scope="module")
def unplaced(scene):
    path = scene.parent / "nowhere" / "tileset.json"
    assert run("lod", scene, path, *TILES, "-q").returncode == 0
    return path


@pytest.fixture(scope="module")
def placed(scene):
    path = scene.parent / "placed" / "tileset.json"
    result = run("lod", scene, path, *TILES, *OPTIONS.split(), "-q")
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
    return path


def root_transform(path):
    return from_columns(json.loads(path.read_text())["root"]["transform"])


def test_only_the_transform_of_the_root_depends_on_the_place(placed, unplaced):
    """All other files of the folder have the same bytes."""
    assert np.array_equal(root_transform(placed), ZURICH.matrix())
    data, other = (json.loads(path.read_text()) for path in (placed, unplaced))
    data["root"]["transform"] = other["root"]["transform"]
    assert data == other
    names = {path.name for path in placed.parent.iterdir()}
    assert names == {path.name for path in unplaced.parent.iterdir()}
    for name in names - {"tileset.json"}:
        assert (placed.parent / name).read_bytes() == (unplaced.parent / name).read_bytes()


def test_west_and_south_are_negative(scene):
    path = scene.parent / "southwest" / "tileset.json"
    result = run("lod", scene, path, *TILES, "--longitude", "-70.5", "--latitude", "-33", "-q")
    assert result.returncode == 0, result.stderr
    assert np.array_equal(root_transform(path), Place(-70.5, -33).matrix())


def test_reading_gives_the_local_scene_and_notes_the_place(placed, unplaced, tmp_path):
    """In Earth-centred coordinates of single precision, a splat would be half a metre off."""
    result = run("convert", placed, tmp_path / "a.ply", "--level", "1")
    assert result.returncode == 0, result.stderr
    named = OPTIONS.removeprefix("--").replace(" --", ", ")
    assert f"The position of the scene on Earth was left out: {named}." in result.stderr
    again, expected = io.load(tmp_path / "a.ply"), io.load(unplaced, level=1)
    for name in ("means", "quats", "log_scales", "sh"):
        assert np.array_equal(getattr(again, name), getattr(expected, name))


def test_a_transform_can_be_given_as_16_numbers(scene, tmp_path):
    """It may scale, for scenes that are not in metres; the errors of tiles are scaled with it."""
    matrix = ZURICH.matrix() @ np.diag([3.0, 3, 3, 1])
    numbers = ",".join(map(repr, columns(matrix)))
    for name, text in (("commas", numbers), ("spaces", numbers.replace(",", " "))):
        path = tmp_path / name / "tileset.json"
        result = run("lod", scene, path, *TILES, "--transform", text, "-q")
        assert result.returncode == 0, result.stderr
        assert np.array_equal(root_transform(path), matrix)
    data = json.loads(path.read_text())
    assert data["geometricError"] >= 3 * data["root"]["geometricError"] * (1 - 1e-9)
    result = run("convert", path, tmp_path / "a.ply", "--level", "1")
    assert f"left out: transform {numbers.split(',')[0]}," in result.stderr


@pytest.mark.parametrize(
    ("output", "options", "fragments"),
    [
        ("levels", OPTIONS, ["only in 3D Tiles", "tileset.json"]),
        ("lod-meta.json", OPTIONS, ["only in 3D Tiles"]),
        ("a.rad", OPTIONS, ["only in 3D Tiles"]),
        ("tileset.json", "--longitude 8", ["--latitude"]),
        ("tileset.json", "--latitude 8 --roll 3", ["--longitude"]),
        ("tileset.json", "--height 8", ["--longitude and --latitude"]),
        ("tileset.json", "--longitude 8 --latitude 91", ["-90 to 90"]),
        ("tileset.json", "--longitude nan --latitude 9", ["not nan"]),
        ("tileset.json", "--transform 1,2,3", ["16 numbers"]),
        ("tileset.json", "--transform 1,0,0,0,0,1,0,0,0,0,1,1,0,0,0,1", ["affine"]),
        ("tileset.json", "--roll 1 --transform 1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1", ["--roll"]),
    ],
)
def test_wrong_options_of_a_place_are_refused(scene, tmp_path, output, options, fragments):
    result = run("lod", scene, tmp_path / "out" / output, *options.split())
    assert_refused(result, *fragments)
    assert not (tmp_path / "out").exists()


def test_blocks_and_resumed_jobs_keep_the_place(scene, tmp_path):
    def write(folder, place, **options):
        return write_levels(
            scene, folder, (0.5, 0.1), layout=LodLayout.TILES, chunk=60, block=300, preset="fast",
            place=place, threads=1, **options,
        )  # fmt: skip

    def crash(step):
        if step.stage == "chunk":
            raise CrashError

    with pytest.raises(CrashError):
        write(tmp_path / "a", ZURICH, progress=crash)
    for other in (None, replace(ZURICH, roll=1.0)):
        with pytest.raises(OutputError, match="or their place on Earth"):
            write(tmp_path / "a", other, resume=True)
    write(tmp_path / "a", ZURICH.matrix(), resume=True)  # the same place as a matrix
    write(tmp_path / "b", ZURICH)
    assert np.array_equal(root_transform(tmp_path / "a" / "tileset.json"), ZURICH.matrix())
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_sh_degree_and_min_opacity_apply_to_tiles(scene, tmp_path):
    """In every level, packed or not."""
    for form in ([], ["--plain"]):
        path = tmp_path / f"tiles{len(form)}" / "tileset.json"
        options = ["--levels", "1,0.3", "--preset", "fast", "--chunk", 60, *form]
        result = run(
            "lod",
            scene,
            path,
            *options,
            "--sh-degree",
            "1",
            "--min-opacity",
            "0.4",
            *OPTIONS.split(),
        )
        assert result.returncode == 0, result.stderr
        kept = int((io.load(scene).opacities() >= 0.4).sum())
        assert 0 < kept < 600
        assert io.inspect(path).splats == kept
        contents = [io.load(file) for file in path.parent.glob("*.glb")]
        assert {part.sh_degree for part in contents} == {1}
        # SPZ has alpha in 255 steps.
        assert min(part.opacities().min() for part in contents) >= 0.4 - 1 / 255
