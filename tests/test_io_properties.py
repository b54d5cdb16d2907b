"""Random round trips and randomly damaged files."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from damage import TEXT, mutate, outcome
from nanogs import io
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
