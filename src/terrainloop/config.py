"""Settings: few, in metres or dimensionless, derived from one another where they can be."""

from pathlib import Path
from typing import Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from terrainloop.errors import TerrainLoopError
from terrainloop.strict_yaml import read_yaml

_LONGEST_QUOTE = 120  # characters of a file or of a validator's message that an error quotes


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class MapSettings(_Frozen):
    """How a submap becomes a gradient map."""

    solver: Literal["spline", "exact"] = Field(
        "spline", description="spline: every point, in milliseconds; exact: dense, for a few thousand points"
    )
    max_points: int | None = Field(
        None, ge=50, le=10**9, description="points kept per submap, drawn at random; null: all"
    )
    fit_points: int | None = Field(
        5000, ge=50, le=10**9, description="points per submap that hyperparameters are fitted on; null: all"
    )
    length_scale: float | None = Field(
        None,
        ge=1e-4,
        le=1e4,
        description="starting length scale of the kernel, m; null: twice the point spacing",
    )
    noise: float | None = Field(
        None,
        ge=1e-9,
        le=1e4,
        description="starting accuracy of the elevations, m; null: a fifth of the relief",
    )
    local_noise: bool = Field(
        True, description="scale each point's noise by the scatter and the number of the points around it"
    )
    fit: Literal["database", "submap"] = Field(
        "database", description="maximise the likelihood once (maps stay comparable) or for every submap"
    )
    resolution: float | None = Field(
        None, ge=1e-5, le=1e4, description="grid spacing, m per pixel; null: a sixth of the length scale"
    )
    remove_plane: bool = Field(
        True, description="take a plane out, and points far off it; give its slope back"
    )
    max_variance_ratio: float = Field(
        0.25, gt=0, lt=1, description="ground is known where the variance is below this share of the prior's"
    )


class FeatureSettings(_Frozen):
    """Keypoints on the gradient map."""

    kind: Literal["surf", "sift", "orb"] = Field("sift", description="detector and descriptor")
    max_keypoints: int = Field(500, ge=2, le=10**5, description="strongest keypoints kept per map")


class MatchSettings(_Frozen):
    """How two maps are compared, and what makes a loop."""

    decision: Literal["evidence", "inliers"] = Field(
        "evidence", description="evidence: false alarms expected by chance; inliers: Algorithm 1 of the paper"
    )
    max_false_loops: float = Field(
        0.01, gt=0, le=1e6, description="evidence: false loops to be expected in a whole mission"
    )
    iterations: int = Field(5000, ge=1, le=10**7, description="pairs of keypoint associations drawn")
    inlier_radius: float | None = Field(
        None, ge=1e-5, le=1e5, description="largest distance of an inlier, m; null: half the length scale"
    )
    min_inliers: int = Field(5, ge=2, le=10**6, description="inliers: as many make a loop (n_min)")
    max_ssd_ratio: float = Field(
        0.5, gt=0, le=1e6, description="inliers: largest SSD, as a share of what unrelated ground would give"
    )
    refine: bool = Field(True, description="inliers: settle the pose on the gradients of all shared ground")


class Settings(_Frozen):
    """Everything a run depends on; written beside every result."""

    # The comments of YAML sections; docstrings are gone under python -OO.
    map: MapSettings = Field(MapSettings(), description="how a submap becomes a gradient map")
    features: FeatureSettings = Field(FeatureSettings(), description="keypoints on the gradient map")
    match: MatchSettings = Field(
        MatchSettings(), description="how two maps are compared, and what makes a loop"
    )
    skip_recent: int = Field(
        1, ge=0, le=10**6, description="submaps just before the query that are not compared"
    )
    seed: int = Field(0, ge=0, lt=2**63, description="of every random draw")

    @classmethod
    def preset(cls, name: str) -> "Settings":
        """Settings by name: ``default``, or ``paper`` for the pipeline of Le Gentil et al. (2020).

        Raises
        ------
        TerrainLoopError
            For any other name.
        """
        if name == "default":
            return cls()
        if name == "paper":
            return cls(
                map=MapSettings(
                    solver="exact",
                    max_points=5000,
                    length_scale=0.316,
                    noise=0.02,
                    local_noise=False,
                    fit="submap",
                    resolution=0.03,
                    remove_plane=False,
                ),
                features=FeatureSettings(kind="surf"),
                match=MatchSettings(decision="inliers", inlier_radius=0.09, max_ssd_ratio=1.0, refine=False),
            )
        raise TerrainLoopError(
            expected="preset 'default' or 'paper'", found=repr(name), mend="name one of the two"
        )

    @classmethod
    def from_yaml(cls, path: Path | str) -> "Settings":
        """Read settings; what the file leaves out keeps its default.

        Raises
        ------
        TerrainLoopError
            If the file cannot be read, is no YAML mapping, or holds an unknown or impossible value.
        """
        content = read_yaml(path)
        try:
            return cls.model_validate({} if content is None else content, strict=True)
        except ValidationError as error:
            first = error.errors()[0]
            where = "".join(c for c in ".".join(map(str, first["loc"])) if c.isprintable()) or "the file"
            raise TerrainLoopError(
                expected=f"valid settings in {path}",
                found=f"{where[:_LONGEST_QUOTE]}: {first['msg'].lower()[:_LONGEST_QUOTE]}",
                mend="start from the output of 'terrainloop config'",
            ) from error

    def to_yaml(self) -> str:
        """The settings as YAML, each with its meaning as a comment."""
        return "\n".join(_yaml_lines(self, "")) + "\n"


def _yaml_lines(model: BaseModel, indent: str) -> list[str]:
    lines = []
    for name, field in type(model).model_fields.items():
        value = getattr(model, name)
        if isinstance(value, BaseModel):
            lines += [f"{indent}{name}:  # {field.description}", *_yaml_lines(value, indent + "  ")]
        else:
            scalar = "null" if value is None else yaml.safe_dump(value).removesuffix("...\n").strip()
            lines.append(f"{indent}{name}: {scalar}  # {field.description}")
    return lines
