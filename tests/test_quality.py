"""A small run of benchmarks/quality.py: kept and repeated measurements, and its tables."""

from types import SimpleNamespace

import pytest

import nanogs
from nanogs.bench.digest import PACKAGE
from nanogs.bench.worker import Outcome
from nanogs.datasets.synthetic import make_scene


@pytest.fixture(scope="module")
def benchmarks(benchmark_module):
    """Two modules of the benchmark."""
    return SimpleNamespace(
        leads=benchmark_module("leads"), measurements=benchmark_module("measurements")
    )


@pytest.fixture
def bench(benchmarks, tmp_path, monkeypatch):
    """A bench of one small scene, whose methods take the first rows; `made` lists the ones run."""
    (tmp_path / "scenes").mkdir()
    nanogs.save(make_scene(300), tmp_path / "scenes" / "a.ply")
    methods_run = []

    def job(bench_job):
        methods_run.append(bench_job.method)
        splats = nanogs.load(bench_job.model)
        nanogs.save(splats[: round(bench_job.ratio * len(splats))], bench_job.output)
        return Outcome(splats=30, asked=30, seconds=1.0)

    monkeypatch.setattr(benchmarks.measurements, "SCENES", {"a": "a.ply"})
    monkeypatch.setattr(benchmarks.measurements, "run_job", job)
    found = benchmarks.measurements.Bench(tmp_path, tmp_path / "peers", tmp_path)
    return SimpleNamespace(found=found, made=methods_run, messages=[])


def measure(benchmarks, bench, *keys):
    bench.messages.clear()
    return bench.found.measure(
        [benchmarks.measurements.Key(*key) for key in keys], bench.messages.append
    )


def test_kept_measurements_are_reused_and_others_are_made(benchmarks, bench):
    first = measure(benchmarks, bench, ("a", 0.1, "fast", "32"))
    assert (bench.made, len(bench.messages)) == (["fast"], 1)
    both = measure(benchmarks, bench, ("a", 0.1, "fast", "32"), ("a", 0.1, "fast", "roam@32"))
    assert both[0] == first[0]
    assert (bench.made, len(bench.messages)) == (["fast"], 1), "the result is there, one row is not"
    assert (both[0]["views"], both[1]["views"]) == (8, 24)
    assert both[1]["least_psnr"] < both[1]["psnr"]


def test_packages_excluded_from_the_digest_exist(benchmarks):
    apart = {*benchmarks.measurements.APART, *benchmarks.measurements.SCORES_APART}
    assert all((PACKAGE / name).is_dir() for name in apart)
    assert "studio" in benchmarks.measurements.APART
    scoring = {"raster", "kernels", "metrics", "scoring", "views", "datasets", "io"}
    assert not scoring & {*benchmarks.measurements.SCORES_APART}
    assert not {"bench", "kernels"} & {*benchmarks.measurements.BASELINES_APART}


def test_changed_sources_are_run_again_and_kept_files_only_measured(benchmarks, bench, monkeypatch):
    measure(benchmarks, bench, ("a", 0.1, "fast", "32"), ("a", 0.2, "fast", "32"))
    monkeypatch.setattr(benchmarks.measurements, "digest_of_sources", lambda _apart: "other")
    bench.found.digests[benchmarks.measurements.APART] = "other"
    measure(benchmarks, bench, ("a", 0.1, "fast", "32"))
    assert bench.made == ["fast"] * 3
    (bench.found.peers).mkdir()
    nanogs.save(make_scene(40), bench.found.peers / "a_0.1_theirs.ply")
    [row] = measure(benchmarks, bench, ("a", 0.1, "theirs", "32"))
    assert (row["splats"], bench.made) == (40, ["fast"] * 3)


def test_results_of_all_methods_are_scored_again_after_a_change_of_how(benchmarks, bench):
    (bench.found.peers).mkdir()
    nanogs.save(make_scene(40), bench.found.peers / "a_0.1_theirs.ply")
    keys = [("a", 0.1, method, "32") for method in ("fast", "random", "theirs")]
    measure(benchmarks, bench, *keys)
    bench.found.scorer = "other"
    measure(benchmarks, bench, *keys)
    assert (bench.made, len(bench.messages)) == (["fast", "random"], 3), "results are kept"
    measure(benchmarks, bench, *keys)
    assert bench.messages == []


def test_baselines_are_run_again_if_their_package_changed(benchmarks, bench, monkeypatch):
    keys = [("a", 0.1, method, "32") for method in ("fast", "random")]
    measure(benchmarks, bench, *keys)
    sources = benchmarks.measurements.digest_of_sources
    monkeypatch.setattr(
        benchmarks.measurements,
        "digest_of_sources",
        lambda apart: sources(apart) if "bench" in apart else "changed",
    )
    folder = bench.found.folder
    bench.found = benchmarks.measurements.Bench(folder, folder / "peers", folder)
    measure(benchmarks, bench, *keys)
    assert bench.made == ["fast", "random", "random"]


def test_scores_on_photographs_depend_on_their_files(benchmarks, bench, monkeypatch):
    monkeypatch.setattr(benchmarks.measurements, "PHOTOS", {"a": "photos"})
    photo = bench.found.scenes / "photos" / "images" / "0.png"
    photo.parent.mkdir(parents=True)
    digests = []
    for content in (b"white", b"black", b"white"):
        photo.write_bytes(content)
        digests.append(bench.found._digest("a", "photographs", []))
    assert digests[0] == digests[2] != digests[1]


def test_results_made_beforehand_are_left_out_where_there_are_none(benchmarks, bench):
    bench.found.peers.mkdir()
    nanogs.save(make_scene(40), bench.found.peers / "a_0.1_nanogs-ref.ply")
    keys = [
        benchmarks.measurements.Key("a", ratio, method, "32")
        for ratio in (0.1, 0.2)
        for method in ("fast", "nanogs-ref")
    ]
    kept = [key for key in keys if bench.found.offers(key)]
    assert [key[1:3] for key in kept] == [(0.1, "fast"), (0.1, "nanogs-ref"), (0.2, "fast")]
    rows = measure(benchmarks, bench, *kept)
    assert [row["splats"] for row in rows] == [30, 40, 60]


def test_sources_that_change_during_a_run_end_it(benchmarks, bench):
    bench.found.digests[benchmarks.measurements.APART] = "before"
    with pytest.raises(SystemExit, match="changed meanwhile"):
        measure(benchmarks, bench, ("a", 0.1, "fast", "32"))
    assert not list((bench.found.folder / "results").iterdir())


def test_leads_are_over_the_better_mode_for_each_score(benchmarks):
    def row(scene, method, kind, psnr, ssim):
        return {
            "scene": scene, "ratio": 0.1, "method": method, "kind": kind, "psnr": psnr,
            "ssim": ssim,
        }  # fmt: skip

    rows = [
        row("a", "st-uniform", "512", 30.0, 0.8), row("a", "st-adaptive", "512", 29.0, 0.9),
        row("a", "fast", "512", 31.0, 0.95), row("a", "default", "512", 30.5, 0.95),
        row("b", "st-uniform", "512", 20.0, 0.8), row("b", "st-adaptive", "512", 20.0, 0.7),
        row("b", "fast", "512", 19.0, 0.7), row("b", "default", "512", 22.0, 0.7),
        row("a", "st-uniform", "photographs", 30.0, 0.8),
        row("a", "st-adaptive", "photographs", 30.0, 0.8),
        row("a", "fast", "photographs", 39.0, 0.8),
    ]  # fmt: skip
    text = benchmarks.leads.report(rows)
    assert "| | 512, automatic |\n" in text
    assert "| `fast` 0.1 | +0.00 (-1.00) |" in text
    assert "| `default` 0.1 | +1.25 (+0.50) |" in text
    assert "| `fast` 0.1 | -0.025 (-0.100) |" in text
    assert "| a | 0.1 | 512, automatic | 30.00 / 0.900 | +1.00 / +0.050 | +0.50 / +0.050 |" in text
    assert "| a | 0.1 | photographs | 30.00 / 0.800 | +9.00 / +0.000 |  |" in text
    assert "- a at 0.1, 512, automatic: default 30.50 dB, fast 31.00 dB" in text
    assert "- b" not in text
    assert "| fast | 0.1 | 25.00 / 0.825 |" in text
