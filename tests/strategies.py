"""Hypothesis strategies that draw models, and comparison of models bit by bit."""

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from nanogs import io
from nanogs.io.ply.header import TYPE_NAMES
from nanogs.splats import ExtraElement, RenderMode, Splats

NAMES = st.sampled_from(["nx", "ny", "nz", "label", "red", "confidence", "f_rest_x", "segment_id"])
DTYPES = st.sampled_from(sorted(TYPE_NAMES)).map(np.dtype)
COMMENTS = st.text(
    st.characters(exclude_categories=["Cs"], exclude_characters="\n\r"), max_size=12
).filter(lambda text: "splatrendermode" not in text.lower())


@st.composite
def columns(draw, n, names=NAMES, max_size=4):
    chosen = draw(st.lists(names, unique=True, max_size=max_size))
    return {name: draw(hnp.arrays(draw(DTYPES), n)) for name in chosen}


@st.composite
def elements(draw):
    rows = draw(st.integers(0, 4))
    table = draw(columns(rows, st.sampled_from("abcde")).filter(bool))
    out = np.empty(rows, [(name, column.dtype) for name, column in table.items()])
    for name, column in table.items():
        out[name] = column
    return ExtraElement(draw(st.sampled_from(["camera", "chunk", "sh"])), out)


@st.composite
def splats(draw, max_n=8, max_degree=4, extras=True, wild=True):
    """Draw a random model; `wild` adds infinite opacities, zero scales and zero quaternions."""
    n = draw(st.integers(1, max_n))
    degree = draw(st.integers(0, max_degree))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    double = draw(st.booleans())
    arrays = {
        "means": rng.normal(size=(n, 3)).astype(np.float64 if double else np.float32),
        "log_scales": rng.normal(-4, 1, (n, 3)).astype(np.float32),
        "quats": rng.normal(size=(n, 4)).astype(np.float32),
        "opacity_logits": rng.normal(0, 3, n).astype(np.float32),
        "sh": rng.normal(0, 0.5, (n, (degree + 1) ** 2, 3)).astype(np.float32),
    }
    if wild:
        rows = hnp.arrays(np.bool_, n)
        arrays["opacity_logits"][draw(rows)] = np.inf
        arrays["opacity_logits"][draw(rows)] = -np.inf
        arrays["log_scales"][draw(rows), 0] = -np.inf
        arrays["quats"][draw(rows)] = 0
    mode = draw(st.sampled_from(RenderMode))
    tag = [] if mode is RenderMode.DEFAULT else [f"SplatRenderMode: {mode}"]
    return Splats(
        **arrays,
        extras=draw(columns(n)) if extras else {},
        render_mode=mode,
        comments=[*draw(st.lists(COMMENTS, max_size=2)), *tag],
        elements=draw(st.lists(elements(), max_size=2, unique_by=lambda e: e.name))
        if extras
        else (),
    )


def table(model):
    """Return all arrays of a model by name."""
    fields = ("means", "log_scales", "quats", "opacity_logits", "sh")
    out = {name: getattr(model, name) for name in fields}
    out |= {f"extra {name}": column for name, column in model.extras.items()}
    return out | {f"element {element.name}": element.rows for element in model.elements}


def assert_same(a, b):
    """Check that two models are the same bit by bit, NaN included, except for their notes."""
    left, right = table(a), table(b)
    assert set(left) == set(right)
    for name, column in left.items():
        assert column.dtype == right[name].dtype, name
        assert column.shape == right[name].shape, name
        assert column.tobytes() == right[name].tobytes(), name
    assert a.render_mode is b.render_mode
    assert a.comments == b.comments


def assert_written_alike(model, name, most):
    """Check that passing the derived spare bits gives the same file, and 0 of them a larger one."""
    for options in ({}, {"bits": 5}):
        derived = io.derived_options(model, name, options)
        assert derived["spare_bits"] in range(1, most + 1)
        by_default, explicit = (
            io.round_trip_with_size(model, name, o) for o in (options, options | derived)
        )
        assert_same(by_default[0], explicit[0])
        finer = io.round_trip_with_size(model, name, {**options, "spare_bits": 0})
        assert finer[1] > by_default[1] == explicit[1]
