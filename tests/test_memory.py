"""What a map needs of the memory is known before it is made, and refused if it is not there."""

import subprocess
import sys

import numpy as np
import pytest

from terrainloop import resources
from terrainloop.errors import TerrainLoopError
from terrainloop.gp.hyperparameters import fit_hyperparameters
from terrainloop.gp.process import ElevationProcess
from terrainloop.gradient_map import GradientMap

resource = pytest.importorskip("resource")

CLOUD = """
import resource, sys
import numpy as np
from terrainloop import gradient_map
from terrainloop.errors import TerrainLoopError

def peak():  # of this process alone: ru_maxrss begins with what its parent had
    status = open("/proc/self/status").read()
    return 1024 * int(status.split("VmHWM:")[1].split()[0])

count, side, length_scale, pixels = (float(word) for word in sys.argv[1:5])
rng = np.random.default_rng(0)
cloud = np.c_[rng.uniform(0, side, (int(count), 2)), 0.1 * rng.standard_normal(int(count))]
given = {"length_scale": length_scale, "variance": 0.01, "noise": 0.02, "solver": sys.argv[5]}
gradient_map.GradientMap.from_points(cloud[:200] * [0.1, 0.1, 1], **{**given, "resolution": side / 100})
"""

MEASURE = """
said = []
gradient_map.check_memory = lambda needed, *_: said.append(needed)
before = peak()
made = gradient_map.GradientMap.from_points(cloud, **given, resolution=side / pixels**0.5)
made.magnitude
print(peak() - before, said[0])
"""

LIMITED = """
pages = int(open("/proc/self/statm").read().split()[0])
resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + 300_000_000,) * 2)
try:
    gradient_map.GradientMap.from_points(cloud, **given, resolution=side / pixels**0.5)
except TerrainLoopError as error:
    print(error)
"""


def run(script, *arguments):
    command = [sys.executable, "-c", CLOUD + script, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize(
    "arguments",
    [(3000, 20, 4.0, 6e6, "spline"), (200, 40, 0.5, 3e6, "spline"), (1500, 10, 2.0, 1e4, "exact")],
    ids=["pixels", "lattice", "exact"],
)
def test_the_memory_a_map_takes_is_what_is_checked(arguments):
    taken, said = (float(word) for word in run(MEASURE, *arguments).split())
    assert 0.3 * said < taken < 1.1 * said


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("arguments", [(150, 60, 0.6, 1.5e7, "spline"), (9000, 20, 2.0, 1e4, "exact")])
def test_under_a_limit_a_map_is_refused_in_one_line(arguments):
    assert "of memory for a map of" in run(LIMITED, *arguments)


def test_a_map_keeps_to_the_memory_it_is_given():
    cloud = np.random.default_rng(0).uniform(0, 3, (500, 3)) * [1, 1, 0.1]
    given = {"length_scale": 0.5, "variance": 0.01, "noise": 0.02}
    assert GradientMap.from_points(cloud, **given, max_memory=1e8).mask.any()
    with pytest.raises(TerrainLoopError, match="GB of memory for a map of"):
        GradientMap.from_points(cloud, **given, resolution=1e-3, max_memory=1e8)


def test_memory_that_runs_out_within_the_core_is_no_bare_error(monkeypatch):
    cloud = np.random.default_rng(0).uniform(0, 3, (500, 3)) * [1, 1, 0.1]
    for name, error in [("gp_noise_ratio", MemoryError), ("gp_predict_grid", ValueError("too wide"))]:
        with monkeypatch.context() as patch:
            patch.setattr(
                f"terrainloop._core.{name}", lambda *_, error=error, **__: (_ for _ in ()).throw(error)
            )
            with pytest.raises(TerrainLoopError):
                GradientMap.from_points(cloud, 0.5, 0.01, 0.02)


def test_available_memory_is_what_the_control_group_leaves(tmp_path):
    assert 0 < resources.available_memory() < 1e15
    own, group = tmp_path / "own", tmp_path / "job" / "step"
    group.mkdir(parents=True)
    own.write_text("0::/job/step\n")
    assert resources._left_in_cgroup(tmp_path, own) == np.inf
    (group / "memory.current").write_text("500\n")
    (group / "memory.stat").write_text("anon 300\ninactive_file 150\n")
    (group / "memory.max").write_text("max\n")
    assert resources._left_in_cgroup(tmp_path, own) == np.inf
    (group / "memory.max").write_text("1000\n")
    assert resources._left_in_cgroup(tmp_path, own) == 650.0


@pytest.mark.parametrize("workers", [0, -1, 1.5, None, "2", True])
def test_workers_must_be_a_positive_number(workers):
    cloud = np.random.default_rng(0).uniform(0, 3, (200, 3)) * [1, 1, 0.1]
    for call in (
        lambda: GradientMap.from_points(cloud, 0.5, 0.01, 0.02, workers=workers),
        lambda: ElevationProcess.from_points(cloud, 0.5, 0.01, 0.02, workers=workers),
        lambda: fit_hyperparameters([cloud], workers=workers),
    ):
        with pytest.raises(TerrainLoopError, match="workers"):
            call()


def test_more_workers_than_processors_are_not_started():
    cloud = np.random.default_rng(0).uniform(0, 3, (200, 3)) * [1, 1, 0.1]
    made = GradientMap.from_points(cloud, 0.5, 0.01, 0.02, workers=10**9)
    assert made.variance.tobytes() == GradientMap.from_points(cloud, 0.5, 0.01, 0.02).variance.tobytes()
