"""Settings: few, in metres or dimensionless, derived from one another where possible."""

from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import yaml
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    ValidationError,
    model_validator,
)

from terrainloop.errors import TerrainLoopError
from terrainloop.strict_yaml import read_yaml

_LONGEST_QUOTE = 120  # characters of a file or of a validator's message that an error quotes


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    section: ClassVar[str] = ""

    @model_validator(mode="wrap")
    @classmethod
    def _our_errors(cls, data: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        try:
            return handler(data)
        except ValidationError as error:
            first = error.errors()[0]
            names = map(str, (*filter(None, [cls.section]), *first["loc"]))
            where = "".join(c for c in ".".join(names) if c.isprintable()) or "at the top level"
            raise TerrainLoopError(
                expected="valid settings",
                found=f"{where[:_LONGEST_QUOTE]}: {first['msg'].lower()[:_LONGEST_QUOTE]}",
                mend="see the output of 'terrainloop config'",
            ) from error


class MapSettings(_Frozen):
    """How a gradient map is made from a submap."""

    section = "map"
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
        "database",
        description="database: length scale and variance in common, noise each cloud's own; "
        "submap: all of them for every submap",
    )
    resolution: float | None = Field(
        None, ge=1e-5, le=1e4, description="grid spacing, m per pixel; null: a sixth of the length scale"
    )
    remove_plane: bool = Field(
        True, description="subtract a robust plane fit and drop gross outliers; add its slope afterwards"
    )
    max_variance_ratio: float = Field(
        0.25,
        gt=0,
        lt=1,
        description="ground is observed where the variance is below this share of the prior's",
    )


class FeatureSettings(_Frozen):
    """Keypoints on the gradient map."""

    section = "features"
    kind: Literal["surf", "sift", "orb"] = Field("sift", description="detector and descriptor")
    max_keypoints: int = Field(500, ge=2, le=10**5, description="strongest keypoints kept per map")


class MatchSettings(_Frozen):
    """How two maps are compared, and what makes a loop closure."""

    section = "match"
    decision: Literal["evidence", "inliers"] = Field(
        "evidence", description="evidence: number of false alarms; inliers: Algorithm 1 of the paper"
    )
    max_false_loops: float = Field(
        0.01, gt=0, le=1e6, description="evidence: expected number of false loop closures per mission"
    )
    iterations: int = Field(5000, ge=1, le=10**7, description="RANSAC draws of two keypoint associations")
    inlier_radius: float | None = Field(
        None, ge=1e-5, le=1e5, description="largest distance of an inlier, m; null: half the length scale"
    )
    min_inliers: int = Field(5, ge=2, le=10**6, description="inliers: minimum number of inliers, n_min")
    max_ssd_ratio: float = Field(
        0.5, gt=0, le=1e6, description="inliers: largest SSD, relative to that of unrelated ground"
    )
    refine: bool = Field(
        True, description="inliers: refine the pose by least squares on all overlapping gradients"
    )


def _from_list(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


_Triple = Annotated[tuple[float, float, float], BeforeValidator(_from_list)]  # YAML has lists only


class Calibration(_Frozen):
    """Measured constants that `max_false_loops` rests on (docs/calibration.md); not meant to be changed."""

    section = "calibration"
    # The gradient field (docs/matching.md, section 1)
    pixels_per_length_scale: float = Field(2.0, gt=0, description="field: pixels per length scale")
    max_pixels: int = Field(96, ge=8, description="field: pixels across; larger maps take twice the spacing")
    blur: float = Field(0.4, gt=0, description="field: standard deviation of the low-pass filter, pixels")
    spectrum_smoothing: float = Field(
        1.5, gt=0, description="field: smoothing of the power spectrum, cycles per width"
    )
    whitening_floor: float = Field(0.3, gt=0, description="field: added to the spectrum, share of its mean")
    clip: float = Field(1.5, gt=0, description="field: soft-clipping scale, robust standard deviations")
    # Hypotheses (section 2)
    rotation_step: float = Field(
        1.0, gt=0, description="search: RMS motion of the ground per rotation, pixels"
    )
    min_shared_area: float = Field(
        20.0, gt=0, description="search: smallest shared area, squared length scales"
    )
    min_separation: float = Field(
        1.5, gt=0, description="search: smallest distance of two places, length scales"
    )
    peak_threshold: float = Field(
        6.0, gt=0, description="search: smallest r^2 of a candidate, in units of its mean"
    )
    wraparound: float = Field(
        0.8, gt=0, le=1, description="search: size of the FFT, share of that without wrap-around"
    )
    candidates: int = Field(11, ge=1, description="search: places whose surprisal is kept for the null")
    dense_hypotheses: int = Field(
        2, ge=0, description="places refined to see if a pair is significant; if it is, all are"
    )
    # Significance (section 3)
    tail: float = Field(0.85, gt=0, description="calibrated nats per nat of the correlation's formula")
    independent_tests: float = Field(
        0.05, gt=0, description="independent tests per rotation step and squared length scale of shift"
    )
    max_correlation: float = Field(0.999, gt=0, lt=1, description="correlations above it count as this one")
    null_pairs: int = Field(300, ge=0, description="mirror images compared per mission, about")
    null_share: float = Field(0.3, gt=0, lt=1, description="share of them that the tail is fitted to")
    null_margin: float = Field(
        1.5, ge=1, description="factor of what their tail exceeds that of the law of one pair by"
    )
    null_prior: int = Field(20, ge=2, description="scores of the law of one pair that are added to theirs")
    # Decision (section 3)
    min_correlation: float = Field(
        0.25, ge=0, lt=1, description="smallest correlation of the fields of a loop closure"
    )
    min_participation: float = Field(
        0.2, ge=0, lt=1, description="smallest share of the shared ground that the agreement rests on"
    )
    ambiguity_ratio: float = Field(0.5, gt=0, description="surprisal of a rival pose, share of the best's")
    equivalence_ratio: float = Field(
        0.7, gt=0, description="the same, above which a rival counts however likely it is by chance"
    )
    ambiguity_chance: float = Field(0.01, gt=0, description="NFA above which a rival is left to chance")
    # Covariance (section 4)
    block: float = Field(2.0, gt=0, description="side of the independent blocks of ground, length scales")
    noise_factor: float = Field(
        2.5, gt=0, description="variance of a pose by noise, over that of independent blocks"
    )
    warp_noise_factor: float = Field(5.0, gt=0, description="the same of a warp")
    usual_warp: float = Field(0.0009, gt=0, description="standard deviation of a submap's warp, a priori")
    usual_warp_samples: float = Field(1.0, gt=0, description="number of samples that this prior is worth")
    reach_of_radius: float = Field(
        2.8, ge=0, description="squared reach per squared radius of the shared ground"
    )
    motion_by_warp: _Triple = Field(
        (60.0, 60.0, 26.0), description="variance of x, y, z per squared metre of reach, per warp variance"
    )
    rotation_by_warp: _Triple = Field(
        (40.0, 40.0, 350.0), description="variance of roll, pitch, yaw per warp variance"
    )


class Settings(_Frozen):
    """Everything that a run depends on; written beside every result.

    ``Settings(max_false_loops=0.1)`` is short for ``Settings(match={"max_false_loops": 0.1})``.
    """

    # The comments of YAML sections are Field descriptions; docstrings are gone under python -OO.
    map: MapSettings = Field(MapSettings(), description="how a gradient map is made from a submap")
    features: FeatureSettings = Field(FeatureSettings(), description="keypoints on the gradient map")
    match: MatchSettings = Field(
        MatchSettings(), description="how two maps are compared, and what makes a loop closure"
    )
    skip_recent: int = Field(
        1, ge=0, le=10**6, description="number of submaps just before the query that are not compared with it"
    )
    seed: int = Field(0, ge=0, lt=2**63, description="seed of the random number generator")
    calibration: Calibration = Field(
        Calibration(), description="measured constants, see docs/calibration.md; not meant to be changed"
    )

    @model_validator(mode="before")
    @classmethod
    def _one_knob(cls, data: Any) -> Any:
        """Accept `max_false_loops` at the top level, where users look for it first."""
        if not isinstance(data, dict) or "max_false_loops" not in data:
            return data
        rest = {name: value for name, value in data.items() if name != "max_false_loops"}
        match = rest.get("match", {})
        match = match.model_dump(exclude_unset=True) if isinstance(match, MatchSettings) else match
        if not isinstance(match, dict):  # refused as such
            return rest
        return rest | {"match": {**match, "max_false_loops": data["max_false_loops"]}}

    @classmethod
    def or_default(cls, settings: "Settings | None") -> "Settings":
        """The settings, or the defaults where there are none.

        Raises
        ------
        TerrainLoopError
            If it is something else, such as the name of a preset.
        """
        if settings is None:
            return cls()
        if not isinstance(settings, cls):
            raise TerrainLoopError(
                expected="settings",
                found=f"{settings!r:.300}",
                mend="pass Settings(), Settings.preset('paper') or Settings.from_yaml(path)",
            )
        return settings

    def with_max_false_loops(self, allowed: float | None) -> "Settings":
        """The same settings with another `max_false_loops`, or as they are if None.

        Raises
        ------
        TerrainLoopError
            If it is not a positive number.
        """
        if allowed is None:
            return self
        try:
            match = MatchSettings(**self.match.model_dump() | {"max_false_loops": allowed})
        except TerrainLoopError as error:
            raise TerrainLoopError(
                expected="a positive max_false_loops, the expected number of false loops per mission",
                found=f"{allowed}",
                mend="give a number such as 0.01",
            ) from error
        return self.model_copy(update={"match": match})

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
        """Read settings; those missing from the file keep their defaults.

        Raises
        ------
        TerrainLoopError
            If the file cannot be read, is not a YAML mapping, or has an unknown or impossible value.
        """
        content = read_yaml(path)
        try:
            return cls.model_validate({} if content is None else content, strict=True)
        except TerrainLoopError as error:
            raise TerrainLoopError(
                expected=f"valid settings in {path}",
                found=error.found,
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
            plain = list(value) if isinstance(value, tuple) else value
            scalar = yaml.safe_dump(plain, default_flow_style=True).removesuffix("...\n").strip()
            lines.append(f"{indent}{name}: {scalar}  # {field.description}")
    return lines
