"""The Python code of each page of the documentation runs from the first to the last line."""

import re
from pathlib import Path

import numpy as np
import pytest

import nanogs
from nanogs.datasets.synthetic import make_scene

ROOT = Path(__file__).resolve().parents[1]
BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
TESTED_ELSEWHERE = {
    "docs/scale.md"
}  # needs a city and a cluster; tests/test_scale*.py run such calls
PAGES = {
    page.relative_to(ROOT).as_posix(): BLOCK.findall(page.read_text())
    for page in sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
}
SHOWN = sorted(name for name, blocks in PAGES.items() if blocks and name not in TESTED_ELSEWHERE)


class Parameter:
    """Like a parameter of PyTorch, which only gives an array once detached and on the CPU."""

    def __init__(self, array):
        self.array = array

    def detach(self):
        return self

    def cpu(self):
        return self.array


@pytest.fixture
def page_names(tmp_path, monkeypatch, small_views):
    """The file of a scene, and names of which pages say that they come from elsewhere."""
    monkeypatch.chdir(tmp_path)
    scene = make_scene(600, sh_degree=1)
    nanogs.save(scene, "scene.ply")
    trained = {name: Parameter(array) for name, array in scene.to_gsplat().items()}
    return {"trained": trained}


@pytest.mark.parametrize("page", SHOWN)
def test_python_code_of_each_page_runs(page, page_names, capsys):
    source = "\n".join(PAGES[page])
    exec(compile(source, page, "exec"), page_names)
    captured = capsys.readouterr()
    assert captured.err == ""
    if page == "docs/guide/python.md":
        check_results(page_names, captured.out)


def check_results(names, out):
    """Check that the results of the page are as the page says."""
    assert len(names["fast"]) == 50
    assert len(names["small"]) == 60
    assert len(names["first"]) == 100
    assert len(names["cloud"]) == 200
    assert names["cloud"].means.dtype == np.float64
    assert names["tensors"]["shN"] == (60, 3, 3)
    assert [model.name for model in names["result"].models] == ["default", "fast"]
    assert [count for count, _ in names["curve"]] == [300, 120, 60]
    assert names["cut_out"].shape == (120, 160, 4)
    assert names["again"].sh_degree == 1
    nanogs.save(names["light"], "light.spz")
    assert Path("light.spz").stat().st_size <= 12_000
    assert "Splats(600 splats; SH degree 1; render mode default; bounds" in out
    assert re.search(r"^2 of 2, fit: 100%$", out, re.MULTILINE)
    assert "missing.ply: no such file; check the path." in out


def test_pages_with_python_code_are_found():
    assert {"README.md", "docs/index.md", "docs/guide/python.md"} <= set(SHOWN)
    assert len(PAGES["docs/guide/python.md"]) > 10
    assert set(PAGES) >= TESTED_ELSEWHERE
