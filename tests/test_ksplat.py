"""Decoding `.ksplat`: files built by hand in every mode, damaged ones, and another program's."""

import math
import struct
import tracemalloc

import numpy as np
import pytest

from builders import random_splats
from damage import outcome
from ksplatfiles import C0, WIDTH, ksplat, section
from nanogs import io
from nanogs.errors import FormatError


@pytest.fixture
def load(tmp_path):
    def load(data):
        (tmp_path / "a.ksplat").write_bytes(data)
        return io.load(tmp_path / "a.ksplat")

    return load


TOLERANCE = {"means": (0, 1e-4, 1e-4), "log_scales": (1e-6, 1e-3, 1e-3), "sh": (1e-6, 1e-3, 9e-3)}


def assert_close(model, again, mode):
    for name in ("means", "log_scales"):
        assert getattr(again, name) == pytest.approx(
            getattr(model, name), abs=TOLERANCE[name][mode]
        )
    inside = (model.sh[:, 0] * C0 + 0.5).clip(0, 1)
    assert again.sh[:, 0] * C0 + 0.5 == pytest.approx(inside, abs=0.51 / 255)
    rest = model.sh[:, 1:].clip(-2, 2) if mode == 2 else model.sh[:, 1:]
    assert again.sh[:, 1:] == pytest.approx(rest, abs=TOLERANCE["sh"][mode])
    assert again.opacities() == pytest.approx(model.opacities(), abs=0.51 / 255)
    assert np.abs(again.unit_quats() - model.unit_quats()).max() < (1e-6 if mode == 0 else 1e-3)


@pytest.mark.parametrize("mode", range(3))
@pytest.mark.parametrize("degree", range(4))
def test_all_modes_and_degrees_are_read(load, tmp_path, mode, degree):
    part = section(23, mode, degree)
    again = load(ksplat(part, mode=mode))
    assert_close(part[2], again, mode)
    info = io.inspect(tmp_path / "a.ksplat")
    assert (info.splats, info.sh_degree, info.format) == (23, degree, "ksplat")
    kinds = {
        0: ("float", "float", "float", "uchar", "float"),
        1: ("ushort", "float16", "float16", "uchar", "float16"),
        2: ("ushort", "float16", "float16", "uchar", "uchar"),
    }[mode]
    names = ("mean", "scale", "quat", "rgba", "sh")[: 4 + (degree > 0)]
    assert info.properties == tuple(zip(names, kinds, strict=False))
    assert again.notes == ()


@pytest.mark.parametrize("mode", range(3))
def test_sections_follow_each_other_and_empty_rows_are_skipped(load, mode):
    parts = [section(n, mode, 1, seed=n, spare=spare) for n, spare in ((9, 2), (0, 0), (5, 0))]
    parts[1] = section(0, mode, 2)  # the degree of no splats
    again = load(ksplat(*parts, mode=mode))
    for part, rows in ((parts[0][2], slice(0, 9)), (parts[2][2], slice(9, 14))):
        assert_close(part, again.take(np.arange(14)[rows]), mode)


@pytest.mark.parametrize("mode", range(3))
def test_reading_in_blocks_gives_the_same_model(load, monkeypatch, mode):
    data = ksplat(section(50, mode, 2), mode=mode)
    whole = load(data)
    monkeypatch.setattr("nanogs.io.parts.BLOCK_ROWS", 7)
    assert np.array_equal(load(data).means, whole.means)
    assert np.array_equal(load(data).sh, whole.sh)


def test_extreme_alpha_and_scale_are_infinite_and_negative_scale_is_noted(load):
    header, body, model = section(2, 0, 0)
    rows = np.frombuffer(bytearray(body), np.uint8).reshape(2, 44)
    rows[:, 43] = [0, 255]
    rows[0, 12:16], rows[1, 12:16] = 0, list(struct.pack("<f", -1))
    again = load(ksplat((header, rows.tobytes(), model)))
    assert again.opacity_logits.tolist() == [-math.inf, math.inf]
    assert again.log_scales[0, 0] == -math.inf
    assert math.isnan(again.log_scales[1, 0])
    assert again.notes == ("1 splat has a negative scale, which became NaN.",)


def test_negative_scales_of_all_blocks_are_counted(load, monkeypatch):
    monkeypatch.setattr("nanogs.io.parts.BLOCK_ROWS", 2)
    header, body, model = section(5, 0, 0)
    rows = np.frombuffer(bytearray(body), np.uint8).reshape(5, 44)
    rows[:3, 12:16] = list(struct.pack("<f", -1))
    again = load(ksplat((header, rows.tobytes(), model)))
    assert again.notes == ("3 splats have a negative scale, which became NaN.",)


def test_ranges_of_zero_mean_the_defaults(load):
    changed = section(6, 2, 1, changes={24: ("<I", 0)})
    expected = section(6, 2, 1)
    same = load(ksplat(changed, mode=2, sh_range=(0, 0)))
    other = load(ksplat(expected, mode=2, sh_range=(-1.5, 1.5)))
    assert np.array_equal(same.means, other.means)
    assert np.array_equal(same.sh, other.sh)


def test_centres_are_steps_of_the_stated_range(load):
    steps = 1000
    header, body, model = section(4, 1, 0, changes={24: ("<I", steps)})
    centre, rows = (
        np.frombuffer(body[:12], "<f4"),
        np.frombuffer(body[12:], np.uint8).reshape(4, -1),
    )
    stored = np.ascontiguousarray(rows[:, :6]).view("<u2").astype(float)
    expected = centre + (stored - steps) * (WIDTH / 2 / steps)
    assert load(ksplat((header, body, model), mode=1)).means == pytest.approx(expected, rel=1e-6)


def test_bytes_after_the_last_section_are_noted(load):
    assert load(ksplat(section(3, 0, 0)) + b"12345").notes == (
        "Left out: 5 bytes after the last section.",
    )


HUGE = 0xFFFFFFFF
REFUSED = {
    "short": (lambda: ksplat(section(3, 0, 0))[:4000], "less than the 4096"),
    "cut": (lambda: ksplat(section(3, 0, 0))[:-1], "cut short: section 0"),
    "no section headers": (lambda: ksplat(section(3, 0, 0))[:5000], "section headers do not fit"),
    "no sections": (ksplat, "damaged or empty"),
    "older version": (lambda: ksplat(section(3, 0, 0), version=(0, 0)), "not 0.0"),
    "version": (lambda: ksplat(section(3, 0, 0), version=(1, 0)), "not 1.0"),
    "mode": (lambda: ksplat(section(3, 0, 0), mode=3), "mode 3"),
    "count": (lambda: ksplat(section(3, 0, 0), count=4), "counts 4 splats"),
    "degree": (lambda: ksplat(section(3, 0, 0, changes={40: ("<H", 4)})), "SH degrees"),
    "degrees": (lambda: ksplat(section(3, 0, 0), section(3, 0, 1)), r"degrees \[0, 1\]"),
    "splats": (lambda: ksplat(section(3, 0, 0, changes={0: ("<I", 4)}), count=4), "4 splats in 3"),
    "rows": (lambda: ksplat(section(3, 0, 0, changes={4: ("<I", HUGE)})), "cut short"),
    "buckets": (lambda: ksplat(section(9, 1, 0, changes={12: ("<I", HUGE)}), mode=1), "cut short"),
    "full": (
        lambda: ksplat(section(9, 1, 0, changes={32: ("<I", HUGE)}), mode=1),
        "an impossible layout",
    ),
    "capacity": (lambda: ksplat(section(9, 1, 0, changes={8: ("<I", 0)}), mode=1), "buckets of a"),
    "bucket bytes": (
        lambda: ksplat(section(9, 1, 0, changes={20: ("<H", 8)}), mode=1),
        "an impossible layout",
    ),
    "wider buckets": (
        lambda: ksplat(section(9, 1, 0, changes={20: ("<H", 16)}), mode=1) + bytes(12),
        "an impossible layout",
    ),
    "partly filled": (
        lambda: ksplat(section(9, 1, 0, changes={12: ("<I", 2)}), mode=1),
        "an impossible layout",
    ),
    "width": (
        lambda: ksplat(section(9, 1, 0, changes={16: ("<f", math.nan)}), mode=1),
        "an impossible layout",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_contradicting_headers_are_refused(load, name):
    make, words = REFUSED[name]
    with pytest.raises(FormatError, match=words) as caught:
        load(make())
    assert "convert" in str(caught.value)


@pytest.mark.parametrize("mode", range(3))
def test_damaged_files_give_a_format_error_or_a_model(tmp_path, mode):
    rng, path = np.random.default_rng(mode), tmp_path / "fuzz.ksplat"
    data = ksplat(*(section(n, mode, 1, seed=n) for n in (9, 4)), mode=mode)
    offsets = [*range(48), *range(4096, 4140), *range(5120, 5164), *range(6144, len(data))]
    outcomes = {"model": 0, "refused": 0}
    tracemalloc.start()
    for _ in range(300):
        damaged = bytearray(data)
        for offset in rng.choice(offsets, rng.integers(1, 4)):
            damaged[offset] = rng.choice([0, 1, 255, rng.integers(256)])
        path.write_bytes(
            damaged[: None if rng.random() < 0.7 else rng.integers(len(damaged))] or b"\0"
        )
        outcomes[outcome(path)] += 1
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert min(outcomes.values()) > 0
    assert peak < 20_000_000


@pytest.mark.parametrize("degree", [0, 1])
def test_files_written_by_gaussforge_are_read(load, tmp_path, degree):
    """Gaussforge 0.6 writes mode 0, with bands above the first in another order than the format's.

    GaussianSplats3D and splat-transform read those as this reader does, so they are no reference.
    """
    gaussforge = pytest.importorskip("gaussforge")
    model = random_splats(200, degree=degree, seed=degree)
    model.sh[:] *= 0.3
    io.save(model, tmp_path / "a.ply")
    data = gaussforge.GaussForge().convert((tmp_path / "a.ply").read_bytes(), "ply", "ksplat")
    again = load(bytes(data["data"]))
    assert np.array_equal(again.means, model.means)
    assert np.array_equal(again.sh[:, 1:], model.sh[:, 1:])
    assert again.log_scales == pytest.approx(model.log_scales, abs=1e-6)
    assert again.opacities() == pytest.approx(model.opacities(), abs=1.01 / 255)
    assert again.sh[:, 0] == pytest.approx(model.sh[:, 0], abs=1.01 / 255 / C0)
