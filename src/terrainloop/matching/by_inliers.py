"""The paper's decision: Algorithm 1 on keypoint associations, then its n and h against thresholds."""

from dataclasses import replace

import numpy as np

from terrainloop.config import Settings
from terrainloop.geometry import transform
from terrainloop.loop import LoopCandidate
from terrainloop.matching.correspondences import Associations, associate
from terrainloop.matching.lift import covariance_of_inliers, lift_to_se3
from terrainloop.matching.mapped import MappedSubmap
from terrainloop.matching.ransac import Alignment, draws_of, inlier_radius_of, register_by_ransac
from terrainloop.matching.refine import refine
from terrainloop.matching.ssd import compute_ssd, ground_of, shared_ground


def compare_by_inliers(source: MappedSubmap, target: MappedSubmap, settings: Settings) -> LoopCandidate:
    """Algorithm 1, and acceptance where n reaches `min_inliers` and h stays below `max_ssd_ratio`."""
    associations = associate(source.features, target.features)
    alignment = align(source, target, associations, settings)
    if alignment is None:
        reason = f"no transform: no two of {len(associations)} associations agree on one"
        return LoopCandidate.without_transform(source.name, target.name, reason)
    if settings.match.refine and alignment.ssd.ratio <= settings.match.max_ssd_ratio:
        alignment = _refined(source, target, alignment)
    source_map, target_map = source.gradient_map, target.gradient_map
    shared = ground_of(shared_ground(source_map, target_map, alignment.T_target_source), target_map)
    matched = transform(alignment.T_target_source, associations.source[alignment.inliers])
    residuals = matched - associations.target[alignment.inliers]
    pivot = (shared if len(shared) else matched).mean(axis=0)
    floor = max(source_map.resolution, target_map.resolution) / np.sqrt(12)  # a keypoint is no better
    covariance_planar = covariance_of_inliers(matched - pivot, residuals, floor)
    T, covariance = lift_to_se3(source_map, target_map, alignment.T_target_source, pivot, covariance_planar)
    accepted, reason = _decide(alignment, settings)
    inliers = int(alignment.inliers.sum())
    return LoopCandidate(
        source=source.name,
        target=target.name,
        T_target_source=T,
        covariance=covariance,
        inliers=inliers,
        ssd=alignment.ssd.value,
        ssd_ratio=alignment.ssd.ratio,
        overlap=alignment.ssd.overlap,
        score=inliers * max(0.0, 1.0 - alignment.ssd.ratio),
        accepted=accepted,
        reason=reason,
        found_by="sparse",
    )


def align(
    source: MappedSubmap, target: MappedSubmap, associations: Associations, settings: Settings
) -> Alignment | None:
    """Algorithm 1 with the settings' thresholds and the draws that belong to these submaps."""
    return register_by_ransac(
        source.gradient_map,
        target.gradient_map,
        associations,
        iterations=settings.match.iterations,
        inlier_radius=inlier_radius_of(settings, target.gradient_map),
        max_ssd_ratio=settings.match.max_ssd_ratio,
        rng=draws_of(settings, source.name, target.name),
    )


def _refined(source: MappedSubmap, target: MappedSubmap, alignment: Alignment) -> Alignment:
    """The alignment at which the maps agree best; as it was, if that is no better."""
    refined = refine(source.gradient_map, target.gradient_map, alignment.T_target_source)
    if refined is None:
        return alignment
    ssd = compute_ssd(source.gradient_map, target.gradient_map, refined.T_target_source)
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
