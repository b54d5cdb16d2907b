"""`Splats`: accepted input, rows, copies and display."""

import copy
import pickle
import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import nanogs
from builders import random_splats
from nanogs import summary
from nanogs.errors import ModelError
from nanogs.splats import ExtraElement, RenderMode, Splats
from strategies import assert_same, splats, table

COLUMNS = ("means", "log_scales", "quats", "opacity_logits", "sh")
ROWS = {
    "indices": np.array([5, 0, 0, 11, -1]),
    "int32": np.array([3, 1], np.int32),
    "none": np.empty(0, np.int64),
    "mask": np.arange(12) % 3 == 0,
    "slice": slice(2, 9, 3),
}


class Tensor:
    """Like a tensor of PyTorch: no array if it needs a gradient or is on another device."""

    def __init__(self, array, *, grad=True, device="cuda"):
        self.array, self.grad, self.device = array, grad, device
        self.dtype = f"torch.{array.dtype}"

    def detach(self):
        return Tensor(self.array, grad=False, device=self.device)

    def cpu(self):
        return Tensor(self.array, grad=self.grad, device="cpu")

    def __array__(self, *_arguments, **_options):
        if self.device != "cpu":
            raise TypeError("can't convert cuda:0 device type tensor to numpy.\nMore lines.")
        if self.grad:
            raise RuntimeError("Can't call numpy() on Tensor that requires grad.")
        return self.array


def arrays_of(model):
    return {name: getattr(model, name) for name in COLUMNS}


# ---- rows -----------------------------------------------------------------------------------


@pytest.mark.parametrize("rows", ROWS.values(), ids=ROWS)
def test_indexing_takes_the_rows_of_every_column(rows):
    labels = np.arange(12, dtype=">u2")
    model = random_splats(12, extras={"label": labels})
    for some in (model.take(rows), model[rows]):
        for name in COLUMNS:
            column = getattr(model, name)
            np.testing.assert_array_equal(getattr(some, name), column[rows])
            assert getattr(some, name).dtype == column.dtype
        np.testing.assert_array_equal(some.extras["label"], labels[rows])
        assert some.extras["label"].dtype == labels.dtype


@pytest.mark.parametrize("row", [0, 11, -1, -2, -12, np.int8(3), np.array(5)])
def test_indexing_by_a_number_gives_a_model_of_one_splat(row):
    model = random_splats(12, extras={"label": np.arange(12)})
    assert model[row].extras["label"].tolist() == [np.arange(12)[row]]


def test_rows_out_of_range_are_refused():
    for rows in (np.array([12]), [12], 12, -13):
        with pytest.raises(IndexError):
            random_splats(12)[rows]
    with pytest.raises(IndexError):
        random_splats(12).take(np.array([12]))


@st.composite
def models_and_rows(draw):
    """A model, and an index of its rows of any accepted type."""
    model = draw(splats())
    n = len(model)
    row = st.integers(-n, n - 1)
    kinds = {
        "number": row,
        "slice": st.slices(n),
        "list": st.lists(row),
        "array": st.lists(row).map(lambda rows: np.array(rows, np.int64)),
        "small": st.lists(row).map(lambda rows: np.array(rows, np.int8)),
        "unsigned": st.lists(st.integers(0, n - 1)).map(lambda rows: np.array(rows, np.uint64)),
        "mask": st.lists(st.booleans(), min_size=n, max_size=n).map(np.array),
        "flags": st.lists(st.booleans(), min_size=n, max_size=n),
    }
    return model, draw(st.one_of(*kinds.values()))


@given(models_and_rows())
def test_any_index_selects_the_rows_that_numpy_selects(drawn):
    model, rows = drawn
    some = model[rows]
    empty = isinstance(rows, list) and not rows
    expected = np.atleast_1d(np.arange(len(model))[np.zeros(0, int) if empty else rows])
    assert len(some) == len(expected)
    for name, column in table(model).items():
        follows = not name.startswith("element") or 1 < len(column) == len(model)
        kept = column[expected] if follows else column
        assert table(some)[name].tobytes() == kept.tobytes(), name
        assert table(some)[name].dtype == column.dtype, name
    assert (some.render_mode, some.comments) == (model.render_mode, model.comments)
    assert_same(replace(model.take(rows), elements=some.elements), some)


@given(splats())
def test_a_full_slice_equals_the_model(model):
    assert_same(model[:], model)


@given(splats(extras=False))
def test_iterating_gives_models_of_one_splat_each(model):
    assert [len(one) for one in model] == [1] * len(model)
    assert_same(nanogs.splats.concatenate(list(model)), model)


@pytest.mark.parametrize("order", [1, -1])
def test_models_whose_columns_differ_are_not_concatenated(order):
    plain, labelled = random_splats(3), random_splats(4, extras={"label": np.arange(4)})
    with pytest.raises(ModelError, match=r"extra columns differ \(label\) cannot be concatenated"):
        nanogs.splats.concatenate([plain, labelled][::order])
    with pytest.raises(ModelError, match="At least one model is needed"):
        nanogs.splats.concatenate([])
    with pytest.raises(ModelError, match=r"A model is needed, not the path 'a\.ply'"):
        nanogs.splats.concatenate(["a.ply", "b.ply"])
    assert len(nanogs.splats.concatenate([plain, plain])) == 6


def test_elements_with_one_row_per_splat_are_indexed_and_others_kept():
    one_each = ExtraElement("marks", np.arange(5.0).view([("a", "f8")]))
    other = ExtraElement("camera", np.zeros(2, [("x", "f4")]))
    model = replace(random_splats(5), elements=[one_each, other])
    some = model[[4, 1]]
    assert some.elements[0].rows["a"].tolist() == [4, 1]
    assert some.elements[1].rows is other.rows


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (np.ones(11, bool), "A mask must have one flag for each of the 12 splats, not 11"),
        (1.5, "not float"),
        ("means", "not str"),
        (None, "not NoneType"),
        (True, "not bool"),
        ((1, 2), "not tuple"),
        (np.zeros((2, 2), int), re.escape("not int64 of shape (2, 2)")),
        (np.zeros(2), "not float64 of shape"),
        ([[1], [2, 3]], "not list"),
    ],
)
def test_invalid_indices_are_refused(rows, message):
    with pytest.raises(IndexError, match=message):
        random_splats(12)[rows]
    with pytest.raises(IndexError, match=message):
        random_splats(12).take(rows)


# ---- accepted input -------------------------------------------------------------------------


def test_lists_and_other_numbers_become_float32():
    model = Splats(
        means=[[0, 1, 2]],
        log_scales=[[-4.0, -4.0, -4.0]],
        quats=[(1, 0, 0, 0)],
        opacity_logits=[[2.5]],
        sh=[[[0.5, 0.25, 0]]],
        extras={"label": [7]},
    )
    assert all(getattr(model, name).dtype == np.float32 for name in COLUMNS)
    assert model.means.tolist() == [[0, 1, 2]]
    assert model.opacity_logits.tolist() == [2.5]
    assert model.extras["label"].tolist() == [7]
    other = random_splats(9)
    for kind in (np.float64, np.float16, ">f4"):
        cast = {name: array.astype(kind) for name, array in arrays_of(other).items()}
        taken = Splats(**cast)
        for name, array in cast.items():
            np.testing.assert_array_equal(getattr(taken, name), array)
            double = name == "means" and kind is np.float64
            assert getattr(taken, name).dtype == (np.float64 if double else np.float32)


def test_a_render_mode_can_be_given_as_text():
    model = replace(random_splats(2), render_mode="mip")
    assert model.render_mode is RenderMode.MIP
    taken = Splats.from_gsplat(model.to_gsplat(), render_mode="2dgs")
    assert taken.render_mode is RenderMode.SURFEL
    with pytest.raises(ModelError, match="render_mode must be one of"):
        Splats.from_gsplat(model.to_gsplat(), render_mode="classic")


def test_float32_is_not_copied():
    given_arrays = arrays_of(random_splats(4))
    model = Splats(**given_arrays)
    assert all(getattr(model, name) is array for name, array in given_arrays.items())


def test_arrays_of_subclasses_are_taken_as_plain_views(tmp_path):
    other = random_splats(4, degree=0, extras={"label": np.arange(4)})
    mapped = np.memmap(tmp_path / "means", np.float32, "w+", shape=(4, 3))
    mapped[:] = other.means
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PendingDeprecationWarning)  # of NumPy, about matrices
        model = Splats(
            means=mapped,
            log_scales=np.ma.masked_array(other.log_scales),
            quats=np.matrix(other.quats),
            opacity_logits=np.matrix(other.opacity_logits).T,
            sh=other.sh,
            extras={"label": np.ma.masked_array(other.extras["label"], mask=False)},
        )
    columns = [*arrays_of(model).values(), model.extras["label"]]
    assert {type(column) for column in columns} == {np.ndarray}
    assert_same(model, other)
    assert np.shares_memory(model.means, mapped)


def test_masked_entries_are_refused():
    other = random_splats(4)
    masked = np.ma.masked_array(other.means, mask=np.eye(4, 3))
    with pytest.raises(ModelError, match="means has masked entries; fill them, or leave out"):
        replace(other, means=masked)
    with pytest.raises(ModelError, match="means has masked entries"):
        Splats.from_gsplat(other.to_gsplat() | {"means": masked})
    labels = np.ma.masked_array(np.arange(4), mask=[0, 1, 0, 0])
    with pytest.raises(ModelError, match="extra column 'label' has masked entries"):
        replace(other, extras={"label": labels})
    with pytest.raises(IndexError, match="Splats are indexed by"):
        other[np.ma.masked_array(np.ones(4, bool), mask=[0, 1, 0, 0])]


def test_tensors_are_detached_and_brought_to_the_cpu():
    other = random_splats(6)
    model = Splats(**{name: Tensor(array) for name, array in arrays_of(other).items()})
    assert_same(model, other)


def test_tensors_of_pytorch_are_accepted():
    torch = pytest.importorskip("torch")
    other = random_splats(6)
    leaves = {n: torch.nn.Parameter(torch.from_numpy(a)) for n, a in arrays_of(other).items()}
    assert_same(Splats(**leaves), other)
    trained = torch.nn.ParameterDict(
        {name: torch.from_numpy(a) for name, a in other.to_gsplat().items()}
    )
    assert_same(Splats.from_gsplat(trained), other)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"means": "scene.ply"}, "means is the path 'scene.ply'.*nanogs.load reads files"),
        ({"means": Path("a.ply")}, "means is the path 'a.ply'"),
        ({"means": 1.0}, r"means must be \(N, 3\), not \(\)"),
        ({"means": np.zeros((4, 2))}, r"means must be \(N, 3\), not \(4, 2\)"),
        ({"means": None}, "means must hold real numbers, not object"),
        ({"quats": np.zeros((4, 3))}, r"quats must be \(4, 4\) like means, not \(4, 3\)"),
        ({"opacity_logits": np.zeros((4, 2))}, r"opacity_logits must be \(4,\) like means"),
        ({"opacity_logits": np.zeros(3)}, r"must be \(4,\) like means, not \(3,\)"),
        ({"opacity_logits": np.zeros(4, bool)}, "must hold real numbers, not bool"),
        ({"sh": np.zeros((4, 3))}, r"sh must be \(N, 1\|4\|9\|16\|25, 3\), not \(4, 3\)"),
        ({"sh": np.zeros((4, 1, 3), complex)}, "sh must hold real numbers"),
        ({"log_scales": [[1], [2, 3]]}, "log_scales cannot be converted to an array"),
        ({"log_scales": np.full((4, 3), 1e39)}, "log_scales holds numbers that are too large"),
        (
            {"render_mode": "antialiased"},
            "render_mode must be one of default, mip, 2dgs, not 'anti",
        ),
        ({"comments": "by me"}, "comments must be a list, not one text"),
        ({"notes": "by me"}, "notes must be a list, not one text"),
        ({"comments": None}, "comments must be a list of text, not None"),
        ({"comments": ["by me", 2]}, "comments must be a list of text, not of int"),
        ({"notes": 3}, "notes must be a list of text, not 3"),
        ({"elements": ["faces"]}, "elements must be a list of ExtraElement, not of str"),
        ({"extras": {3: np.zeros(4)}}, "name of an extra column must be text, not 3"),
        ({"extras": [1, 2]}, "extras must be a dictionary of columns by name, not list"),
        ({"extras": {"label": [1, 2]}}, r"extra column 'label' must be \(4,\), not \(2,\)"),
    ],
)
def test_invalid_arrays_are_refused_with_a_clear_message(changes, message):
    with pytest.raises(ModelError, match=message):
        Splats(**arrays_of(random_splats(4)) | changes)


def test_converting_a_model_to_an_array_is_refused():
    with pytest.raises(TypeError, match=r"splats\.means"):
        np.asarray(random_splats(4))


# ---- gsplat ---------------------------------------------------------------------------------


@given(splats(extras=False))
def test_to_gsplat_and_from_gsplat_round_trip(model):
    tensors = model.to_gsplat()
    assert list(tensors) == ["means", "scales", "quats", "opacities", "sh0", "shN"]
    assert tensors["sh0"].shape == (len(model), 1, 3)
    assert all(a.dtype == np.float32 and a.flags.c_contiguous for a in tensors.values())
    back = Splats.from_gsplat(tensors, render_mode=model.render_mode)
    same = replace(model, means=model.means.astype(np.float32), comments=())
    assert_same(back, same)


def test_to_gsplat_copies_the_arrays():
    model = random_splats(3)
    before = model.means.copy()
    model.to_gsplat()["means"] += 1
    np.testing.assert_array_equal(model.means, before)


@pytest.mark.parametrize("given", [None, 3, "splats.pt", random_splats(2)])
def test_from_gsplat_refuses_what_is_no_dictionary(given):
    with pytest.raises(ModelError, match="dictionary of tensors is needed, not "):
        Splats.from_gsplat(given)


def test_from_gsplat_accepts_tensors_colours_and_missing_harmonics():
    model = random_splats(5, degree=2)
    tensors = model.to_gsplat()
    assert_same(Splats.from_gsplat({n: Tensor(a) for n, a in tensors.items()}), model)
    harmonics = {"colors": np.concatenate([tensors.pop("sh0"), tensors.pop("shN")], axis=1)}
    assert_same(Splats.from_gsplat(tensors | harmonics), model)
    rgb = np.random.default_rng(0).uniform(0, 1, (5, 3))
    plain = Splats.from_gsplat(tensors | {"colors": rgb})
    np.testing.assert_allclose(plain.sh[:, 0] * 0.28209479177387814 + 0.5, rgb, atol=1e-6)
    assert plain.sh_degree == 0
    base = Splats.from_gsplat(tensors | {"sh0": model.sh[:, 0], "step": np.zeros(1)})
    assert base.sh_degree == 0
    assert base.notes == ("Left out of gsplat's dictionary: step.",)
    assert Splats.from_gsplat(tensors | harmonics, render_mode=RenderMode.MIP).render_mode == "mip"


def test_from_gsplat_notes_every_name_that_it_leaves_out():
    tensors = random_splats(4).to_gsplat()
    rgb = {"colors": np.eye(4, 3, dtype=int)}
    both = Splats.from_gsplat(tensors | rgb | {3: 3})
    assert both.notes == ("Left out of gsplat's dictionary: 3, colors.",)
    del tensors["sh0"]
    plain = Splats.from_gsplat(tensors | rgb)
    assert plain.notes == ("Left out of gsplat's dictionary: shN.",)
    assert Splats.from_gsplat(tensors | rgb | {"shN": None}).notes == ()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"means": None, "quats": None}, "lacks means, quats; it needs"),
        ({"sh0": None, "shN": None}, r"lacks sh0 \(or colors\)"),
        ({"features": np.zeros((4, 8))}, "come from a network"),
        ({"shN": np.zeros((4, 9))}, r"shN must be \(4, K, 3\), not \(4, 9\)"),
        ({"shN": np.zeros((4, 5, 3))}, "sh must be"),
        ({"scales": np.zeros(4)}, "log_scales must be"),
        (
            {"sh0": None, "shN": None, "colors": np.full((4, 3), 255, np.uint8)},
            "colors must be RGB from 0 to 1, not uint8 up to 255; divide 8-bit values by 255",
        ),
    ],
)
def test_invalid_gsplat_dictionaries_are_refused(changes, message):
    tensors = random_splats(4).to_gsplat() | changes
    with pytest.raises(ModelError, match=message):
        Splats.from_gsplat({name: array for name, array in tensors.items() if array is not None})


# ---- copies and display ---------------------------------------------------------------------


@given(splats())
def test_copies_and_pickles_equal_the_model(model):
    for back in (pickle.loads(pickle.dumps(model)), copy.deepcopy(model), copy.copy(model)):
        assert_same(back, model)
        assert back.elements == () or back.elements[0].name == model.elements[0].name
        assert back.notes == model.notes
        with pytest.raises(TypeError):
            back.extras["new"] = np.zeros(len(model))


def test_a_deep_copy_shares_nothing():
    model = random_splats(3, extras={"label": np.arange(3)})
    other = copy.deepcopy(model)
    other.means[:] = 7
    other.extras["label"][:] = 7
    assert not (model.means == 7).any()
    assert model.extras["label"].tolist() == [0, 1, 2]


def test_repr_describes_the_model_in_one_line():
    model = random_splats(1234, degree=3, extras={"label": np.arange(1234)})
    model.means[0] = np.nan
    model.means[1:] = np.clip(model.means[1:], -0.5, 0.25)
    assert repr(model) == (
        "Splats(1,234 splats; SH degree 3; render mode default;"
        " bounds -0.5 -0.5 -0.5 to 0.25 0.25 0.25; extra columns label)"
    )
    assert repr(model[:0]) == (
        "Splats(0 splats; SH degree 3; render mode default; no bounds; extra columns label)"
    )
    assert repr(model[5]).startswith("Splats(1 splat; ")


def test_a_notebook_shows_an_image_that_is_rendered_once(monkeypatch):
    model = random_splats(300)
    png = model._repr_png_()
    assert png[:4] == b"\x89PNG"
    monkeypatch.setattr(summary, "_render", None)  # rendering again would fail
    assert model._repr_png_() is png
    text = model._repr_html_()
    assert text.startswith('<img src="data:image/png;base64,iVBOR')
    assert text.endswith(f"<div>{model!r}</div>")


def test_the_picture_shows_the_model():
    from io import BytesIO

    from PIL import Image

    image = np.asarray(Image.open(BytesIO(random_splats(300)._repr_png_())))
    assert image.shape == (summary.HEIGHT, summary.WIDTH, 3)
    inside = image[100:220, 180:300]
    assert (inside > 20).any(axis=2).mean() > 0.5
    assert (image[:, :40] > 20).any(axis=2).mean() < 0.1


def test_a_picture_is_rendered_once_until_an_array_changes(monkeypatch):
    model, rendered = random_splats(30), []
    monkeypatch.setattr(
        summary, "_render", lambda splats: rendered.append(1) or splats.sh.tobytes()
    )
    assert model._repr_png_() == model._repr_png_() == model.sh.tobytes()
    assert len(rendered) == 1
    for column in (model.means, model.log_scales, model.quats, model.opacity_logits, model.sh):
        column[-1] += 1
        assert model._repr_png_() == model.sh.tobytes()
    assert len(rendered) == 6


def test_without_an_image_a_notebook_shows_text_and_the_reason(monkeypatch):
    nothing = random_splats(3)[:0]
    assert nothing._repr_png_() is None
    assert "No picture: The model shows nothing" in nothing._repr_html_()

    def fails(_splats):
        raise MemoryError

    monkeypatch.setattr(summary, "_render", fails)
    named = random_splats(3, extras={"<b>": np.zeros(3)})
    assert named._repr_html_() == (
        f"<div>{repr(named).replace('<b>', '&lt;b&gt;')}</div><div>No picture: MemoryError</div>"
    )
