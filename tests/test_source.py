"""`Source`: rows that are read in parts or by number are those of the whole model."""

import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

import nanogs
from builders import random_splats
from nanogs import filters
from nanogs import source as sources
from nanogs.errors import FormatError, ModelError, OptionError
from nanogs.findings import Finding, join_findings
from nanogs.frames import change_frame
from nanogs.io.in_order import in_order
from nanogs.source import Filtered, InMemory, Joined, Noted, Reduced, Tagged, Turned, base
from nanogs.splats import ExtraElement
from strategies import assert_same

SUFFIXES = [
    ".ply",
    ".compressed.ply",
    ".splat",
    ".npz",
    ".spz",
    ".rad",
    ".sog",
    ".glb",
    ".usda",
    ".csv",
]
SPANS = [(0, 700), (0, 1), (699, 700), (13, 499), (0, 0), (700, 700)]
KEPT = [filters.box((-1, -1, -0.5), (1, 1, 0.5)), filters.opaque_enough(0.3)]


@pytest.fixture
def small_pages(monkeypatch):
    """Make pages so small that a filtered model has several, some of them empty."""
    monkeypatch.setattr(base, "PAGE_ROWS", 32)
    monkeypatch.setattr(base, "BLOCK_ROWS", 100)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_threads_that_share_a_source_read_their_own_rows(tmp_path, suffix):
    model = random_splats(3000, degree=1)
    nanogs.save(model, tmp_path / f"a{suffix}")
    spans = [(start, start + 7 + start % 60) for start in range(0, 2900, 9)]
    whole = nanogs.load(tmp_path / f"a{suffix}")
    with nanogs.open(tmp_path / f"a{suffix}") as source, ThreadPoolExecutor(6) as pool:
        for span, rows in zip(spans, pool.map(lambda span: source.read(*span), spans), strict=True):
            assert_same(columns_only(rows), columns_only(whole.span(*span)))


def disturbed(source, start, stop):
    """Read other rows, as another thread may, whenever a source has kept what it read last."""
    kind = type(source)

    class Disturbed(kind):
        reading = False

        def __setattr__(self, name, value):
            kind.__setattr__(self, name, value)
            if name == "_last" and value is not None and not self.reading:
                kind.__setattr__(self, "reading", True)
                self.read(start, stop)
                kind.__setattr__(self, "reading", False)

    source.__class__ = Disturbed
    return source


@pytest.mark.usefixtures("small_pages")
def test_a_filtered_source_returns_its_rows_if_a_thread_reads_others_meanwhile():
    model = random_splats(3000, degree=1)
    left, _ = filters.apply(model, KEPT)
    source = disturbed(Filtered(InMemory(model), KEPT), len(left) - 5, len(left))
    assert_same(columns_only(source.read(0, 20)), columns_only(left.span(0, 20)))


def test_a_rad_returns_its_rows_if_a_thread_reads_others_meanwhile(tmp_path, monkeypatch):
    monkeypatch.setattr("nanogs.io.rad.write.CHUNK_ROWS", 512)
    nanogs.save(random_splats(3000, degree=1), tmp_path / "a.rad")
    whole = nanogs.load(tmp_path / "a.rad")
    with nanogs.open(tmp_path / "a.rad") as source:
        rows = disturbed(source, 2900, 2950).read(500, 530)
    assert_same(columns_only(rows), columns_only(whole.span(500, 530)))


def test_sorted_rows_are_those_of_each_thread(tmp_path):
    model = random_splats(3 * 4096 + 5)
    nanogs.save(model, tmp_path / "a.ply")
    order = np.random.default_rng(0).permutation(len(model))
    sorted_model, spans = model.take(order), [(4000, 4200), (9000, 9001), (0, 0), (8192, 12293)]
    with nanogs.open(tmp_path / "a.ply") as source, in_order(source, order) as rows:
        disturbed(rows, 0, 1)
        for span in spans:
            assert_same(columns_only(rows.read(*span)), columns_only(sorted_model.span(*span)))


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_source_that_was_read_can_be_sent_to_another_process(tmp_path, suffix):
    nanogs.save(random_splats(50), tmp_path / f"a{suffix}")
    with nanogs.open(tmp_path / f"a{suffix}") as source:
        rows = source.read(3, 9)
        with pickle.loads(pickle.dumps(source)) as again:
            assert_same(again.read(3, 9), rows)


def model_of(count=700, **given):
    extras = {name: np.zeros(count, np.float32) for name in ("nx", "nz")}
    extras |= {"ny": np.arange(count, dtype=np.float32), "label": np.arange(count, dtype=np.int32)}
    return random_splats(count, degree=2, extras=extras, **given)


def assert_source_equals(source, whole):
    """Check that ranges, single rows and the whole of a source are those of a model."""
    assert source.count == len(source) == len(whole)
    assert source.columns.sh_degree == whole.sh_degree
    assert dict(source.columns.extras) == {n: c.dtype.str for n, c in whole.extras.items()}
    count = len(whole)
    some = (0, count), (0, 1), (count - 1, count), (count // 3, count // 2), (count, count)
    for start, stop in some:
        assert_same(columns_only(source.read(start, stop)), columns_only(whole.span(start, stop)))
    blocks = list(source.blocks())
    assert_same(columns_only(sources.joined_rows(blocks)), columns_only(whole))
    rows = np.random.default_rng(3).permutation(count)[: count // 2 + 1]
    assert_same(columns_only(source.take(rows)), columns_only(whole.take(rows)))
    assert len(source.take(rows[:0])) == 0
    assert_same(columns_only(source.load()), columns_only(whole))


@pytest.mark.parametrize("rows", [0, -5, 2.0, "7"])
def test_blocks_of_no_rows_are_refused(rows):
    source = InMemory(random_splats(20))
    assert [len(block) for block in source.blocks(np.int64(8))] == [8, 8, 4]
    with pytest.raises(OptionError, match=f"1 or more, not {rows!r}"):
        source.blocks(rows)


def columns_only(splats):
    return replace(splats, elements=(), comments=(), notes=())


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_an_opened_file_equals_the_loaded_one(tmp_path, suffix, small_pages):
    path = tmp_path / f"a{suffix}"
    nanogs.save(model_of(), path)
    with nanogs.open(path) as source:
        whole = nanogs.load(path)
        assert_source_equals(source, whole)
        assert source.info == nanogs.io.inspect(path)
        assert source.load().notes == whole.notes
        assert source.load().comments == whole.comments


@pytest.mark.parametrize("suffix", [*SUFFIXES, None])
def test_rows_out_of_range_are_refused(tmp_path, suffix):
    """Once, other bytes of the file were returned for them, or zeros."""
    path, source = tmp_path / f"a{suffix}", InMemory(model_of())
    if suffix is not None:
        nanogs.save(model_of(), path)
        source = nanogs.open(path)
    with source:
        for start, stop in [(-5, 3), (5, 3), (699, 701), (701, 701), (0, 1.0), ("0", 1)]:
            with pytest.raises(
                OptionError, match=f"has no rows {start} to {stop}: its 700 rows are"
            ):
                source.read(start, stop)
        for row in (-1, 700):
            with pytest.raises(OptionError, match=f"has no row {row}: its 700 rows are"):
                source.take(np.array([3, row]))
        with pytest.raises(OptionError, match="needs row numbers"):
            source.take(np.zeros(700, bool))
        assert len(source.take([3, 1, 3])) == 3


def test_functions_that_take_a_model_accept_a_source(tmp_path):
    nanogs.save(model_of(), tmp_path / "a.ply")
    with nanogs.open(tmp_path / "a.ply") as source:
        assert repr(source) == f"<Source {tmp_path / 'a.ply'}>"
        small, _ = nanogs.simplify(source, ratio=0.1, preset="fast")
        assert nanogs.compare(source, source, views=1, pixels=32).models[0].psnr > 99
    assert_same(small, nanogs.simplify(tmp_path / "a.ply", ratio=0.1, preset="fast")[0])


def test_notes_about_a_whole_file_are_given_once_for_its_blocks(tmp_path, small_pages):
    path = tmp_path / "a.usda"
    nanogs.save(model_of(), path)
    before, scales, after = path.read_text().partition("scales = [(")
    path.write_text(f"{before}{scales}-{after}")
    expected = nanogs.load(path).notes
    assert expected == ("1 splat has a negative scale, which became NaN.",)
    with nanogs.open(path) as source:
        blocks = list(source.blocks())
    assert len(blocks) == 7
    assert sources.joined_rows(blocks).notes == expected


def test_elements_are_read_separately_from_rows(tmp_path):
    rows = np.zeros(5, [("a", "<f4"), ("b", "<i2")])
    rows["a"] = range(5)
    model = replace(model_of(), elements=[ExtraElement("camera", rows)])
    nanogs.save(model, tmp_path / "a.ply")
    with nanogs.open(tmp_path / "a.ply") as source:
        assert source.elements == InMemory(model).elements == (("camera", 5),)
        assert [len(each.rows) for each in source.read(3, 9).elements] == [0]
        for found in (source.read_elements(), source.load().elements):
            assert found[0].rows.tobytes() == rows.tobytes()
        assert source.columns == InMemory(nanogs.load(tmp_path / "a.ply")).columns


@pytest.mark.parametrize(
    "changed",
    [
        lambda given: Filtered(given, KEPT),
        lambda given: Turned(given, "rdf", "rub"),
        lambda given: Reduced(given, 0),
        lambda given: Tagged(given, "mip"),
        Noted,
        lambda given: Joined([InMemory(random_splats(2)), given]),
    ],
)
def test_sources_made_of_others_close_these(changed):
    class Open(InMemory):
        closed = False

        def close(self):
            self.closed = True

    given = Open(random_splats(40))
    with changed(given) as source:
        source.read(0, 1)
        assert not given.closed
    assert given.closed


def test_unpacked_data_are_removed_when_the_source_is_closed(tmp_path):
    nanogs.save(model_of(), tmp_path / "a.spz")
    source = nanogs.open(tmp_path / "a.spz")
    source.read(1, 2)
    read_columns = source._unpacked.columns
    source.close()
    with pytest.raises(ValueError, match="closed file"):
        read_columns("alphas", 0, 1)
    assert len(source.read(1, 3)) == 2  # it is unpacked again
    source.close()


def test_open_refuses_what_load_refuses(tmp_path):
    nanogs.save(model_of(), tmp_path / "a.ply")
    with pytest.raises(FormatError, match="unknown suffix"):
        nanogs.open(tmp_path / "a.xyz")
    with pytest.raises(FormatError, match="no such file"):
        nanogs.open(tmp_path / "b.ply")
    for level in ("0", 0.0, True, None):
        for read in (nanogs.open, nanogs.load):
            with pytest.raises(OptionError, match="`level` must be a whole number, not "):
                read(tmp_path / "a.ply", level=level)
    with pytest.raises(OptionError, match="no levels of detail"):
        nanogs.open(tmp_path / "a.ply", level=1)
    with nanogs.open((tmp_path / "a.ply").rename(tmp_path / "a.dat"), format="ply") as source:
        assert source.count == 700


def test_filters_of_a_source_keep_the_same_splats_as_in_memory(small_pages):
    model = model_of()
    kept, reports = filters.apply(model, KEPT)
    source = Filtered(InMemory(model), KEPT)
    assert 20 < len(kept) < 400
    assert source.reports == reports
    assert_source_equals(source, kept)
    assert_source_equals(Filtered(InMemory(model), KEPT, source.kept), kept)
    assert sum(source.kept) == len(kept)
    assert len(source.kept) == 22
    far = Filtered(InMemory(model), [filters.sphere(model.means[650], 1e-3)])
    assert_source_equals(far, model.take(slice(650, 651)))  # most pages keep nothing


def test_filters_of_a_source_refuse_the_same_as_in_memory(small_pages):
    model = model_of()
    with pytest.raises(ModelError, match="leaves none of 700 splats"):
        _ = Filtered(InMemory(model), [filters.sphere((1e6, 0, 0), 1)]).count
    with pytest.raises(OptionError, match="drop-floaters needs the whole model"):
        Filtered(InMemory(model), [filters.in_company()])
    rows = np.zeros(700, [("a", "<f4")])
    with_rows = replace(model, elements=[ExtraElement("each", rows)])
    with pytest.raises(ModelError, match="'each' has one row for each splat"):
        _ = Filtered(InMemory(with_rows), KEPT).count


@pytest.mark.parametrize(
    ("kept", "message"),
    [
        (lambda rows: rows.opacities(), "not float64 of shape"),
        (lambda rows: np.arange(2), r"not int64 of shape \(2,\)"),
        (lambda rows: np.ones(2, bool), r"not bool of shape \(2,\)"),
        (lambda rows: None, "not object of shape"),
    ],
)
def test_a_filter_that_returns_no_mask_is_refused(kept, message):
    model = random_splats(9)
    own = filters.Filter("own", "", kept)
    expected = f"The filter 'own' must return one flag for each of 9 splats, {message}"
    with pytest.raises(OptionError, match=expected):
        filters.apply(model, [own])
    with pytest.raises(OptionError, match=expected):
        Filtered(InMemory(model), [own]).load()
    with pytest.raises(OptionError, match=expected):
        Filtered(InMemory(model), [own]).read(0, 1)
    flags = filters.Filter("own", "", lambda rows: [True, False, *[False] * (len(rows) - 2)])
    assert len(filters.apply(model, [flags])[0]) == 1


def test_filters_can_be_restored_from_their_record():
    model = model_of()
    for each in [
        *KEPT,
        filters.sphere((0.1, 0.2, 1 / 3), 2 / 3),
        filters.in_company(5, 1 / 3),
    ]:
        again = filters.filter_of(*each.plain)
        assert (again.name, again.argument, again.whole) == (each.name, each.argument, each.whole)
        assert np.array_equal(again.keep(model), each.keep(model))


@pytest.mark.parametrize("target", ["rub", "fru", "rdf"])
def test_turned_equals_the_turned_model(target, small_pages):
    model = model_of()
    assert_source_equals(Turned(InMemory(model), "rdf", target), change_frame(model, "rdf", target))
    with pytest.raises(OptionError, match="A frame says"):
        Turned(InMemory(model), "rdf", "up")


def test_joined_files_have_the_columns_common_to_all(tmp_path, small_pages):
    second = replace(random_splats(300, degree=1, seed=5), comments=("second",))
    nanogs.save(model_of(), tmp_path / "a.ply")
    nanogs.save(second, tmp_path / "b.spz")
    parts = [tmp_path / "a.ply", tmp_path / "b.spz"]
    with Joined([nanogs.open(path) for path in parts]) as source:
        one, two = map(nanogs.load, parts)
        assert source.columns.extras == ()
        whole = source.load()
        assert_source_equals(source, whole)
        assert np.array_equal(whole.means, np.concatenate([one.means, two.means]))
        assert np.array_equal(whole.sh[:700], one.sh)
        assert np.array_equal(whole.sh[700:, :4], two.sh)
        assert not whole.sh[700:, 4:].any()
        assert [note.split(":")[0] for note in whole.notes][:2] == [
            "Extra columns that not all inputs have are left out",
            "The inputs' SH degrees differ",
        ]
    with pytest.raises(ModelError, match="different render modes"):
        Joined([InMemory(one), InMemory(replace(one, render_mode="mip"))])


@pytest.mark.parametrize("row", [0, 5, 10, 20])
def test_joined_parts_read_no_rows(row):
    parts = Joined([InMemory(random_splats(10)), InMemory(random_splats(10))])
    assert len(parts.read(row, row)) == 0


def test_left_out_comments_of_further_inputs_are_noted():
    first = replace(model_of(), comments=("a", "b"))
    others = [replace(first, comments=lines) for lines in ((), ("b",), ("b", "c"), ("d", "c"))]
    with Joined([InMemory(first), *map(InMemory, others)]) as source:
        assert source.columns.comments == source.read(0, 1).comments == ("a", "b")
        note = "2 comment lines are left out: of several inputs only the first one's are kept."
        assert source.columns.notes == source.load().notes == (note,)
    assert Joined([InMemory(first), InMemory(others[1])]).columns.notes == ()


def test_reduced_leaves_out_higher_sh_bands(small_pages):
    model = model_of()
    assert_source_equals(Reduced(InMemory(model), 1), model.with_sh_degree(1))
    assert_source_equals(Reduced(InMemory(model), 3), model)


def test_nested_sources_equal_the_same_changes_in_memory(tmp_path, small_pages):
    model = model_of()
    nanogs.save(model.span(0, 301), tmp_path / "a.ply")
    nanogs.save(model.span(301, 700), tmp_path / "b.ply")
    files = [nanogs.open(tmp_path / name) for name in ("a.ply", "b.ply")]
    with Turned(Filtered(Joined(files), KEPT), "rdf", "luf") as source:
        assert_source_equals(source, change_frame(filters.apply(model, KEPT)[0], "rdf", "luf"))


def notes_of_blocks(source, step):
    return join_findings(block.notes for block in source.blocks(step))


@pytest.mark.parametrize("suffix", [".splat", ".usda"])
def test_notes_are_about_all_rows_once_however_these_are_read(tmp_path, small_pages, suffix):
    """Blocks begin within pages of a filter, and within a file that is only read whole."""
    nanogs.save(random_splats(300), tmp_path / f"a{suffix}")
    if suffix == ".splat":
        rows = np.fromfile(tmp_path / "a.splat", np.float32).reshape(-1, 8)
        rows[:, 3:6] *= -1
        rows.tofile(tmp_path / "a.splat")
        expected = "300 splats have a negative scale, which became NaN."
    else:
        text = (tmp_path / "a.usda").read_text(encoding="utf-8")
        start = text.index("opacities = [") + len("opacities = [")
        (tmp_path / "a.usda").write_text(f"{text[:start]}1{text[start:]}", encoding="utf-8")
        expected = "1 opacity is not from 0 to 1 and became NaN."
    with nanogs.open(tmp_path / f"a{suffix}") as file:
        for source in (file, Filtered(file, [filters.opaque_enough(0.3)])):
            assert 10 < source.count <= 300
            assert [notes_of_blocks(source, step) for step in (300, 100, 7)] == [(expected,)] * 3
            assert source.read(0, 0).notes == ()
        expected = tuple(Finding(note.template, 2 * note.value) for note in file.load().notes)
        assert notes_of_blocks(Joined([file, file]), 100) == expected


def test_a_noted_source_keeps_the_notes_about_all_rows_once(tmp_path):
    nanogs.save(random_splats(300), tmp_path / "a.splat")
    rows = np.fromfile(tmp_path / "a.splat", np.float32).reshape(-1, 8)
    rows[10:, 3:6] *= -1
    rows.tofile(tmp_path / "a.splat")
    with nanogs.open(tmp_path / "a.splat") as file:
        source = Noted(file)
        assert source.notes == ()
        source.read(0, 100)  # by a reader that reads no further
        assert source.notes == ("90 splats have a negative scale, which became NaN.",)
        source.take([299, 0])
        for step in (70, 300):
            list(source.blocks(step))
        whole = Noted(file)
        assert_same(whole.load(), file.load())
        assert source.notes == whole.notes == file.load().notes
    assert source.notes == ("290 splats have a negative scale, which became NaN.",)


@pytest.mark.parametrize(
    "made",
    [
        lambda given: Filtered(given, [filters.sphere((0, 0, 0), 1)]),
        lambda given: Turned(given, "rdf", "rub"),
        lambda given: Reduced(given, 0),
        lambda given: Tagged(given, "mip"),
        Noted,
        lambda given: Joined([given, given]),
    ],
)
def test_sources_of_what_is_no_source_are_refused(made):
    model = random_splats(3)
    with pytest.raises(ModelError, match=r"not Splats; nanogs\.source\.InMemory makes one of a mo"):
        made(model)
    with pytest.raises(ModelError, match=r"not str; nanogs\.open makes one of a file"):
        made("a.ply")
    assert len(made(InMemory(model)).columns.extras) == 0


def test_sources_refuse_invalid_arguments_when_they_are_made():
    source = InMemory(random_splats(3))
    with pytest.raises(ModelError, match=r"not the path 'a\.ply'"):
        InMemory("a.ply")
    for wrong in (filters.sphere((0, 0, 0), 1), [filters.sphere], "sphere"):
        with pytest.raises(OptionError, match="must be a list of filters"):
            Filtered(source, wrong)
    with pytest.raises(OptionError, match="SH degree must be from 0 to 4, not 5"):
        Reduced(source, 5)
    with pytest.raises(OptionError, match="mode must be one of default, mip, 2dgs, not 'mips'"):
        Tagged(source, "mips")
    assert Tagged(source, "mip").load().render_mode == "mip"
