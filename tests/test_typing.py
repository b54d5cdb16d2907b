"""Programs that use nanogs as its guide shows are accepted by a strict type checker."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PROGRAM = """
import numpy as np

import nanogs
from nanogs.progress import Step


def show(step: Step) -> None:
    print(step.stage, step.fraction)


n = 200
cloud = nanogs.Splats(
    means=np.zeros((n, 3)),
    log_scales=np.full((n, 3), -3.0),
    quats=np.tile([1, 0, 0, 0], (n, 1)),
    opacity_logits=[2.0] * n,
    sh=np.zeros((n, 1, 3)),
    extras={"label": [0] * n},
    render_mode="mip",
)
moved = nanogs.Splats(
    cloud.means + [0, 0, 1], cloud.log_scales, cloud.quats, cloud.opacity_logits, cloud.sh
)
small, report = nanogs.simplify(moved[:100], ratio=0.1, progress=show)
count: int = report.achieved_count
levels = nanogs.levels(moved, np.array([0.5, 0.1]), preset="fast")
counts = [len(level) for level, _ in levels]
camera = nanogs.Camera(
    width=64, height=48, fx=60, fy=60, cx=32, cy=24, world_to_camera=np.eye(4).tolist()
)
pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]
front = nanogs.Camera(64, 48, 60, 60, 32, 24, pose)
[picture, _] = nanogs.render(small, [camera, front], background=np.ones(3))
nanogs.mode_evidence(small, front, background=[1, 1, 1])
with nanogs.open("scene.ply") as source:
    two: nanogs.Splats = source.take([3, 1])
[score] = nanogs.compare(cloud, small, views=4, background=[1, 1, 1]).models
psnr: float = score.psnr
nanogs.save(small, "small.ply", overwrite=True)
"""


@pytest.mark.slow
def test_a_type_checker_accepts_models_of_any_arrays(tmp_path):
    pytest.importorskip("mypy")
    (tmp_path / "program.py").write_text(PROGRAM)
    words = ["-m", "mypy", "--strict", "program.py"]
    if (ROOT / "pyproject.toml").exists():  # of `make types`, which leaves a cache that saves 25 s
        words += ["--config-file", ROOT / "pyproject.toml", "--cache-dir", ROOT / ".mypy_cache"]
    result = subprocess.run(
        [sys.executable, *words], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stdout + result.stderr
