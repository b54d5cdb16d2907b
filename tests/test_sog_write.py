"""Encoding SOG: round trips, and the errors of codebooks and palettes."""

import itertools
import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from conftest import scene_path
from nanogs import io
from nanogs.errors import OptionError, OutputError
from nanogs.io.palette import palette
from nanogs.io.precision import visibility
from nanogs.io.rotations import minimise_rotation
from nanogs.io.sog import rounding
from nanogs.io.sog import write as sog_write
from nanogs.io.sog.codebook import codebook, nearest
from nanogs.io.sog.options import USUAL_PALETTE
from nanogs.io.spz.centres import spare_bits as spz_spare_bits
from nanogs.source import InMemory
from nanogs.splats import ExtraElement, RenderMode, Splats, concatenate
from nanogs.threads import most_threads, use_threads
from strategies import assert_same, assert_written_alike, splats


def random_model(n=3000, degree=2, seed=0):
    rng = np.random.default_rng(seed)
    return Splats(
        means=rng.normal(0, 3, (n, 3)).astype(np.float32),
        log_scales=rng.normal(-4, 1, (n, 3)).astype(np.float32),
        quats=rng.normal(size=(n, 4)).astype(np.float32),
        opacity_logits=rng.normal(0, 3, n).astype(np.float32),
        sh=rng.normal(0, 0.5, (n, (degree + 1) ** 2, 3)).astype(np.float32),
    )


def saved(tmp_path, model, name="a.sog", **options):
    io.save(model, tmp_path / name, overwrite=True, format_options=options)
    return io.load(tmp_path / name)


def in_order_of(model, other):
    """Return `other` in the order of `model`, matched by centres, with the most similar axes."""
    rows = cKDTree(other.means).query(model.means)[1]
    assert sorted(rows) == list(range(len(model)))
    return with_axes_of(model, other.take(rows))


def product(a, b):
    """Product of quaternions, wxyz."""
    w, v, x, u = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    real = w * x - (v * u).sum(axis=1, keepdims=True)
    return np.hstack([real, w * u + x * v + np.cross(v, u)])


def with_axes_of(model, other):
    """Return `other` with each splat written in the one of 24 ways that is nearest to `model`."""
    quats = model.unit_quats().astype(float)
    between = product(quats * [1, -1, -1, -1], other.unit_quats().astype(float))
    turned, scales = minimise_rotation(replace(other, quats=between.astype(np.float32)))
    return replace(other, quats=product(quats, turned).astype(np.float32), log_scales=scales)


def angle(a, b):
    """Angles between the rotations of two models, in radians."""
    cosine = np.abs((a.unit_quats().astype(float) * b.unit_quats()).sum(axis=1))
    return 2 * np.arccos(cosine.clip(0, 1))


@settings(max_examples=40)
@given(model=splats(max_n=30, max_degree=3, extras=False))
def test_round_trip_is_within_the_quantisation(tmp_path_factory, model):
    back = in_order_of(model, saved(tmp_path_factory.mktemp("sog"), model))
    logarithms = [np.log1p(np.abs(m.means)) for m in (model, back)]
    assert np.abs(logarithms[0] - logarithms[1]).max() < 3e-3
    assert angle(model, back).max() < 0.034  # half a step of 4 / 255 √2 in three parts
    # So few values that each has its own codebook entry.
    scales = np.where(np.isneginf(model.log_scales), back.log_scales, model.log_scales)
    assert np.array_equal(scales, back.log_scales)
    assert np.array_equal(model.sh[:, 0], back.sh[:, 0])
    error = np.abs(model.sh[:, 1:] - back.sh[:, 1:])
    assert error.max(initial=0) < 0.1  # the palette has room for every splat
    assert np.abs(model.opacities() - back.opacities()).max() <= 0.5 / 255 + 1e-9
    for infinite in (np.isposinf, np.isneginf):
        assert infinite(back.opacity_logits)[infinite(model.opacity_logits)].all()
    assert back.render_mode is model.render_mode


def test_a_scale_of_zero_stays_far_below_all_others(tmp_path):
    model = random_model(500, 0)
    model.log_scales[7, 1] = -np.inf
    loaded = in_order_of(model, saved(tmp_path, model))
    others = np.delete(loaded.log_scales, 7, axis=0)
    assert loaded.log_scales[7, 1] == pytest.approx(others.min() - 20, abs=0.5)


def test_palette_entries_that_rounding_makes_equal_are_written_once(tmp_path):
    model = random_model(40, 1)
    model.sh[20:, 1:] = model.sh[:20, 1:] + np.float32(1e-7)
    saved(tmp_path, model)
    meta = json.loads(zipfile.ZipFile(tmp_path / "a.sog").read("meta.json"))
    assert meta["shN"]["count"] == 20


@pytest.mark.parametrize("n", [1, 2, 15, 16, 17, 1025])
@pytest.mark.parametrize("degree", [0, 3])
def test_any_count_can_be_written(tmp_path, n, degree):
    model = random_model(n, degree)
    loaded = saved(tmp_path, model)
    assert len(loaded) == n
    assert loaded.sh_degree == degree


def test_coincident_splats_keep_their_position(tmp_path):
    model = replace(random_model(50, 1), means=np.ones((50, 3), np.float32))
    assert saved(tmp_path, model).means == pytest.approx(np.ones((50, 3)))


@pytest.mark.parametrize("mode", RenderMode)
def test_render_mode_is_kept(tmp_path, mode):
    assert saved(tmp_path, replace(random_model(9), render_mode=mode)).render_mode is mode


def test_losses_are_reported(tmp_path):
    model = random_model(20, 4)
    extras = {"label": np.arange(20)}
    camera = ExtraElement("camera", np.zeros(1, [("x", "f4")]))
    model = replace(model, extras=extras, elements=[camera])
    assert io.losses(model, "a.sog") == (
        "Extra columns are left out, .sog has no room for them: label.",
        "Further elements are left out, .sog has no room for them: camera.",
        "Spherical harmonics above degree 3 are left out, .sog holds no more.",
    )
    loaded = saved(tmp_path, model)
    assert (len(loaded), loaded.sh_degree) == (20, 3)
    assert io.losses(random_model(20, 3), "a.sog") == ()


@pytest.mark.parametrize("name", ["a.sog", "a/meta.json"])
@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("means", np.nan, "1 splat holds NaN or infinite values, the first in row 2"),
        ("log_scales", 100.0, "1 splat holds NaN or infinite values, the first in row 2"),
        ("log_scales", -3e38, "log-scales beyond ±1e\\+18, the first in row 2"),
        ("sh", 1e30, "1 splat holds colour coefficients or log-scales beyond .*write .ply"),
    ],
)
def test_values_that_cannot_be_stored_are_refused_before_writing(
    tmp_path, name, column, value, message
):
    model = random_model(3, 1)
    getattr(model, column).reshape(3, -1)[2, -1] = value
    with pytest.raises(OutputError, match=message):
        io.save(model, tmp_path / name)
    assert not list(tmp_path.iterdir())
    refused = "NaN or infinite" if "NaN" in message else "colour coefficients or log-scales beyond"
    [loss] = io.losses(model, name)
    assert loss.startswith(f"1 splat holds {refused} ")
    assert loss.endswith(" refuses the model.")


def test_a_model_of_no_splats_is_refused(tmp_path):
    with pytest.raises(OutputError, match="no splats"):
        io.save(random_model(3).take(slice(0)), tmp_path / "a.sog")
    assert not list(tmp_path.iterdir())


def test_values_at_the_limit_are_kept(tmp_path):
    model = random_model(300, 1)
    model.means[7] = (1e30, -3.4e38, 1e-38)
    model.sh[5, 0, 0], model.sh[6, 3, 1] = 1e18, -1e18
    model.log_scales[9, 2] = -1e18
    loaded = saved(tmp_path, model)
    assert len(loaded) == 300
    assert loaded.finite().all()
    assert loaded.sh[:, 0].max() == np.float32(1e18)
    assert loaded.sh[:, 3].min() == pytest.approx(-1e18)
    assert loaded.means[:, 1].min() == pytest.approx(-3.4e38, rel=1e-3)


@pytest.mark.skipif(most_threads() < 2, reason="this machine has one thread")
def test_bytes_do_not_depend_on_the_number_of_threads(tmp_path):
    model = random_model(5000, 3)
    written = []
    for threads in (1, 2, None):
        with use_threads(threads):
            io.save(model, tmp_path / "a.sog", overwrite=True)
        written.append((tmp_path / "a.sog").read_bytes())
    assert written[0] == written[1] == written[2]


def test_zip_entries_are_uncompressed_and_have_a_fixed_date(tmp_path):
    saved(tmp_path, random_model(100))
    with zipfile.ZipFile(tmp_path / "a.sog") as bundle:
        assert bundle.namelist()[-1] == "meta.json"
        for entry in bundle.infolist():
            assert entry.compress_type == zipfile.ZIP_STORED
            assert entry.date_time == (1980, 1, 1, 0, 0, 0)


def test_unused_codebook_entries_are_zeros(tmp_path):
    saved(tmp_path, random_model(5))
    with zipfile.ZipFile(tmp_path / "a.sog") as bundle:
        meta = json.loads(text := bundle.read("meta.json"))
    for name, used in (("scales", 15), ("sh0", 15), ("shN", 64)):
        book = meta[name]["codebook"]
        assert len(book) == 256
        assert len(np.unique(book[:used])) == used
        assert book[used:] == [0] * (256 - used)
    assert b",0,0," in text
    assert len(text) < 4000


def test_write_folder_replaces_only_folders_made_by_nanogs(tmp_path):
    model, path = random_model(100), tmp_path / "m"
    sog_write.write_folder(model, path)
    assert_same(io.load(path / "meta.json"), saved(tmp_path, model))
    with pytest.raises(OutputError, match="overwrite=True"):
        sog_write.write_folder(model, path)
    sog_write.write_folder(replace(model, sh=model.sh[:, :1]), path, overwrite=True)
    assert max(entry.name for entry in path.iterdir()) == "sh0.webp"
    (path / "mine.txt").touch()
    with pytest.raises(OutputError, match=r"'mine\.txt', which nanogs did not make"):
        sog_write.write_folder(model, path, overwrite=True)
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "meta.json").write_text('{"asset": {"generator": "another"}}')
    with pytest.raises(OutputError, match="did not make"):
        sog_write.write_folder(model, foreign, overwrite=True)


def test_saving_as_meta_json_makes_a_folder(tmp_path):
    model = random_model(100, 1)
    io.save(model, tmp_path / "m" / "meta.json")
    assert_same(io.load(tmp_path / "m" / "meta.json"), saved(tmp_path, model))
    assert io.losses(model, tmp_path / "m" / "meta.json") == io.losses(model, "a.sog")
    for refused in (io.check_writable, lambda path: io.save(model, path)):
        with pytest.raises(OutputError, match="overwrite=True"):
            refused(tmp_path / "m" / "meta.json")
        with pytest.raises(OutputError, match="did not make"):
            refused(tmp_path / "meta.json")  # beside a.sog
        with pytest.raises(OutputError, match="does not exist"):
            refused(tmp_path / "no" / "m" / "meta.json")
        with pytest.raises(OptionError, match=r"is called meta\.json"):
            refused(tmp_path / "m.meta.json")
        with pytest.raises(OptionError, match="nanogs lod"):
            refused(tmp_path / "m" / "lod-meta.json")
    small = replace(model, sh=model.sh[:, :1])
    io.check_writable(tmp_path / "m" / "meta.json", overwrite=True)
    io.save(small, tmp_path / "m" / "meta.json", overwrite=True)
    assert io.load(tmp_path / "m" / "meta.json").sh_degree == 0
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a.sog", "m"]


def test_ours_lists_no_files_outside_the_folder(tmp_path):
    described = {"asset": {"generator": "nanogs"}, "means": {"files": ["../a", "b.webp", 5]}}
    (tmp_path / "meta.json").write_text(json.dumps(described))
    assert sog_write.ours(tmp_path) == {"meta.json", "b.webp", "5"}


def test_a_folder_of_another_program_is_not_ours(tmp_path):
    for name in ("nanogs2 1.0", "nanogs-viewer", "NanoGS 1.0"):
        described = {"asset": {"generator": name}, "means": {"files": ["b.webp"]}}
        (tmp_path / "meta.json").write_text(json.dumps(described))
        assert sog_write.ours(tmp_path) is None


def test_groups_stay_together_and_in_their_order(tmp_path):
    model = random_model(60, 0)
    groups = np.arange(60) * 7 % 3
    with sog_write.encoders() as pool:
        files = sog_write.start_encoding(pool, model, groups)()
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    loaded = io.load(tmp_path / "meta.json")
    rows = cKDTree(model.means).query(loaded.means)[1]
    assert groups[rows].tolist() == [0] * 20 + [1] * 20 + [2] * 20
    whole = cKDTree(model.means).query(saved(tmp_path, model).means)[1]
    for group in range(3):  # Morton order within
        assert rows[groups[rows] == group].tolist() == whole[groups[whole] == group].tolist()


def squared_error(values, runs):
    return sum(((values[a:b] - values[a:b].mean()) ** 2).sum() for a, b in itertools.pairwise(runs))


@given(seed=st.integers(0, 2**32 - 1), bins=st.integers(1, 9), data=st.data())
def test_cuts_minimise_the_squared_error(seed, bins, data):
    from nanogs.kernels.quantise import optimal_cuts

    runs = data.draw(st.integers(1, bins))
    centres = np.sort(np.random.default_rng(seed).normal(size=bins))
    cuts = np.empty(runs + 1, np.int64)
    optimal_cuts(centres, np.ones(bins), cuts)
    assert (np.diff(cuts) > 0).all()
    every = itertools.combinations(range(1, bins), runs - 1)
    best = min(squared_error(centres, (0, *inner, bins)) for inner in every)
    assert squared_error(centres, cuts) == pytest.approx(best, abs=1e-9)


def test_an_outlier_does_not_spoil_the_codebook():
    values = np.random.default_rng(1).normal(size=100_000).astype(np.float32)
    values[0] = 1000  # an outlier must not take the entries from all others
    book = codebook(values)
    error = np.abs(values - book[nearest(values, book)])
    assert np.quantile(error, 0.999) < 0.1
    assert np.square(error).mean() < 4e-4
    assert (np.diff(book) >= 0).all()


@pytest.mark.parametrize("count", [255, 256, 257])
def test_as_many_values_as_a_codebook_has_entries_are_kept(count):
    values = np.sqrt(np.arange(count, dtype=np.float32))
    book = codebook(values)
    assert book.shape == (256,)
    assert np.array_equal(book[nearest(values, book)], values) == (count <= 256)


@given(seed=st.integers(0, 2**32 - 1), used=st.integers(0, 255))
def test_bounds_below_each_value_are_counted(seed, used):
    from nanogs.kernels.quantise import count_lower

    rng = np.random.default_rng(seed)
    bounds = np.full(255, np.inf)
    bounds[:used] = np.sort(rng.integers(-40, 40, used)) / 4  # some of them equal, or equal values
    values = np.append(rng.integers(-44, 44, 300) / 4, [-np.inf, np.inf]).astype(np.float32)
    codes = np.empty(len(values), np.uint8)
    count_lower(values, bounds, codes)
    assert codes.tolist() == np.searchsorted(bounds, values).tolist()


def test_nearest_finds_the_nearest_codebook_entry():
    rng = np.random.default_rng(2)
    book = np.sort(rng.normal(size=256)).astype(np.float32)
    values = rng.normal(size=(500, 3)).astype(np.float32)
    indices = nearest(values, book)
    every = np.abs(values[..., None].astype(float) - book)
    assert np.abs(values - book[indices]) == pytest.approx(every.min(axis=-1))


def lloyd(points, size, rounds=10):
    """Return the squared error of plain k-means, started from random points."""
    rng = np.random.default_rng(0)
    centres = points[rng.choice(len(points), size, replace=False)].astype(float)
    for _ in range(rounds):
        labels = cKDTree(centres).query(points)[1]
        for k in np.unique(labels):
            centres[k] = points[labels == k].mean(axis=0)
    return np.square(cKDTree(centres).query(points)[0]).sum()


@pytest.mark.parametrize("dimensions", [9, 24])
def test_palette_is_about_as_good_as_plain_k_means(dimensions):
    rng = np.random.default_rng(4)
    clusters = rng.normal(size=(40, dimensions)) * 2
    points = (clusters[rng.integers(40, size=4000)] + rng.normal(size=(4000, dimensions))) / 9
    points = points.astype(np.float32)
    found = palette(points, 600)
    assert len(found.entries) <= 600
    error = np.square(points - found.entries[found.labels]).sum()
    assert error < 1.06 * lloyd(points, 600)


def test_palette_is_exact_if_all_points_fit():
    rng = np.random.default_rng(5)
    points = rng.normal(size=(300, 9)).astype(np.float32)[rng.integers(300, size=2000)]
    found = palette(points, 512)
    assert np.array_equal(found.entries[found.labels], points)
    assert len(found.entries) == len(np.unique(points, axis=0))
    assert found.labels[0] == 0  # in the order of first use


@pytest.mark.parametrize("size", [1, 7, 100, 1000, 1100])
def test_the_palette_has_the_requested_number_of_entries(tmp_path, size):
    model = random_model(1100, 1)
    options = {"palette": size}
    io.save(model, tmp_path / "a.sog", format_options=options)
    io.save(model, tmp_path / "m" / "meta.json", format_options=options)
    described = json.loads((tmp_path / "m" / "meta.json").read_text())
    assert described["shN"]["count"] == size
    loaded = io.load(tmp_path / "a.sog")
    assert_same(io.load(tmp_path / "m" / "meta.json"), loaded)
    assert len(np.unique(loaded.sh[:, 1:], axis=0)) == size
    assert io.encoded_bytes(model, tmp_path / "a.sog", options) == (
        (tmp_path / "a.sog").stat().st_size
    )


def test_the_default_palette_size_grows_with_the_model():
    counts = [1, 1000, 1500, 1650, 98_304, 10**7]
    sizes = [USUAL_PALETTE.entries(count) for count in counts]
    assert sizes == [1024, 1024, 1024, 1100, 65_536, 65_536]


@pytest.mark.parametrize("size", [0, 65_537, 3.5, True, "9"])
def test_a_palette_beyond_the_format_is_refused(tmp_path, size):
    with pytest.raises(OptionError, match="`palette` must be a whole number from 1 to 65,536"):
        io.save(random_model(9, 1), tmp_path / "a.sog", format_options={"palette": size})
    assert not list(tmp_path.iterdir())


def test_points_of_higher_weight_get_smaller_errors():
    rng = np.random.default_rng(6)
    points = rng.normal(size=(4000, 9)).astype(np.float32)
    heavy = np.arange(4000) < 400
    found = palette(points, 512, np.where(heavy, 100.0, 1.0))
    error = np.square(points - found.entries[found.labels]).sum(axis=1)
    assert error[heavy].mean() < 0.5 * error[~heavy].mean()


def test_invisible_splats_are_written_too(tmp_path):
    model = replace(random_model(900, 1), opacity_logits=np.full(900, -np.inf, np.float32))
    assert len(saved(tmp_path, model)) == 900


def test_a_palette_of_unevenly_spaced_points_has_a_small_error():
    points = np.zeros((5000, 9), np.float32)
    points[:, 0] = np.arange(5000) ** 3 / 1e9  # crowded at one end
    found = palette(points, 4096)
    assert len(found.entries) <= 4096
    assert np.square(points - found.entries[found.labels]).sum() < 2  # one entry for all: 4e5


def test_real_scene_is_written_smaller(tmp_path):
    model = io.load(scene_path("skull.sog"))
    loaded = saved(tmp_path, model, palette=65_536)
    assert (tmp_path / "a.sog").stat().st_size < 0.8 * scene_path("skull.sog").stat().st_size
    for before, after, least in (
        (model.opacities(), loaded.opacities(), 0.006),
        (model.sh[:, 0], loaded.sh[:, 0], 0.05),
        (model.sh[:, 1:], loaded.sh[:, 1:], 0.03),
        (model.log_scales.ravel(), loaded.log_scales.ravel(), 0.05),
    ):
        error = np.abs(np.sort(before, axis=0) - np.sort(after, axis=0))
        assert np.quantile(error, 0.99) < least


@pytest.mark.parametrize("bits", [4, 5, 6, 7, 8])
def test_fewer_bits_round_more_and_take_less(tmp_path, bits):
    model = random_model(4000, 0)
    loaded = in_order_of(model, saved(tmp_path, model, bits=bits))
    step = 2.0 ** (8 - bits)
    assert angle(model, loaded).max() < 0.017 * step
    assert len(np.unique(loaded.log_scales)) <= 3 * 2 ** (bits - 1)
    assert len(np.unique(loaded.sh)) <= 3 * 2 ** (bits - 2)
    assert (
        np.abs(model.opacities() - loaded.opacities()).max()
        < 0.5 / min(2 ** (bits + 1) - 1, 255) + 0.002
    )
    # For visible splats, a step of the centre is a small share of the size.
    sizes = np.sort(model.scales(), axis=1)[:, 1]
    moved = np.abs(model.means - loaded.means).max(axis=1) / sizes
    assert 0.001 * step < np.average(moved, weights=visibility(model)) < 0.02 * step
    if bits < 8:
        more = io.encoded_bytes(model, tmp_path / "a.sog", {"bits": bits + 1})
        assert (tmp_path / "a.sog").stat().st_size < 0.93 * more


def test_sh_bits_set_the_precision_of_the_palette(tmp_path):
    model, whole = random_model(4000, 2), {"palette": 65_536}
    errors, sizes = [], []
    for bits in range(2, 9):
        loaded = in_order_of(model, saved(tmp_path, model, sh_bits=bits, **whole))
        assert 2 ** (bits - 1) < len(np.unique(loaded.sh[:, 1:])) <= 2**bits
        errors.append(float(np.mean((loaded.sh[:, 1:] - model.sh[:, 1:]) ** 2)))
        sizes.append((tmp_path / "a.sog").stat().st_size)
    assert all(6 > before / after > 2.5 for before, after in itertools.pairwise(errors))
    assert sizes == sorted(sizes)

    def size(**options):
        return io.encoded_bytes(model, tmp_path / "a.sog", options)

    assert size(**whole) == sizes[6 - 2]
    assert size(palette=1000) == size(palette=1000, sh_bits=5) < size(palette=1000, sh_bits=6)
    with pytest.raises(OptionError, match="`sh_bits` must be a whole number from 2 to 8"):
        io.save(model, tmp_path / "a.sog", overwrite=True, format_options={"sh_bits": 9})


@pytest.mark.parametrize(
    ("sets", "finer"),
    [
        (600, True),  # each splat has its own
        (300, False),  # the palette is full, so its entries may be means
        (299, True),  # there was room for one more
        (301, False),  # one set had to be merged
    ],
)
def test_harmonics_that_may_be_means_are_stored_with_a_bit_less(tmp_path, sets, finer):
    model, entries = random_model(600), 600 if sets == 600 else 300
    model.sh[:, 1:] = np.resize(model.sh[:sets, 1:], model.sh[:, 1:].shape)
    found = saved(tmp_path, model, palette=entries)
    assert (len(np.unique(found.sh[:, 1:])) > 32) is finer
    # Values of a codebook are no means, and stay what they are.
    book = np.linspace(-1, 1, 50, dtype=np.float32)
    model.sh[:, 1:] = book[np.abs(model.sh[:, 1:, :, None] - book).argmin(axis=-1)]
    if sets <= 300:
        found = saved(tmp_path, model, palette=entries)
        assert np.array_equal(np.unique(found.sh[:, 1:]), book)


@pytest.mark.parametrize("bits", [3, 9])
def test_bits_beyond_the_format_are_refused(tmp_path, bits):
    with pytest.raises(OptionError, match="`bits` must be a whole number from 4 to 8"):
        io.save(random_model(9, 1), tmp_path / "a.sog", format_options={"bits": bits})


def test_spare_bits_reduce_the_precision_of_centres(tmp_path):
    model, errors, sizes = random_model(), [], []
    for spare_bits in range(7):
        again = saved(tmp_path, model, spare_bits=spare_bits)
        sizes.append((tmp_path / "a.sog").stat().st_size)
        shifts = np.abs(np.sort(again.means, axis=0) - np.sort(model.means, axis=0))
        errors.append(np.sqrt(np.square(shifts).mean()))
    np.testing.assert_allclose(np.diff(np.log2(errors)), 1, atol=0.15)
    assert sizes == sorted(sizes, reverse=True)


def test_a_sky_does_not_coarsen_the_centres_of_what_is_near():
    rng = np.random.default_rng(0)
    near = random_model(2000, 0)
    near.means[:], near.log_scales[:] = rng.normal(0, 1, (2000, 3)), np.log(0.01)
    sky = random_model(200, 0)
    sky.means[:], sky.log_scales[:] = 100 * rng.normal(0, 1, (200, 3)), np.log(10)
    both = concatenate([near, sky])
    for spare_bits in (rounding.spare_bits, lambda model: spz_spare_bits(InMemory(model))):
        assert spare_bits(sky) >= 4
        assert spare_bits(both) <= spare_bits(near) + 1 < 4
    assert visibility(both)[:2000].std() > 0.1 * visibility(both)[:2000].mean()


@pytest.mark.parametrize("outlier", [1e7, -1e7, -1e9])
def test_one_extreme_value_leaves_the_codebook_fine(outlier):
    values = np.random.default_rng(1).normal(0, 0.3, 20_000).astype(np.float32)
    book = codebook(np.append(values, np.float32(outlier)), 64)
    plain = codebook(values, 64)
    loss, usual = (np.abs(each[nearest(values, each)] - values).max() for each in (book, plain))
    assert loss < 3 * usual


def test_equal_harmonics_of_two_splats_leave_the_others_as_fine(tmp_path):
    model = random_model(300, 1)
    losses = []
    for _ in range(2):
        losses.append(np.abs(saved(tmp_path, model).sh[:, 1:] - model.sh[:, 1:]).mean())
        model.sh[7] = model.sh[8]
    assert losses[1] < 1.2 * losses[0]


def test_centres_that_were_read_keep_their_precision(tmp_path):
    """Though alpha was rounded: in the file, the large splat counts less than in the model."""
    model = random_model(2, 0)
    model.means[:], model.log_scales[:] = [[0, 0, 0], [1, 1, 1]], [[-5.36], [-2.2]]
    model.opacity_logits[:] = [0.1, -4.3]
    once = saved(tmp_path, model)
    assert rounding.spare_bits(once) == rounding.spare_bits(model)
    assert saved(tmp_path, once).means.tobytes() == once.means.tobytes()


def test_derived_options_can_be_given_explicitly():
    assert_written_alike(random_model(), "a.sog", most=5)


def test_gaussforge_reads_the_same_values(tmp_path):
    gaussforge = pytest.importorskip("gaussforge")
    loaded = saved(tmp_path, random_model(2000, 3))
    data = (tmp_path / "a.sog").read_bytes()
    converted = gaussforge.GaussForge().convert(data, "sog", "ply")
    (tmp_path / "b.ply").write_bytes(converted["data"])
    other = io.load(tmp_path / "b.ply")
    for name in ("means", "log_scales", "quats", "sh"):
        assert getattr(other, name) == pytest.approx(getattr(loaded, name), rel=3e-6, abs=1e-6)
    finite = np.isfinite(loaded.opacity_logits)
    assert other.opacity_logits[finite] == pytest.approx(loaded.opacity_logits[finite], abs=1e-4)


def test_gsply_reads_the_same_values(tmp_path):
    pytest.importorskip("imagecodecs")
    gsply = pytest.importorskip("gsply")
    loaded = saved(tmp_path, random_model(2000, 2))
    other = gsply.sogread(str(tmp_path / "a.sog"))
    assert other.means == pytest.approx(loaded.means, rel=3e-6, abs=1e-6)
    assert np.array_equal(other.scales, loaded.log_scales)
    assert np.array_equal(other.shN, loaded.sh[:, 1:])
