"""Gaussian-process maps by several solvers on the same simulated stereo submaps: time, memory, error.

    python benchmarks/gp.py OUT [--threads 2] [--repeats 5] [--skip-slow]

Writes OUT/gp.json, OUT/gp.md (the tables of docs/solver.md) and OUT/gp.png (its plot). Each method runs in a
process of its own, with as many BLAS threads as ours has, and makes all maps: elevation, both gradients and
the variance (scikit-learn and GPyTorch: elevation and variance only). Ours makes the gradient's variance too.
GPyTorch is left out where it is not installed.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from provenance import processor
from scenes import stereo_submap

LENGTH_SCALE, VARIANCE, NOISE = 0.316, 0.01, 0.02
RESOLUTION = 0.03
SUBMAPS = {"10 m": (10.0, 100_000), "20 m": (20.0, 300_000)}
DRAWN = 5000
CROP = 2.6  # metres: a square small enough to be solved exactly from all its points


def surface(points):
    """Training data for every method: (N, 2) and (N,), the plane subtracted."""
    from terrainloop.gp.training import detrend

    made = detrend(points)
    return made.xy, made.elevation


def axes(xy, resolution=RESOLUTION):
    low, high = xy.min(axis=0), xy.max(axis=0)
    return [np.arange(a, b, resolution) for a, b in zip(low, high, strict=True)]


def textbook(xy, z, x, y, threads):
    """The dense solve by the book: one Cholesky factor, one triangular solve per pixel."""
    from scipy.linalg import cho_solve, cholesky, solve_triangular
    from threadpoolctl import threadpool_limits

    def kernel(a, b):
        distance = (a[:, :1] - b[:, 0]) ** 2 + (a[:, 1:] - b[:, 1]) ** 2
        return VARIANCE * np.exp(distance * (-0.5 / LENGTH_SCALE**2))

    with threadpool_limits(threads, user_api="blas"):
        lower = cholesky(kernel(xy, xy) + NOISE**2 * np.eye(len(xy)), lower=True, check_finite=False)
        weights = cho_solve((lower, True), z, check_finite=False)
        query = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        maps = np.empty((4, len(query)))
        for block in np.array_split(np.arange(len(query)), max(1, len(query) // 4000)):
            k = kernel(query[block], xy)
            maps[0, block] = k @ weights
            for axis in (0, 1):
                offset = query[block, axis][:, None] - xy[:, axis]
                maps[1 + axis, block] = -(offset * k) @ weights / LENGTH_SCALE**2
            half = solve_triangular(lower, k.T, lower=True, check_finite=False)
            maps[3, block] = VARIANCE - np.einsum("ij,ij->j", half, half)
    return maps.reshape(4, len(y), len(x))


def tiles(xy, z, x, y, threads):
    from terrainloop.gp import exact

    return ours(exact, xy, z, x, y, threads)


def spline(xy, z, x, y, threads):
    from terrainloop.gp import spline

    return ours(spline, xy, z, x, y, threads)


def ours(solver, xy, z, x, y, threads):
    from terrainloop.gp.grid import Grid
    from terrainloop.gp.kernel import Hyperparameters

    parameters, noise = Hyperparameters(LENGTH_SCALE, VARIANCE, NOISE), np.full(len(xy), NOISE)
    grid = Grid((x[0], y[0]), x[1] - x[0], (len(y), len(x)))
    made = solver.predict_grid(xy, z, noise, parameters, grid, workers=threads)
    return np.stack([made.elevation, made.gradient_x, made.gradient_y, made.variance, made.gradient_variance])


def scikit_learn(xy, z, x, y, threads):
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel
    from threadpoolctl import threadpool_limits

    kernel = ConstantKernel(VARIANCE) * RBF(LENGTH_SCALE)
    query = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    maps = np.full((4, len(query)), np.nan)
    with threadpool_limits(threads, user_api="blas"):
        model = GaussianProcessRegressor(kernel, alpha=NOISE**2, optimizer=None).fit(xy, z)
        for block in np.array_split(np.arange(len(query)), max(1, len(query) // 4000)):
            maps[0, block], deviation = model.predict(query[block], return_std=True)
            maps[3, block] = deviation**2
    return maps.reshape(4, len(y), len(x))


def gpytorch(kind):
    """GPyTorch's exact process, or its structured kernel interpolation with LOVE variances."""

    def solve(xy, z, x, y, threads):
        import torch
        from gpytorch.distributions import MultivariateNormal
        from gpytorch.kernels import GridInterpolationKernel, RBFKernel, ScaleKernel
        from gpytorch.likelihoods import GaussianLikelihood
        from gpytorch.means import ZeroMean
        from gpytorch.models import ExactGP
        from gpytorch.settings import fast_pred_var, max_cholesky_size

        torch.set_num_threads(threads)
        torch.set_default_dtype(torch.float64)
        inputs, targets = torch.tensor(xy), torch.tensor(z)

        class Model(ExactGP):
            def __init__(self, likelihood):
                super().__init__(inputs, targets, likelihood)
                base = RBFKernel()
                base.lengthscale = LENGTH_SCALE
                if kind == "ski":
                    size = [int(s / (0.4 * LENGTH_SCALE)) + 6 for s in np.ptp(xy, axis=0)]
                    base = GridInterpolationKernel(base, grid_size=size, num_dims=2)
                self.mean, self.kernel = ZeroMean(), ScaleKernel(base)
                self.kernel.outputscale = VARIANCE

            def forward(self, inputs):
                return MultivariateNormal(self.mean(inputs), self.kernel(inputs))

        likelihood = GaussianLikelihood()
        likelihood.noise = NOISE**2
        model = Model(likelihood).eval()
        query = torch.tensor(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
        maps = np.full((4, len(query)), np.nan)
        # Left alone, GPyTorch would solve 5000 points by conjugate gradients, which takes far longer.
        cholesky = max_cholesky_size(20_000 if kind == "exact" else 800)
        with torch.no_grad(), fast_pred_var(), cholesky:
            for block in np.array_split(np.arange(len(query)), max(1, len(query) // 4000)):
                made = model(query[block])
                maps[0, block], maps[3, block] = made.mean.numpy(), made.variance.numpy()
        return maps.reshape(4, len(y), len(x))

    return solve


METHODS = {
    "dense, textbook (NumPy, SciPy)": textbook,
    "dense, our tiles (`solver: exact`)": tiles,
    "scikit-learn": scikit_learn,
    "GPyTorch exact": gpytorch("exact"),
    "GPyTorch SKI + LOVE": gpytorch("ski"),
    "spline (`solver: spline`)": spline,
}
AS_DENSE = (
    "scikit-learn",
    "GPyTorch exact",
)  # a pixel costs as much as in the dense solve: the small submap is enough
OURS = "spline (`solver: spline`)"
EXACT = "dense, our tiles (`solver: exact`)"
TEXTBOOK = "dense, textbook (NumPy, SciPy)"


def memory_mb(field):
    """Peak memory of this process, from Linux; a forked child's ru_maxrss would be its parent's."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(field)) / 1024


def child(folder, method, threads, repeats):
    """Run in a process of its own: time, memory and maps of one method."""
    data = np.load(folder / "input.npz")
    xy, z, x, y = data["xy"], data["z"], data["x"], data["y"]
    before = memory_mb("VmRSS")
    walls, cpus = [], []
    for _ in range(repeats):
        wall, cpu = time.perf_counter(), time.process_time()
        maps = METHODS[method](xy, z, x, y, threads)
        walls.append(time.perf_counter() - wall)
        cpus.append(time.process_time() - cpu)
    np.save(folder / "maps.npy", maps)
    numbers = {"wall_s": walls, "cpu_s": cpus, "memory_mb": memory_mb("VmHWM") - before}
    (folder / "numbers.json").write_text(json.dumps(numbers))


def run(out, method, xy, z, x, y, threads, repeats):
    folder = out / "run"
    folder.mkdir(exist_ok=True)
    np.savez(folder / "input.npz", xy=xy, z=z, x=x, y=y)
    words = [sys.executable, __file__, folder, "--child", method, "--threads", threads, "--repeats", repeats]
    subprocess.run([str(word) for word in words], check=True)
    numbers = json.loads((folder / "numbers.json").read_text())
    numbers = {
        "wall_s": float(np.median(numbers["wall_s"])),
        "cpu_s": float(np.median(numbers["cpu_s"])),
        "memory_mb": numbers["memory_mb"],
    }
    print(f"  {method}: {numbers}", flush=True)
    return np.load(folder / "maps.npy"), numbers


def errors(maps, exact):
    """Relative errors where the exact variance is below a tenth of the prior's."""
    known = exact[3] < 0.1 * VARIANCE
    result = {"known": float(known.mean())}
    gradient = np.hypot(*exact[1:3])[known]
    off = np.hypot(maps[1] - exact[1], maps[2] - exact[2])[known]
    result["gradient"] = float(np.sqrt(np.mean(off**2) / np.mean(gradient**2)))
    for name, row in (("std", 3), ("gradient_std", 4)):
        if row < len(maps):
            share = np.abs(np.sqrt(np.maximum(maps[row], 0) / exact[row]) - 1)[known]
            result[f"{name}_median"] = float(np.median(share))
            result[f"{name}_99"] = float(np.percentile(share, 99))
    return result


def compare(out, threads, repeats, skip_slow):
    results = {}
    for name, (side, count) in SUBMAPS.items():
        points, _ = stereo_submap(side, count)
        xy, z = surface(points)
        x, y = axes(xy)
        drawn = np.sort(np.random.default_rng(0).choice(len(xy), DRAWN, replace=False))
        print(f"{name}: {len(xy)} points, {len(x)} x {len(y)} pixels", flush=True)
        exact, numbers = run(out, EXACT, xy[drawn], z[drawn], x, y, threads, 1)
        rows = {EXACT: numbers}
        for method in METHODS:
            missing = method.startswith("GPyTorch") and find_spec("gpytorch") is None
            slow = method not in (OURS, EXACT)
            again = method in AS_DENSE and name != next(iter(SUBMAPS))
            if method == EXACT or missing or again or (skip_slow and slow):
                continue
            maps, numbers = run(out, method, xy[drawn], z[drawn], x, y, threads, 1 if slow else repeats)
            rows[method] = numbers | {"errors": errors(maps, exact)}
        rows[f"{OURS}, every point"] = run(out, OURS, xy, z, x, y, threads, repeats)[1]
        inside = (np.abs(xy) < CROP / 2).all(axis=1)
        crop_axes = axes(xy[inside])
        exact_crop, _ = run(out, EXACT, xy[inside], z[inside], *crop_axes, threads, 1)
        maps, _ = run(out, OURS, xy[inside], z[inside], *crop_axes, threads, 1)
        crop = errors(maps, exact_crop) | {"points": int(inside.sum())}
        one, _ = run(out, OURS, xy, z, x, y, 1, 1)
        two, _ = run(out, OURS, xy, z, x, y, 2, 1)
        results[name] = {
            "points": len(xy),
            "pixels": [len(x), len(y)],
            "rows": rows,
            "crop": crop,
            "same_bytes_for_1_and_2_threads": bool(one.tobytes() == two.tobytes()),
        }
    return results


def scaling(out, threads, repeats):
    """Time over the number of points on one area, and over the area at one density, at 0.05 m per pixel."""
    rng = np.random.default_rng(1)
    sweeps = {"points on 20 x 20 m": [(20.0, n) for n in (20_000, 100_000, 300_000, 1_000_000, 2_000_000)]}
    sweeps["area at 200 points per m2"] = [(s, int(200 * s * s)) for s in (10.0, 20.0, 40.0, 70.0, 100.0)]
    results = {}
    for name, cases in sweeps.items():
        results[name] = []
        for side, count in cases:
            xy = rng.uniform(0, side, (count, 2))
            z = 0.1 * np.sin(2.1 * xy[:, 0]) * np.cos(1.7 * xy[:, 1]) + NOISE * rng.standard_normal(count)
            _, numbers = run(out, OURS, xy, z, *axes(xy, 0.05), threads, repeats if count < 1_000_000 else 1)
            results[name].append({"side_m": side, "points": count} | numbers)
    return results


def plot(results, path):
    import matplotlib as mpl

    mpl.use("agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    for panel, (name, cases) in zip(panels, results.items(), strict=True):
        area = name.startswith("area")
        abscissa = np.array([c["side_m"] ** 2 if area else c["points"] for c in cases])
        seconds = np.array([c["wall_s"] for c in cases])
        panel.loglog(abscissa, seconds, "o-", label="measured")
        panel.loglog(abscissa, seconds[-1] * abscissa / abscissa[-1], "k:", label="proportional")
        panel.set(xlabel="area, m²" if area else "points", ylabel="seconds", title=name)
        panel.grid(True, which="both", alpha=0.3)
        panel.legend()
    figure.savefig(path, dpi=120)


def markdown(results):
    machine = results["machine"]
    yield f"Machine: {machine['cpu']}, {machine['threads']} threads, NumPy's BLAS: {machine['blas']}.\n"
    for name, result in results["submaps"].items():
        baseline = result["rows"].get(TEXTBOOK)
        yield f"### {name}, {result['points']} points, {result['pixels'][0]} x {result['pixels'][1]} pixels\n"
        yield "| method | wall | CPU | memory | times faster | gradient RMSE | std, median / 99 % |"
        yield "|---|---|---|---|---|---|---|"
        for method, row in result["rows"].items():
            e = row.get("errors", {})
            faster = f"{baseline['wall_s'] / row['wall_s']:.0f}" if baseline else "-"
            gradient = f"{100 * e['gradient']:.3f} %" if np.isfinite(e.get("gradient", np.nan)) else "-"
            std = f"{100 * e['std_median']:.2f} / {100 * e['std_99']:.2f} %" if "std_median" in e else "-"
            yield (
                f"| {method} | {row['wall_s']:.3f} s | {row['cpu_s']:.3f} s | {row['memory_mb']:.0f} MB "
                f"| {faster} | {gradient} | {std} |"
            )
        c = {key: 100 * value for key, value in result["crop"].items() if key != "points"}
        yield (
            f"\nAll {result['crop']['points']} points of a crop of {CROP} m, against exact: gradient "
            f"{c['gradient']:.3f} %, std {c['std_median']:.2f} / {c['std_99']:.2f} %, gradient std "
            f"{c['gradient_std_median']:.2f} / {c['gradient_std_99']:.2f} %. Same bytes for 1 and 2 threads: "
            f"{result['same_bytes_for_1_and_2_threads']}.\n"
        )
    for name, cases in results["scaling"].items():
        yield f"### {name}\n\n| side | points | wall | memory |\n|---|---|---|---|"
        for c in cases:
            yield f"| {c['side_m']:.0f} m | {c['points']} | {c['wall_s']:.2f} s | {c['memory_mb']:.0f} MB |"
        yield ""


def machine(threads):
    from threadpoolctl import threadpool_info

    blas = {f"{i['internal_api']} {i['version']} ({i.get('architecture')})" for i in threadpool_info()}
    core = os.environ.get("OPENBLAS_CORETYPE")
    return {
        "cpu": processor(),
        "threads": threads,
        "blas": ", ".join(sorted(blas)) + (f", OPENBLAS_CORETYPE={core}" if core else ""),
        "python": platform.python_version(),
        "numpy": np.__version__,
    }


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--skip-slow", action="store_true", help="only ours")
    parser.add_argument("--child", choices=METHODS, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        child(options.out, options.child, options.threads, options.repeats)
        return
    options.out.mkdir(parents=True, exist_ok=True)
    results = {
        "machine": machine(options.threads),
        "submaps": compare(options.out, options.threads, options.repeats, options.skip_slow),
        "scaling": scaling(options.out, options.threads, options.repeats),
    }
    (options.out / "gp.json").write_text(json.dumps(results, indent=1))
    plot(results["scaling"], options.out / "gp.png")
    text = "\n".join(markdown(results))
    (options.out / "gp.md").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
