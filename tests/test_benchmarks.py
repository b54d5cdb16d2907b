"""Programs of benchmarks/ start: they import names that exist, and take options; some run."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

import nanogs
from nanogs.datasets.synthetic import make_scene

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
pytestmark = pytest.mark.skipif(not FOLDER.exists(), reason="only in the repository")

# One process for all, since each would take a second for its imports.
RUN = """
import contextlib, io, json, runpy, sys, traceback
found = {}
for program in sys.argv[1:]:
    sys.argv, printed = [program, "--help"], io.StringIO()
    try:
        with contextlib.redirect_stdout(printed):
            runpy.run_path(program, run_name="__main__")
        found[program] = "it ran without options"
    except SystemExit as end:
        found[program] = "" if not end.code and "usage:" in printed.getvalue() else str(end.code)
    except Exception:
        found[program] = traceback.format_exc()
print(json.dumps(found))
"""


def test_all_benchmarks_show_their_help(tmp_path):
    programs = [
        str(path)
        for path in sorted(FOLDER.glob("*.py"))
        if '__name__ == "__main__"' in path.read_text(encoding="utf-8")
    ]
    assert len(programs) > 20
    code = f"import sys; sys.path.insert(0, {str(FOLDER)!r})\n{RUN}"
    result = subprocess.run(
        [sys.executable, "-c", code, *programs],
        cwd=tmp_path, capture_output=True, text=True, check=True,
    )  # fmt: skip
    failed = {name: text for name, text in json.loads(result.stdout).items() if text}
    assert not failed, "\n".join(f"{name}: {text}" for name, text in failed.items())
    assert not any(tmp_path.iterdir())


def test_killed_runs_of_scale_fit_into_the_memory_that_is_its_default(
    benchmark_module, tmp_path, monkeypatch, capsys
):
    nanogs.save(make_scene(600), tmp_path / "a.ply")
    words = ["scale.py", "kill", str(tmp_path / "a.ply"), "--folder", str(tmp_path), "--times", "0"]
    monkeypatch.setattr(sys, "argv", words)  # a whole run, and none that is killed
    benchmark_module("scale").main()
    assert capsys.readouterr().out.startswith("0 kills, 0 results")
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


@pytest.mark.parametrize("name", ["oracles", "quality", "sizes", "sog", "unbounded"])
def test_programs_that_call_splat_transform_install_it_first(
    name, benchmark_module, tmp_path, monkeypatch
):
    def install():
        sys.exit("installed")

    program = benchmark_module(name)
    monkeypatch.setattr(program, "install", install, raising=False)
    monkeypatch.setenv("NANOGS_SCENES", str(tmp_path / "absent"))
    folder = [str(tmp_path)] if name in ("sizes", "unbounded") else []
    monkeypatch.setattr(sys, "argv", [name, *folder])
    with pytest.raises(SystemExit, match="installed"):
        program.main()
