"""Random round trips and randomly damaged files."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import HealthCheck, given, reject, settings
from hypothesis import strategies as st

from builders import random_splats
from damage import TEXT, mutate, outcome
from nanogs import io
from nanogs.activations import rotations
from nanogs.errors import OptionError
from nanogs.io import registry
from plyfiles import BASE, ENCODINGS, ply, vertex
from strategies import assert_same, splats

SHARED = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    deadline=None,
    max_examples=80,
)


@SHARED
@given(model=splats())
def test_saving_and_loading_keeps_every_bit(tmp_path, model):
    first, second = tmp_path / "a.ply", tmp_path / "b.ply"
    io.save(model, first, overwrite=True)
    loaded = io.load(first)
    assert_same(model, loaded)
    io.save(loaded, second, overwrite=True)
    assert first.read_bytes() == second.read_bytes()


# Every format that is both read and written.
BOTH_WAYS = [known for known in registry.formats() if known.readable and known.writable]


def written(model, folder, known, options):
    """Write a model to a new folder; return the bytes of each file, and the model that is read."""
    folder.mkdir(exist_ok=True)
    path = folder / (known.suffix if known.write_folder else f"a{known.suffix}")
    io.save(model, path, overwrite=True, format_options=options)
    files = folder.iterdir() if known.write_folder else [path]
    return {file.name: file.read_bytes() for file in files}, io.load(path)


def assert_stable(model, folder, known, options):
    """Check that a file which is read and written again does not change."""
    first, loaded = written(model, folder / "first", known, options)
    second, again = written(loaded, folder / "second", known, options)
    assert_same(loaded, again)
    assert first == second


def format_options(known):
    """Draw some options of a format."""
    values = {name: st.sampled_from(option.values) for name, option in known.options.items()}
    return st.fixed_dictionaries({}, optional=values)


@st.composite
def hard_to_round(draw):
    """Draw a model; often, rotations have several equally good codes, or colours hardly differ."""
    model = draw(splats(max_n=30))
    rng = np.random.default_rng(len(model))
    if draw(st.booleans()):
        noise = rng.normal(0, draw(st.sampled_from([0, 2e-3])), (len(model), 4))
        quats = rng.choice([-1, 0, 0.3, 1], (len(model), 4)) + noise
        model = replace(model, quats=quats.astype(np.float32))
    if draw(st.booleans()):
        near = model.sh[:1] + rng.normal(0, 1e-6, (len(model), 1, 1))
        model = replace(model, sh=near.astype(np.float32))
    return model


def forms():
    """Yield the suffix and the options of each format, with every choice of bits and versions."""
    for known in BOTH_WAYS:
        some = {name: known.options[name].values for name in ("bits", "spz_version")
                if name in known.options}  # fmt: skip
        for values in product(*some.values()):
            yield known, dict(zip(some, values, strict=True))


@pytest.mark.parametrize(("known", "options"), list(forms()))
def test_quarter_turns_stay_quarter_turns(tmp_path, known, options):
    """Two components are equally large, and that which is stored has the first or last code."""
    pairs = [(i, j, sign) for i in range(4) for j in range(i) for sign in (1, -1)]
    model = random_splats(len(pairs), degree=0)
    model.quats[:] = 0
    for number, (i, j, sign) in enumerate(pairs):
        model.quats[number, [i, j]] = 1, sign
    model.log_scales[:] = -2, -4, -6
    model.means[:, 0] = np.arange(len(pairs))
    _, found = written(model, tmp_path / "a", known, options)
    found = found.take(np.argsort(found.means[:, 0]))  # some formats sort the rows
    assert covariances(found) == pytest.approx(covariances(model), abs=0.1 * np.exp(-4))


def covariances(model):
    axes = rotations(model.unit_quats().astype(np.float64)) * model.scales()[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


@pytest.mark.parametrize("known", BOTH_WAYS, ids=lambda known: known.suffix)
@settings(SHARED, max_examples=30)
@given(data=st.data(), model=hard_to_round())
def test_a_file_that_is_read_and_written_again_does_not_change(tmp_path, known, data, model):
    try:
        assert_stable(model, tmp_path, known, data.draw(format_options(known)))
    except OptionError:  # options that exclude each other
        reject()


@pytest.mark.parametrize(
    ("suffix", "options"),
    [
        *((known.suffix, {}) for known in BOTH_WAYS),
        *((".spz", {"spz_version": version}) for version in (2, 4)),
        *((".spz", {"bits": bits}) for bits in (4, 5, 6, 7)),
        *((".spz", {"bits": bits, "spz_version": 3}) for bits in (4, 7)),
        (".spz", {"bits": 5, "palette": 50, "sh_bits": 2}),
        *((".sog", {"bits": bits}) for bits in (4, 5, 6, 8)),
        (".sog", {"palette": 50}),
    ],
    ids=str,
)
def test_a_larger_file_does_not_change_either(tmp_path, suffix, options):
    [known] = [each for each in BOTH_WAYS if each.suffix == suffix]
    model = random_splats(2500, degree=2)
    model.quats[1200:] = np.round(model.quats[1200:] / 0.7) * 0.7
    model.log_scales[:9, 1] = -np.inf
    model.opacity_logits[:20] = np.repeat([np.inf, -np.inf], 10)
    model.sh[100:300] *= 3
    model.means[300:310] *= 1000
    assert_stable(model, tmp_path, known, options)


@SHARED
@given(data=st.data(), encoding=st.sampled_from(ENCODINGS))
def test_all_encodings_give_the_same_values(tmp_path, data, encoding):
    floats = st.floats(width=32, allow_nan=False)
    columns = [
        (name, kind, np.array(data.draw(st.lists(floats, min_size=3, max_size=3)), np.float32))
        for name, kind, _ in vertex()
    ]
    models = []
    for kind in ("binary_little_endian", encoding):
        (tmp_path / "a.ply").write_bytes(ply(("vertex", columns), encoding=kind))
        models.append(io.load(tmp_path / "a.ply"))
    assert_same(*models)


def packed():
    bounds = [f"{e}_{s}{a}" for s in ("", "scale_") for e in ("min", "max") for a in "xyz"]
    words = ["position", "rotation", "scale", "color"]
    return ply(
        ("chunk", [(name, "float", np.ones(1)) for name in bounds]),
        ("vertex", [(f"packed_{word}", "uint", np.arange(3)) for word in words]),
        ("sh", [(f"f_rest_{i}", "uchar", np.arange(3)) for i in range(9)]),
    )


SEEDS = [ply(("vertex", vertex(3, [*BASE, "a"], {"a": "short"})), encoding=e) for e in ENCODINGS]
SEEDS += [packed()]


@pytest.mark.parametrize("seed", range(len(SEEDS)))
def test_damaged_files_give_a_format_error_or_a_model(tmp_path, seed):
    rng, path = np.random.default_rng(seed), tmp_path / "fuzz.ply"
    path.write_bytes(SEEDS[seed])
    assert len(io.load(path)) == 3
    outcomes = {"model": 0, "refused": 0}
    for _ in range(400):
        path.write_bytes(mutate(rng, SEEDS[seed], header=420, anywhere=0.3, text=TEXT))
        outcomes[outcome(path)] += 1
    assert min(outcomes.values()) > 0
