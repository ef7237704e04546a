"""The paper's decision: Algorithm 1 on keypoint associations, then its n and h against thresholds."""

from dataclasses import replace

import numpy as np

from terrainloop.config import Settings
from terrainloop.entry import MapEntry
from terrainloop.geometry import transform
from terrainloop.loop import LoopCandidate
from terrainloop.matching.correspondences import Associations, associate
from terrainloop.matching.lift import PlanarPrecision, covariance_of_inliers, lift_to_se3
from terrainloop.matching.overlay import Overlay
from terrainloop.matching.ransac import Alignment, inlier_radius_of, register_by_ransac, rng_for_pair
from terrainloop.matching.refine import refine
from terrainloop.matching.ssd import compute_ssd


def compare_by_inliers(source: MapEntry, target: MapEntry, settings: Settings) -> LoopCandidate:
    """Run Algorithm 1 and accept if n reaches `min_inliers` and the SSD ratio is below `max_ssd_ratio`."""
    associations = associate(source.features, target.features)
    alignment = align(source, target, associations, settings)
    if alignment is None:
        reason = f"no transform: no two of {len(associations)} associations agree on one"
        return LoopCandidate.without_transform(source.name, target.name, reason, score=0.0)
    if settings.match.refine and alignment.ssd.ratio <= settings.match.max_ssd_ratio:
        alignment = _refined(source, target, alignment, settings)
    overlay = Overlay(source.gradient_map, target.gradient_map, alignment.T_target_source)
    precision = _precision(overlay, alignment, associations)
    T, warp = lift_to_se3(overlay, precision, settings.calibration)
    accepted, reason = _decide(alignment, settings)
    inliers = int(alignment.inliers.sum())
    score = inliers * max(0.0, 1.0 - alignment.ssd.ratio)
    return LoopCandidate(
        source=source.name,
        target=target.name,
        T_target_source=T,
        covariance=warp.rigid,
        inliers=inliers,
        ssd=alignment.ssd.value,
        ssd_ratio=alignment.ssd.ratio,
        overlap=alignment.ssd.overlap,
        score=score,
        accepted=accepted,
        reason=reason,
        found_by="sparse",
        inlier_score=score,
        source_origin=source.gradient_map.local_origin,
        target_origin=target.gradient_map.local_origin,
    )


def align(
    source: MapEntry, target: MapEntry, associations: Associations, settings: Settings
) -> Alignment | None:
    """Algorithm 1 with the settings' thresholds and the pair's own random generator."""
    return register_by_ransac(
        source.gradient_map,
        target.gradient_map,
        associations,
        iterations=settings.match.iterations,
        inlier_radius=inlier_radius_of(settings, target.gradient_map),
        max_ssd_ratio=settings.match.max_ssd_ratio,
        rng=rng_for_pair(settings, source.name, target.name),
    )


def _precision(overlay: Overlay, alignment: Alignment, associations: Associations) -> PlanarPrecision:
    """Covariance of the alignment from its inliers, about the centroid of the overlap."""
    matched = transform(alignment.T_target_source, associations.source[alignment.inliers])
    residuals = matched - associations.target[alignment.inliers]
    pivot = (overlay.positions if len(overlay.positions) else matched).mean(axis=0)
    pixel = max(overlay.source.resolution, overlay.target.resolution)
    # A keypoint is known no better than to its pixel, whose standard deviation is side / sqrt(12).
    return PlanarPrecision(pivot, covariance_of_inliers(matched - pivot, residuals, pixel / np.sqrt(12)))


def _refined(source: MapEntry, target: MapEntry, alignment: Alignment, settings: Settings) -> Alignment:
    """The alignment at which the maps agree best, or the given one if that is no better."""
    maps = source.gradient_map, target.gradient_map
    refined = refine(*maps, alignment.T_target_source, settings.calibration)
    if refined is None:
        return alignment
    ssd = compute_ssd(Overlay(*maps, refined.T_target_source))
    if not ssd.ratio < alignment.ssd.ratio:
        return alignment
    return replace(alignment, T_target_source=refined.T_target_source, ssd=ssd)


def _decide(alignment: Alignment, settings: Settings) -> tuple[bool, str]:
    """The paper's test on the number of inliers n and the metric h, in words."""
    match, inliers, ratio = settings.match, int(alignment.inliers.sum()), alignment.ssd.ratio
    if ratio > match.max_ssd_ratio:
        return False, f"the gradients differ: SSD ratio {ratio:.2f} above {match.max_ssd_ratio:g}"
    if inliers < match.min_inliers:
        return False, f"too few associations agree: {inliers} inliers of the {match.min_inliers} needed"
    return True, f"{inliers} inliers, SSD ratio {ratio:.2f}"
