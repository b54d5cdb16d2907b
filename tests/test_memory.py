"""The memory that `--dry-run` promises, against what a process of its own really takes."""

import subprocess
import sys

import pytest

from nanogs.simplify.memory import LIBRARIES, plan_memory
from nanogs.simplify.presets import parameters

COUNT = 200_000
RUN = """
import re, sys
from pathlib import Path
import nanogs
from nanogs.datasets.synthetic import make_scene
nanogs.simplify(make_scene(500), ratio=0.1, preset=sys.argv[1])  # loads the kernels
model = nanogs.load(sys.argv[2])
nanogs.simplify(model, ratio=0.1, preset=sys.argv[1])
peak = re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())
print(int(peak[1]) * 1024)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("preset", ["fast", "paper", "default"])
def test_the_plan_holds_what_a_run_takes(preset, large_scene):
    command = [sys.executable, "-c", RUN, preset, str(large_scene)]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    taken = int(run.stdout)
    planned = plan_memory(COUNT, 3, 0, parameters(preset, {}), COUNT // 10, judged=False).peak
    assert 0.85 < taken / (planned + LIBRARIES) < 1.05


@pytest.fixture(scope="module")
def large_scene(tmp_path_factory):
    import nanogs
    from nanogs.datasets.synthetic import make_scene

    path = tmp_path_factory.mktemp("memory") / "scene.ply"
    nanogs.save(make_scene(COUNT), path)
    return path
