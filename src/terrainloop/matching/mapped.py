"""A submap made ready to be compared."""

from dataclasses import dataclass

from terrainloop.config import Settings
from terrainloop.features import Features, extract_features
from terrainloop.gradient_map import GradientMap
from terrainloop.matching.search import SearchMap


@dataclass(frozen=True, eq=False)
class MappedSubmap:
    """What is kept of a submap: its gradient map, the keypoints on it, its fields for the dense search."""

    name: str
    gradient_map: GradientMap
    features: Features
    search_map: SearchMap

    @classmethod
    def of(cls, name: str, gradient_map: GradientMap, settings: Settings) -> "MappedSubmap":
        """Extract keypoints of the gradient magnitude where the ground is known, and the field."""
        features = extract_features(
            gradient_map.magnitude,
            gradient_map.mask,
            origin=gradient_map.origin,
            resolution=gradient_map.resolution,
            kind=settings.features.kind,
            max_keypoints=settings.features.max_keypoints,
        )
        return cls(name, gradient_map, features, SearchMap(gradient_map))
