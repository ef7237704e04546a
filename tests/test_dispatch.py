"""The core that was loaded is the one for this CPU, those for other CPUs run there, and all agree."""

import re
import shutil
import subprocess
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from terrainloop import _core

CPUINFO = Path("/proc/cpuinfo")
DISPATCHES = find_spec("terrainloop._core.cpu") is not None
HIGHEST = 3  # level that is built
# As Linux calls what a level adds to the one below; the psABI for x86-64 lists them.
FLAGS = {
    2: {"pni", "ssse3", "cx16", "sse4_1", "sse4_2", "popcnt", "lahf_lm"},
    3: {"avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "xsave"},
    4: {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"},
}


def level_of_cpu():
    lines = CPUINFO.read_text().splitlines() if CPUINFO.is_file() else []
    flags = next((set(line.split(":")[1].split()) for line in lines if line.startswith("flags")), None)
    if flags is None:
        pytest.skip("needs Linux on x86-64 to tell the CPU's flags")
    return max((level for level in FLAGS if all(FLAGS[n] <= flags for n in range(2, level + 1))), default=0)


@pytest.mark.skipif(_core.VARIANT == "portable", reason="built for any CPU of the architecture")
def test_variant_is_that_of_the_cpu():
    level = min(level_of_cpu(), HIGHEST) if DISPATCHES else level_of_cpu()
    assert level == _core.LEVEL
    assert (f"x86-64-v{level}" if DISPATCHES else "native") == _core.VARIANT


@pytest.fixture(scope="module")
def variants():
    """Those that this CPU runs, from the least demanding on."""
    if not DISPATCHES:
        pytest.skip("this build has one variant")
    highest = import_module("terrainloop._core.cpu").level()
    found = [import_module(f"terrainloop._core.x86_64_v{level}") for level in range(2, highest + 1)]
    assert [core.VARIANT for core in found] == [f"x86-64-v{level}" for level in range(2, highest + 1)]
    return found


@pytest.mark.skipif(shutil.which("objdump") is None, reason="needs binutils to see the instructions")
@pytest.mark.parametrize(("name", "registers"), [("cpu", "yz"), ("x86_64_v2", "yz"), ("x86_64_v3", "z")])
def test_variant_has_no_instructions_above_its_level(name, registers):
    if not DISPATCHES:
        pytest.skip("this build has one variant")
    file = find_spec(f"terrainloop._core.{name}").origin
    instructions = subprocess.run(["objdump", "-d", file], capture_output=True, text=True, check=True).stdout
    assert len(instructions) > 10_000
    assert re.search(f"%[{registers}]mm", instructions) is None


def test_variants_find_the_same_keypoints(variants):
    noise = np.random.default_rng(0).normal(size=(2, 201, 201))
    image = np.hypot(*gaussian_filter(noise, (0, 3, 3))).astype(np.float32)
    keypoints, descriptors = variants[0].surf(image)
    assert len(keypoints) > 100
    for core in variants[1:]:
        found = core.surf(image)
        np.testing.assert_array_equal(found[0], keypoints)
        np.testing.assert_array_equal(found[1], descriptors)


def test_variants_make_the_same_maps(variants):
    rng = np.random.default_rng(1)
    xy = rng.uniform(0.0, 8.0, (3000, 2))
    elevation = np.sin(xy[:, 0]) * np.cos(1.3 * xy[:, 1]) + rng.normal(0.0, 0.02, len(xy))
    model = {"length_scale": 0.6, "variance": 0.3}
    grid = {"x": 0.0, "y": 0.0, "resolution": 0.1, "rows": 80, "cols": 80}
    noise = np.full(len(xy), 0.02)
    expected = variants[0].gp_predict_grid(xy, elevation, noise, **model, **grid)
    for core in variants[1:]:
        maps = core.gp_predict_grid(xy, elevation, noise, **model, **grid)
        for ours, theirs in zip(maps, expected, strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-4 * np.abs(theirs).max())
