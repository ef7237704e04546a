"""The one entry to matching: whether two gradient maps show the same place, and how they lie."""

import zlib
from dataclasses import replace

import numpy as np

from terrainloop.config import Settings
from terrainloop.features import Features, extract_features
from terrainloop.geometry import transform
from terrainloop.gradient_map import GradientMap
from terrainloop.loop import LoopCandidate
from terrainloop.matching.correspondences import Associations, associate
from terrainloop.matching.lift import lift_to_se3
from terrainloop.matching.ransac import Alignment, register_by_ransac
from terrainloop.matching.refine import refine
from terrainloop.matching.ssd import compute_ssd


def features_of(gradient_map: GradientMap, settings: Settings) -> Features:
    """Keypoints of the gradient magnitude where the ground is known."""
    return extract_features(
        gradient_map.magnitude,
        gradient_map.mask,
        origin=gradient_map.origin,
        resolution=gradient_map.resolution,
        kind=settings.features.kind,
        max_keypoints=settings.features.max_keypoints,
    )


def register(
    source_map: GradientMap,
    target_map: GradientMap,
    settings: Settings | None = None,
    *,
    source_features: Features | None = None,
    target_features: Features | None = None,
    names: tuple[str, str] = ("source", "target"),
) -> LoopCandidate:
    """Decide whether two maps show the same place, and estimate the transform between them.

    Parameters
    ----------
    source_map, target_map : GradientMap
    settings : Settings, optional
    source_features, target_features : Features, optional
        Of the maps, where they are already known (see `features_of`).
    names : tuple of str
        Of source and target; with the seed they also fix the random draws.

    Returns
    -------
    LoopCandidate
        Falsy if rejected; ``.reason`` says why.
    """
    settings = settings or Settings()
    associations = associate(
        features_of(source_map, settings) if source_features is None else source_features,
        features_of(target_map, settings) if target_features is None else target_features,
    )
    alignment = align(source_map, target_map, associations, settings, names)
    if alignment is None:
        return _rejected(names, f"no transform: no two of {len(associations)} associations agree on one")
    if settings.match.refine and alignment.ssd.ratio <= settings.match.max_ssd_ratio:
        alignment = _refined(source_map, target_map, alignment)
    matched = transform(alignment.T_target_source, associations.source[alignment.inliers])
    residuals = matched - associations.target[alignment.inliers]
    T, covariance = lift_to_se3(source_map, target_map, alignment.T_target_source, matched, residuals)
    accepted, reason = _decide(alignment, settings)
    inliers = int(alignment.inliers.sum())
    return LoopCandidate(
        source=names[0],
        target=names[1],
        T_target_source=T,
        covariance=covariance,
        inliers=inliers,
        ssd=alignment.ssd.value,
        ssd_ratio=alignment.ssd.ratio,
        overlap=alignment.ssd.overlap,
        score=inliers * max(0.0, 1.0 - alignment.ssd.ratio),
        accepted=accepted,
        reason=reason,
    )


def align(
    source_map: GradientMap,
    target_map: GradientMap,
    associations: Associations,
    settings: Settings,
    names: tuple[str, str] = ("source", "target"),
) -> Alignment | None:
    """Algorithm 1 with the settings' thresholds and the draws that belong to these names."""
    match = settings.match
    radius = match.inlier_radius or target_map.parameters.length_scale / 2
    return register_by_ransac(
        source_map,
        target_map,
        associations,
        iterations=match.iterations,
        inlier_radius=radius,
        max_ssd_ratio=match.max_ssd_ratio,
        rng=np.random.default_rng([settings.seed, *(zlib.crc32(name.encode()) for name in names)]),
    )


def _refined(source_map: GradientMap, target_map: GradientMap, alignment: Alignment) -> Alignment:
    """The alignment at which the maps agree best; as it was, if that is no better."""
    T = refine(source_map, target_map, alignment.T_target_source)
    ssd = compute_ssd(source_map, target_map, T)
    if not ssd.ratio < alignment.ssd.ratio:
        return alignment
    return replace(alignment, T_target_source=T, ssd=ssd)


def _decide(alignment: Alignment, settings: Settings) -> tuple[bool, str]:
    """The paper's test on the number of inliers n and the metric h, in words."""
    match, inliers, ratio = settings.match, int(alignment.inliers.sum()), alignment.ssd.ratio
    if ratio > match.max_ssd_ratio:
        return False, f"the gradients differ: SSD ratio {ratio:.2f} above {match.max_ssd_ratio:g}"
    if inliers < match.min_inliers:
        return False, f"too few associations agree: {inliers} inliers of the {match.min_inliers} needed"
    return True, f"{inliers} inliers, SSD ratio {ratio:.2f}"


def _rejected(names: tuple[str, str], reason: str) -> LoopCandidate:
    return LoopCandidate(
        source=names[0],
        target=names[1],
        T_target_source=np.full((4, 4), np.nan),
        covariance=np.full((6, 6), np.nan),
        inliers=0,
        ssd=np.nan,
        ssd_ratio=np.nan,
        overlap=0.0,
        score=0.0,
        accepted=False,
        reason=reason,
    )
