"""Any number of workers is either a TerrainLoopError or gives the same bytes, whatever the system grants."""

import subprocess
import sys

import numpy as np
import pytest

import terrainloop as tl
from terrainloop.errors import TerrainLoopError
from terrainloop.resources import available_processors, usable_workers

rng = np.random.default_rng(3)
XY = rng.uniform(0.0, 8.0, (1500, 2))
POINTS = np.column_stack([XY, np.sin(XY[:, 0]) * np.cos(1.3 * XY[:, 1]) + rng.normal(0.0, 0.02, len(XY))])


@pytest.mark.parametrize("workers", [0, -1, -(10**30), 1.5, "2", None, float("nan")])
def test_what_is_no_number_of_workers_is_refused(workers):
    with pytest.raises(TerrainLoopError, match="workers"):
        usable_workers(workers)
    with pytest.raises(TerrainLoopError, match="workers"):
        tl.GradientMap.from_points(POINTS, 0.6, 0.3, 0.02, workers=workers)
    with pytest.raises(TerrainLoopError, match="workers"):
        tl.fit_hyperparameters([POINTS], workers=workers)


def test_more_workers_than_processors_are_as_many_as_those():
    assert usable_workers(10**30) == available_processors() >= 1
    assert usable_workers(np.int64(1)) == 1


def test_a_great_many_workers_make_the_same_map():
    alone = tl.GradientMap.from_points(POINTS, 0.6, 0.3, 0.02)
    many = tl.GradientMap.from_points(POINTS, 0.6, 0.3, 0.02, workers=3000)
    np.testing.assert_array_equal(many.elevation, alone.elevation)
    np.testing.assert_array_equal(many.variance, alone.variance)


# The stack of a thread is as large as the limit on the stack, so that the limit on memory decides how many
# threads can start.
STARVED = """
import resource, sys
import numpy as np
from terrainloop import _core

xy = np.random.default_rng(0).uniform(0, 20, (3000, 2))
z = np.sin(xy[:, 0]) * np.cos(xy[:, 1])
call = {
    "noise": lambda threads: _core.gp_noise_ratio(xy, z, cell=0.5, threads=threads),
    "grid": lambda threads: _core.gp_predict_grid(
        xy, z, np.full(len(z), 0.1), length_scale=1.0, variance=1.0, x=0.0, y=0.0, resolution=0.5,
        rows=40, cols=40, threads=threads)[3],
    "likelihood": lambda threads: np.array(_core.gp_block_likelihood(
        [(xy, z, np.ones(len(z)))], length_scale=1.0, variance=1.0, noise=0.1, side=4.0, work=1e7,
        threads=threads)[0](1.0, 1.0, 0.1)[0]),
}[sys.argv[1]]
expected = call(1)
used = 4096 * int(open("/proc/self/statm").read().split()[0])
resource.setrlimit(resource.RLIMIT_AS, (used + int(sys.argv[2]), resource.RLIM_INFINITY))
for threads in (2, 4, 3000):
    assert call(threads).tobytes() == expected.tobytes()
print("done")
"""


@pytest.mark.skipif(sys.platform != "linux", reason="limits memory as Linux does")
@pytest.mark.parametrize("name", ["noise", "grid", "likelihood"])
@pytest.mark.parametrize("threads_that_start", [0, 1])
def test_threads_that_cannot_start_are_done_without(name, threads_that_start):
    import resource

    stack = 1 << 30
    free = (stack >> 1) + threads_that_start * stack
    most = resource.getrlimit(resource.RLIMIT_STACK)[1]
    if most != resource.RLIM_INFINITY and most < stack:
        pytest.skip("the limit on the stack cannot be raised here")

    def limit_stack():
        resource.setrlimit(resource.RLIMIT_STACK, (stack, most))

    done = subprocess.run(
        [sys.executable, "-c", STARVED, name, str(free)],
        preexec_fn=limit_stack,
        env={"OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": ":".join(sys.path)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.stdout == "done\n", done.stderr
