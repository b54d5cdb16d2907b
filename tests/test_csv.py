"""Reading and writing `.csv`."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

import nanogs
from builders import random_splats
from nanogs import io
from nanogs.errors import FormatError, OutputError
from nanogs.io import registry
from nanogs.source import source_of
from nanogs.splats import RenderMode
from strategies import assert_same, splats

HEAD = "x,y,z,f_dc_0,f_dc_1,f_dc_2,opacity,scale_0,scale_1,scale_2,rot_0,rot_1,rot_2,rot_3"
ROW = "1.0000,2.0000,3.0,4.0,5,6,7,8,9,10,11,12,13,14"


@pytest.fixture
def load(tmp_path):
    def load(text):
        (tmp_path / "a.csv").write_bytes(text.encode())
        return io.load(tmp_path / "a.csv")

    return load


def test_the_lines_have_the_columns_of_ply_and_nine_digits(tmp_path):
    model = replace(random_splats(3, degree=1), extras={"label": np.int32([7, -1, 5])})
    io.save(model, tmp_path / "a.csv")
    io.save(model, tmp_path / "a.ply")
    lines = (tmp_path / "a.csv").read_bytes().decode("ascii").split("\n")
    assert lines[0].split(",") == [name for name, _ in io.inspect(tmp_path / "a.ply").properties]
    assert len(lines) == 5
    assert lines[-1] == ""
    numbers = lines[2].split(",")
    assert numbers[:3] == [f"{value:.9g}" for value in model.means[1].tolist()]
    assert numbers[-1] == "-1"


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(model=splats(max_n=9, extras=False))
def test_every_model_is_read_back_exactly(tmp_path, model):
    plain = replace(
        model, render_mode=RenderMode.DEFAULT, comments=(), means=np.float32(model.means)
    )
    io.save(plain, tmp_path / "a.csv", overwrite=True)
    assert_same(io.load(tmp_path / "a.csv"), plain)


def test_values_that_are_not_finite_are_kept(tmp_path):
    model = random_splats(4)
    model.means[0, 0], model.opacity_logits[1], model.log_scales[2, 1] = np.nan, np.inf, -np.inf
    model.quats[3] = -0.0
    io.save(model, tmp_path / "a.csv")
    assert_same(io.load(tmp_path / "a.csv"), model)


def test_numpy_and_the_csv_module_read_the_same_numbers(tmp_path):
    model = replace(random_splats(9, degree=2), extras={'a "b", c': np.arange(9, dtype=np.uint8)})
    io.save(model, tmp_path / "a.csv")
    with (tmp_path / "a.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row['a "b", c'] for row in rows] == list("012345678")
    table = np.loadtxt(tmp_path / "a.csv", np.float32, delimiter=",", skiprows=1)
    assert np.array_equal(table[:, :3], model.means)
    assert_same(
        io.load(tmp_path / "a.csv"), replace(model, extras=io.load(tmp_path / "a.csv").extras)
    )
    assert io.load(tmp_path / "a.csv").extras['a "b", c'].tolist() == list(range(9))


def test_columns_in_another_order_are_found_by_name(load):
    names = HEAD.split(",")
    model = load(",".join(names[::-1]) + "\r\n" + ROW + "\r\n")
    assert model.means.tolist() == [[14, 13, 12]]
    assert model.quats.tolist() == [[4, 3, 2, 1]]


def test_losses_name_what_is_rounded_and_left_out():
    model = replace(random_splats(3), means=np.full((3, 3), 1 / 3), comments=["a"])
    extras = {"near": np.int32([1, 2, 3]), "far": np.int32([1, 2, (1 << 24) + 1])}
    losses = io.losses(replace(model, extras=extras, render_mode=RenderMode.MIP), "a.csv")
    assert losses == (
        "1 comment line is left out, .csv has no room for it.",
        "Extra columns are rounded, .csv holds single precision: far.",
        "Centres in double precision are rounded, .csv holds single.",
        (
            "The render mode mip is left out, .csv has no tag for it: viewers will render the model"
            " as ordinary splats."
        ),
    )


def test_numbers_beyond_single_precision_become_infinite(tmp_path):
    model = replace(random_splats(3), extras={"far": np.array([1e300, -1e300, 2])})
    assert "rounded" in io.losses(model, "a.csv")[0]
    io.save(model, tmp_path / "a.csv")
    assert io.load(tmp_path / "a.csv").extras["far"].tolist() == [np.inf, -np.inf, 2]


@pytest.mark.parametrize(
    ("name", "column", "problem"),
    [
        ("opacity", np.zeros(3), "'opacity' has a splat's own name"),
        ("who", np.array(["a", "b", "c"]), "which .csv cannot hold"),
        ("phase", np.zeros(3, np.complex64), "is complex64, which .csv cannot hold"),
        ("two\nlines", np.zeros(3), "The name 'two\\\\nlines' holds a line break"),
    ],
)
def test_columns_that_no_file_can_hold_are_refused(tmp_path, name, column, problem):
    model = replace(random_splats(3), extras={name: column})
    with pytest.raises(OutputError, match=problem):
        io.save(model, tmp_path / "a.csv")
    with pytest.raises(OutputError, match=problem):  # before anything is computed
        registry.writable(tmp_path / "a.csv").check_columns(source_of(model).columns)
    assert not (tmp_path / "a.csv").exists()


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (HEAD + "\n", "has no rows; export a model with splats"),
        (
            HEAD + "\n" + (ROW + "\n") * 2 + "1,2\n",
            "row 3 of 3 of the table has 2 values instead of 14",
        ),
        (HEAD + "\n" + ROW + "\n\n" + ROW + "\n", "row 2 of 3 of the table has 1 value instead"),
        (HEAD + "\n" + ROW[:-2] + "one\n", "row 1 of 1 of the table: 'one' is no value"),
        (HEAD + "\n" + ROW[:-2] + "1e39", "row 1 of 1 of the table: '1e\\+39' is no value"),
        (HEAD + ",opacity\n" + ROW + ",1\n", "two columns are called 'opacity'; rename one"),
        ("a,b\n1,2\n", "the table lacks x, y, z.* a point cloud or mesh"),
        ("a\rb\n1,2\n", "the first line holds no names of columns"),
        (HEAD + "\n" * 300, "is cut short: 299 rows of text need at least"),
    ],
)
def test_damaged_files_are_refused_with_the_place(load, text, problem):
    with pytest.raises(FormatError, match=problem):
        load(text)


def test_a_csv_is_described_and_converted_back(tmp_path):
    model = random_splats(30, degree=3)
    io.save(model, tmp_path / "a.ply")
    report = nanogs.convert(tmp_path / "a.ply", tmp_path / "a.csv")
    assert (report.format, report.splats, report.losses) == ("csv", 30, ())
    nanogs.convert(tmp_path / "a.csv", tmp_path / "b.ply")
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    assert io.inspect(tmp_path / "a.csv").encoding == "ascii"
    (tmp_path / "unnamed").write_bytes((tmp_path / "a.csv").read_bytes())
    with (tmp_path / "unnamed").open("rb") as file:
        assert_same(nanogs.load(file), model)
