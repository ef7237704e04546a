"""The paper's pictures: a gradient map in the making, two maps matched, precision and recall."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrainloop.config import Settings
from terrainloop.entry import MapEntry
from terrainloop.errors import TerrainLoopError
from terrainloop.evaluation.summary import Evaluation
from terrainloop.evaluation.trajectory_error import trajectory_error
from terrainloop.geometry import Array, se2, transform, yaw_of
from terrainloop.gradient_map import GradientMap
from terrainloop.io.files import write_whole
from terrainloop.io.trajectories import Trajectory
from terrainloop.loop import LoopCandidate
from terrainloop.matching.correspondences import Associations, associate
from terrainloop.matching.overlay import Overlay
from terrainloop.matching.ransac import get_inliers, inlier_radius_of
from terrainloop.report import INSTALL_FIGURES
from terrainloop.slam.mosaic import Mosaic
from terrainloop.submap import Submap

try:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure
    from matplotlib.patches import ConnectionPatch
except ImportError as error:
    raise TerrainLoopError(
        expected="matplotlib, which draws the pictures", found=str(error), mend=INSTALL_FIGURES
    ) from error

SOURCE_COLOUR, TARGET_COLOUR = "#d1495b", "#00798c"
DRAWN_POINTS = 40_000  # more do not show at this size
LONG_NUMBER = 1e5  # metres: eastings are too wide for the usual number of ticks
_CRITERION_STYLES = {  # thinner over thicker, where curves coincide
    "pose": (TARGET_COLOUR, 4.0),
    "overlap and pose": ("#edae49", 2.4),
    "overlap": ("0.1", 0.9),
}


def figure_map(submap: Submap | None, gradient_map: GradientMap) -> Figure:
    """From a cloud to its gradient map: cloud, elevation, deviation, gradients (paper, Fig. 3).

    Without the cloud, the first panel shows the observed area.
    """
    figure = Figure(figsize=(13, 7.5), layout="constrained")
    cloud = "" if submap is None else f"{submap.name}: {len(submap):,} points, "
    figure.suptitle(
        f"{cloud}length scale {gradient_map.parameters.length_scale:.3g} m, "
        f"{gradient_map.resolution:.3g} m per pixel",
        parse_math=False,  # here and below: names may hold dollars
    )
    first = figure.add_subplot(2, 3, 1)
    if submap is None:
        first.imshow(gradient_map.mask, origin="lower", extent=gradient_map.extent, cmap="gray", vmin=-1)
        _finish(first, "(a) observed area")
    else:
        _draw_cloud(figure, first, submap)
    steep = _steepest(gradient_map)
    panels: list[tuple[str, NDArray[np.float32], str, str, dict[str, Any]]] = [
        ("(b) elevation", gradient_map.elevation, "gist_earth", "m", {}),
        ("(c) standard deviation", np.sqrt(gradient_map.variance), "inferno", "m", {}),
        ("(d) gradient along x", gradient_map.gradient_x, "RdBu", "", {"vmin": -steep, "vmax": steep}),
        ("(e) gradient along y", gradient_map.gradient_y, "RdBu", "", {"vmin": -steep, "vmax": steep}),
        ("(f) gradient map", gradient_map.magnitude, "gray", "", {"vmin": 0.0, "vmax": steep}),
    ]
    for panel, (title, image, colours, unit, limits) in enumerate(panels, start=2):
        axes = figure.add_subplot(2, 3, panel)
        shown = axes.imshow(image, origin="lower", extent=gradient_map.extent, cmap=colours, **limits)
        if panel > 3:
            _veil(axes, gradient_map)
        _finish(axes, title)
        _colour_bar(figure, axes, shown, unit)
    return figure


def _colour_bar(figure: Figure, axes: Axes, shown: ScalarMappable, unit: str) -> None:
    figure.colorbar(shown, ax=axes, label=unit).ax.ticklabel_format(useOffset=False)


def _draw_cloud(figure: Figure, axes: Axes, submap: Submap) -> None:
    drawn = submap.points[:: max(1, len(submap) // DRAWN_POINTS)]
    low, high = np.percentile(drawn[:, 2], [0.5, 99.5])  # a flying pixel must not take the colours
    heights: dict[str, Any] = {"c": drawn[:, 2], "cmap": "gist_earth", "vmin": low, "vmax": high}
    dots = axes.scatter(drawn[:, 0], drawn[:, 1], s=0.3, linewidths=0, **heights)
    _finish(axes, "(a) point cloud, height")
    _colour_bar(figure, axes, dots, "m")


def figure_match(source: MapEntry, target: MapEntry, candidate: LoopCandidate, settings: Settings) -> Figure:
    """Two maps, their associations, and the maps laid over each other (paper, Fig. 4)."""
    source_map, target_map = source.gradient_map, target.gradient_map
    associations = associate(source.features, target.features)
    T = _planar(candidate.T_target_source)
    inliers = get_inliers(associations, T[None], inlier_radius_of(settings, target_map))[0]
    figure = Figure(figsize=(13, 11), layout="constrained")
    verdict = "loop closure" if candidate else "no loop closure"
    figure.suptitle(
        f"{candidate.source} to {candidate.target}: {verdict} ({candidate.reason})", parse_math=False
    )
    grid = figure.add_gridspec(2, 2)
    left, right = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[0, 1])
    for axes, gradient_map, role, name in (
        (left, source_map, "source", candidate.source),
        (right, target_map, "target", candidate.target),
    ):
        _show_magnitude(axes, gradient_map)
        _finish(axes, f"{role} {name}")
    right.yaxis.tick_right()  # out of the way of the associations
    right.yaxis.set_label_position("right")
    _draw_associations(figure, left, right, associations, inliers)
    if np.isfinite(T).all():
        _show_overlay(figure.add_subplot(grid[1, 0]), Overlay(source_map, target_map, T))
        _show_both(figure.add_subplot(grid[1, 1]), source_map, target_map, T)
    return figure


def figure_mission(
    names: Sequence[str],
    poses: Array,
    hulls: Sequence[Array],
    loops: Sequence[LoopCandidate],
    *,
    title: str,
) -> Figure:
    """Submaps where their poses put them, and the loops found between them.

    Parameters
    ----------
    names : sequence of str, (M,)
    poses : array, (M, 4, 4)
        T_world_submap.
    hulls : sequence of (K, 2) arrays
        Outline of each submap in its own frame, metres.
    loops : sequence of LoopCandidate
    title : str
    """
    figure = Figure(figsize=(9, 8), layout="constrained")
    axes = figure.add_subplot()
    index = {name: number for number, name in enumerate(names)}
    for hull, pose in zip(hulls, poses, strict=True):
        outline = transform(pose, np.c_[hull, np.zeros(len(hull))])
        axes.fill(outline[:, 0], outline[:, 1], color=TARGET_COLOUR, alpha=0.06, linewidth=0)
        axes.plot(*np.vstack([outline, outline[:1]])[:, :2].T, color=TARGET_COLOUR, alpha=0.35, linewidth=0.7)
    axes.plot(poses[:, 0, 3], poses[:, 1, 3], "o-", color="0.3", markersize=4, linewidth=1, label="path")
    for number, loop in enumerate(loops):
        ends = np.array([poses[index[loop.source], :2, 3], poses[index[loop.target], :2, 3]])
        axes.plot(*ends.T, color=SOURCE_COLOUR, linewidth=1.6, label=None if number else "loop closure")
    for name, pose in zip(names, poses, strict=True):
        axes.annotate(
            name.lstrip("0") or "0",
            pose[:2, 3],
            fontsize=7,
            xytext=(3, 3),
            textcoords="offset points",
            parse_math=False,
        )
    axes.legend(loc="best")
    _finish(axes, title)
    return figure


def figure_trajectory(
    before: Trajectory, after: Trajectory, loop_ends: Array, truth: Trajectory | None = None
) -> Figure:
    """A trajectory as recorded and as corrected by its loops, and the true one where it is known.

    Parameters
    ----------
    before, after : Trajectory
        In one world.
    loop_ends : array, (L, 2, 2)
        Positions (x, y) of the two submaps of each loop.
    truth : Trajectory, optional
        Moved and turned about the vertical to fit the corrected trajectory.
    """
    figure = Figure(figsize=(9, 8), layout="constrained")
    axes = figure.add_subplot()
    if truth is not None:
        aligned = np.linalg.inv(trajectory_error(after, truth).T_truth_estimate) @ truth.poses
        axes.plot(*aligned[:, :2, 3].T, color="0.75", linewidth=4, label="truth")
    axes.plot(*before.poses[:, :2, 3].T, "--", color=SOURCE_COLOUR, linewidth=1.2, label="odometry")
    axes.plot(*after.poses[:, :2, 3].T, color=TARGET_COLOUR, linewidth=1.6, label="corrected")
    for number, ends in enumerate(loop_ends):
        label = None if number else f"{len(loop_ends)} loop closures"
        axes.plot(*ends.T, color="#edae49", linewidth=0.8, alpha=0.7, label=label, zorder=1)
    axes.plot(*after.poses[0, :2, 3], "o", color="0.1", markersize=6, label="start")
    axes.legend(loc="best")
    way = np.linalg.norm(np.diff(after.poses[:, :3, 3], axis=0), axis=1).sum()
    _finish(axes, f"Trajectory of {way:.0f} m, before and after")
    return figure


def figure_mosaic(mosaic: Mosaic) -> Figure:
    """Shaded relief of the ground that was mapped, lit from the north-west, and its elevation."""
    figure = Figure(figsize=(10, 8), layout="constrained")
    axes = figure.add_subplot()
    rows, columns = mosaic.elevation.shape
    (x, y), r = mosaic.origin, mosaic.resolution
    extent = (x - r / 2, x + (columns - 0.5) * r, y - r / 2, y + (rows - 0.5) * r)
    light = np.array([-1.0, 1.0, 1.5])
    normal = np.stack([-mosaic.gradient_x, -mosaic.gradient_y, np.ones_like(mosaic.gradient_x)])
    shade = np.tensordot(light / np.linalg.norm(light), normal, 1) / np.linalg.norm(normal, axis=0)
    axes.set_facecolor("#e8edf2")  # of no value of either scale
    axes.imshow(shade, origin="lower", extent=extent, cmap="gray", vmin=0.2, vmax=1.0)
    low, high = np.nanpercentile(mosaic.elevation, [1, 99])
    image = axes.imshow(
        mosaic.elevation, origin="lower", extent=extent, cmap="cividis", alpha=0.35, vmin=low, vmax=high
    )
    figure.colorbar(image, ax=axes, shrink=0.7, label="elevation, m")
    _finish(axes, f"Shaded relief, {r:.3g} m per pixel")
    return figure


def figure_precision_recall(evaluation: Evaluation) -> Figure:
    """Precision against recall, and both against the threshold (paper, Figs. 8 and 9), foremost by pose.

    The curves have a step at every distinct score, so that the area beneath is the average precision; the
    cross marks the accepted loops.
    """
    figure = Figure(figsize=(10, 4.6), layout="constrained")
    curve, by_threshold = figure.subplots(1, 2)
    true = evaluation.metrics["box", "pose"].true_pairs
    figure.suptitle(
        f"{len(evaluation.loops)} loops accepted, {len(evaluation.right_loops)} with the right pose; "
        f"{true} true pairs (bounding-box IoU > {evaluation.min_overlap:g}), {evaluation.found()} found"
    )
    _draw_curves(curve, evaluation)
    _draw_thresholds(by_threshold, evaluation)
    for axes in (curve, by_threshold):
        axes.set_ylim(-0.03, 1.03)
        axes.grid(alpha=0.3)
        axes.legend(loc="best", fontsize=8)
    return figure


def _draw_curves(axes: Axes, evaluation: Evaluation) -> None:
    for name, (colour, width) in _CRITERION_STYLES.items():
        steps = evaluation.criteria["box", name].curve()
        drawn = [(0.0, p.precision) for p in steps[:1]] + [(p.recall, p.precision) for p in steps]
        label = f"right by {name}: AP {evaluation.metrics['box', name].average_precision}"
        recall, precision = np.reshape(drawn, (-1, 2)).T
        axes.plot(recall, precision, color=colour, linewidth=width, drawstyle="steps-pre", label=label)
    found, true = evaluation.found(), evaluation.metrics["box", "pose"].true_pairs
    wrong = len(evaluation.loops) - len(evaluation.right_loops)
    if true and found + wrong:
        accepted = found / true, found / (found + wrong)
        mark: dict[str, Any] = {
            "color": SOURCE_COLOUR,
            "markersize": 9,
            "markeredgewidth": 2.2,
            "clip_on": False,
            "zorder": 5,
        }
        axes.plot(accepted[0], accepted[1], "x", label="accepted loops, by pose", **mark)
    axes.set(xlabel="recall", ylabel="precision", xlim=(-0.03, 1.03))


def _draw_thresholds(axes: Axes, evaluation: Evaluation) -> None:
    thresholds = range(len(evaluation.table))  # evenly spaced, since they grow faster than linearly
    lines: list[tuple[str, str, dict[str, Any]]] = [
        ("pose_precision", "precision by pose", {"color": TARGET_COLOUR, "marker": "o", "linewidth": 4.0}),
        ("pose_recall", "recall by pose", {"color": SOURCE_COLOUR, "marker": "s", "linewidth": 2.0}),
        ("precision", "precision by overlap", {"color": "0.1", "linewidth": 0.9}),
        ("recall", "recall by overlap", {"color": "0.1", "linewidth": 0.9, "linestyle": "--"}),
    ]
    for key, label, style in lines:
        values = [row[key] for row in evaluation.table]
        axes.plot(thresholds, values, label=label, markersize=4, **style)
    name = f"min_{evaluation.score_name}"
    axes.set_xticks(thresholds, [str(row[name]) for row in evaluation.table])
    axes.set(xlabel=f"minimum {evaluation.score_name}", ylabel="precision, recall")


def save_figure(figure: Figure, path: Path) -> None:
    """Write a PNG, whole or not at all; the same figure gives the same bytes."""
    if path.suffix.lower() != ".png":
        raise TerrainLoopError(expected="a picture that ends in .png", found=str(path), mend="rename it")
    write_whole(path, lambda file: figure.savefig(file, format="png", dpi=110, metadata={"Software": None}))


def _steepest(gradient_map: GradientMap) -> float:
    """Slope that is drawn as full contrast."""
    known = gradient_map.magnitude[gradient_map.mask]
    return (float(np.percentile(known, 99)) if known.size else 0.0) or 1.0


def _veil(axes: Axes, gradient_map: GradientMap) -> None:
    """Cover the ground that is not known with white."""
    veil = np.ones((*gradient_map.mask.shape, 4))
    veil[..., 3] = np.where(gradient_map.mask, 0.0, 0.85)
    axes.imshow(veil, origin="lower", extent=gradient_map.extent)


def _show_magnitude(axes: Axes, gradient_map: GradientMap) -> None:
    steep = _steepest(gradient_map)
    axes.imshow(
        gradient_map.magnitude, origin="lower", extent=gradient_map.extent, cmap="gray", vmin=0, vmax=steep
    )
    _veil(axes, gradient_map)


def _draw_associations(
    figure: Figure, left: Axes, right: Axes, associations: Associations, inliers: NDArray[np.bool_]
) -> None:
    for colour, chosen, width in (("0.6", ~inliers, 0.3), (SOURCE_COLOUR, inliers, 1.2)):
        left.plot(*associations.source[chosen].T, ".", color=colour, markersize=4)
        right.plot(*associations.target[chosen].T, ".", color=colour, markersize=4)
        for a, b in zip(associations.source[chosen], associations.target[chosen], strict=True):
            line = ConnectionPatch(
                a, b, "data", "data", axesA=left, axesB=right, color=colour, linewidth=width
            )
            line.set_in_layout(False)
            figure.add_artist(line)


def _planar(T_target_source: Array) -> Array:
    """SE(2) part of an SE(3) transform that is nearly upright."""
    return se2(T_target_source[0, 3], T_target_source[1, 3], yaw_of(T_target_source))


def _show_overlay(axes: Axes, overlay: Overlay) -> None:
    """Source in one colour over the target in its opposite: grey where they agree."""
    target = overlay.target
    steep = _steepest(target)
    image = np.ones((*overlay.shared.shape, 3))
    image[overlay.shared, 0] = np.clip(overlay.of_source(overlay.source.magnitude) / steep, 0, 1)
    image[overlay.shared, 1:] = np.clip(overlay.of_target(target.magnitude) / steep, 0, 1)[:, None]
    axes.imshow(image, origin="lower", extent=target.extent)
    _finish(axes, "aligned overlap: grey agrees, red source only, cyan target only")


def _show_both(axes: Axes, source_map: GradientMap, target_map: GradientMap, T_planar: Array) -> None:
    """Observed areas of both maps, that of the source moved into the frame of the target."""
    for gradient_map, T, colour in (
        (target_map, np.eye(3), TARGET_COLOUR),
        (source_map, T_planar, SOURCE_COLOUR),
    ):
        rows, columns = np.indices(gradient_map.mask.shape)
        pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2) * gradient_map.resolution
        x, y = transform(T, pixels + gradient_map.origin).T.reshape(2, *gradient_map.mask.shape)
        axes.contourf(x, y, gradient_map.mask, levels=[0.5, 1.5], colors=[colour], alpha=0.35)
    _finish(axes, "observed areas: source (red) over target (blue), target frame")


def _finish(axes: Axes, title: str) -> None:
    axes.set(xlabel="x, m", ylabel="y, m", aspect="equal")
    axes.ticklabel_format(style="plain", useOffset=False)
    if max(map(abs, axes.get_xlim())) >= LONG_NUMBER:
        axes.locator_params(axis="x", nbins=4)
    axes.set_title(title, fontsize=10, parse_math=False)
