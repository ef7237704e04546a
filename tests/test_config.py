"""Settings: to YAML and back, errors that name file and key, and the paper's published numbers."""

import os
import subprocess
import sys
from typing import get_args

import numpy as np
import pytest
import yaml
from pydantic import BaseModel, ValidationError

from terrainloop.config import MapSettings, MatchSettings, Settings
from terrainloop.errors import TerrainLoopError

PRESETS = ("default", "paper")


def leaves(model, prefix=""):
    """Dotted names and fields of all public numbers."""
    for name, field in type(model).model_fields.items():
        value = getattr(model, name)
        if isinstance(value, BaseModel):
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield prefix + name, field


def refusal(path):
    with pytest.raises(TerrainLoopError) as caught:
        Settings.from_yaml(path)
    message = str(caught.value)
    assert "\n" not in message
    assert str(path) in message
    assert "terrainloop config" in message  # how to mend it
    return message


@pytest.fixture
def file(tmp_path):
    return tmp_path / "settings.yaml"


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_survive_yaml(preset, file):
    settings = Settings.preset(preset)
    file.write_text(settings.to_yaml(), encoding="utf-8")
    assert Settings.from_yaml(file) == settings


def test_changed_settings_survive_yaml(file):
    settings = Settings(
        map=MapSettings(length_scale=1e-5 + 0.25, noise=1e-7, fit="submap"),
        match=MatchSettings(max_ssd_ratio=1 / 3, inlier_radius=1234.5678),
        skip_recent=0,
        seed=2**40,
    )
    file.write_text(settings.to_yaml(), encoding="utf-8")
    assert Settings.from_yaml(file) == settings


@pytest.mark.parametrize("preset", PRESETS)
def test_yaml_is_what_plain_yaml_reads(preset):
    settings = Settings.preset(preset)
    assert yaml.safe_load(settings.to_yaml()) == settings.model_dump(mode="json")


def test_yaml_says_what_each_number_means():
    text = Settings().to_yaml()
    for name, field in leaves(Settings()):
        assert field.description
        line = next(line for line in text.splitlines() if line.strip().startswith(name.split(".")[-1] + ":"))
        assert "# " in line


def test_what_a_file_leaves_out_keeps_its_default(file):
    file.write_text("match: {min_inliers: 17}\n")
    settings = Settings.from_yaml(file)
    assert settings.match.min_inliers == 17
    assert settings == Settings(match=MatchSettings(min_inliers=17))


@pytest.mark.parametrize("content", ["", "# nothing\n", "{}\n"])
def test_an_empty_file_is_the_default(file, content):
    file.write_text(content)
    assert Settings.from_yaml(file) == Settings()


@pytest.mark.parametrize(
    ("content", "key"),
    [
        ("speed: 3", "speed"),
        ("map: {max_pionts: 400}", "map.max_pionts"),
        ("map: {max_points: many}", "map.max_points"),
        ("map: {max_points: [1]}", "map.max_points"),
        ("map: 5", "map"),
        ("map: {max_points: 1}", "map.max_points"),
        ("map: {length_scale: 0}", "map.length_scale"),
        ("map: {length_scale: -0.3}", "map.length_scale"),
        ("map: {length_scale: .nan}", "map.length_scale"),
        ("map: {noise: [0.1]}", "map.noise"),
        ("map: {fit: never}", "map.fit"),
        ("map: {max_variance_ratio: 1.5}", "map.max_variance_ratio"),
        ("features: {kind: shot}", "features.kind"),
        ("match: {min_inliers: 1}", "match.min_inliers"),
        ("match: {iterations: 2.5}", "match.iterations"),
        ("skip_recent: -1", "skip_recent"),
        ("seed: null", "seed"),
        ("seed: -3", "seed"),
        ("5: 6", "5"),
    ],
)
def test_what_is_wrong_is_named(file, content, key):
    file.write_text(content + "\n")
    assert f"found {key}:" in refusal(file)


def test_infinity_is_refused(file):
    file.write_text("map: {length_scale: .inf}\n")
    assert "map.length_scale" in refusal(file)


@pytest.mark.parametrize("content", ["- 1\n- 2\n", "just words\n", "3.5\n"])
def test_no_mapping_is_refused(file, content):
    file.write_text(content)
    refusal(file)


@pytest.mark.parametrize("content", [b"map: {a: ", b"a: b: c\n", b"\xff\xfe\x00\x81" * 20, b"\x00\x01\x02"])
def test_no_yaml_is_refused(file, content):
    file.write_bytes(content)
    refusal(file)


@pytest.mark.parametrize(
    ("content", "key"),
    [
        ("seed: 2021-13-41", "seed"),
        ("seed: 2020-01-01", "seed"),
        ("map: {noise: '0.1'}", "map.noise"),
        ("features: {max_keypoints: true}", "features.max_keypoints"),
        ("map: {length_scale: false}", "map.length_scale"),
        ("map: {remove_plane: yes}", "map.remove_plane"),
        ("map: {remove_plane: 1}", "map.remove_plane"),
        ("seed: 1.0", "seed"),
        ("match: {iterations: 1:30}", "match.iterations"),
        ("map: {noise: 1e300}", "map.noise"),
        ("map: {resolution: 1e-300}", "map.resolution"),
        ("match: {inlier_radius: 1e400}", "match.inlier_radius"),
        ("seed: 18446744073709551616", "seed"),
        (f"map: {{length_scale: {'9' * 4000}}}", "map.length_scale"),
        ("features: {max_keypoints: 99999999999}", "features.max_keypoints"),
        ("map: !!binary aGVsbG8=", "map"),
        ("match: !!set {a, b}", "match"),
        ("'speed limit': 1", "speed limit"),
        (f"{'x' * 1000}: 1", "xxx"),
        ('"a\\nb\\e[31m": 1', "ab[31m:"),
    ],
)
def test_values_of_another_type_or_size_are_refused_by_key(file, content, key):
    file.write_text(content + "\n")
    message = refusal(file)
    assert f"found {key}" in message
    assert len(message) < 500


REFUSED_YAML = {
    "brackets": "[" * 5000,
    "braces": "{a: " * 3000,
    "dashes": "- " * 2000,
    "nested by indent": "".join(f"{' ' * i}a:\n" for i in range(200)),
    "digits": f"seed: {'7' * 6000}",
    "references": "a: &a [1, 2]\nb: [*a, *a]",
    "reference to itself": "a: &a [*a]",
    "merge": "map: {<<: &m {noise: 0.1}}",
    "twice": "seed: 1\nmap: {}\nseed: 2",
    "twice within": "match:\n  iterations: 5\n  iterations: 6",
    "twice, quoted": "seed: 1\n'seed': 2",
    "tab": "map:\n\tnoise: 0.1",
    "null byte": "seed: 1\0",
    "two documents": "seed: 1\n---\nseed: 2",
    "object": "seed: !!python/object/apply:os.getcwd []",
    "date": "seed: !!timestamp 2020-99-99",
    "large": "# nothing but a comment\n" * 100_000,
    "list as a key": "? [1, 2]\n: 3",
}


@pytest.mark.parametrize("case", REFUSED_YAML)
def test_yaml_that_settings_do_not_need_is_refused(file, case):
    file.write_text(REFUSED_YAML[case])
    assert len(refusal(file)) < 500


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir, lambda path: path.symlink_to("/dev/zero")])
def test_only_regular_files_are_opened(file, make):
    make(file)
    assert "not a regular file" in refusal(file)


def test_numbers_are_those_of_yaml_1_2(file):
    file.write_text("map: {noise: 1e-3, length_scale: 2, resolution: +.5E0}\nseed: 010\nskip_recent: 0\n")
    settings = Settings.from_yaml(file)
    assert (settings.map.noise, settings.map.length_scale, settings.map.resolution) == (0.001, 2.0, 0.5)
    assert (settings.seed, settings.skip_recent) == (10, 0)


def test_comments_do_not_come_from_docstrings():
    script = "from terrainloop.config import Settings; print(Settings().to_yaml(), end='')"
    stripped = subprocess.run(
        [sys.executable, "-OO", "-c", script], check=True, capture_output=True, text=True
    )
    assert stripped.stdout == Settings().to_yaml()
    assert "None" not in stripped.stdout


def test_no_file_is_refused(tmp_path):
    refusal(tmp_path / "absent.yaml")
    refusal(tmp_path)
    refusal(None)


def test_unknown_preset_is_refused():
    with pytest.raises(TerrainLoopError, match=r"expected .*paper.*; found 'papers'"):
        Settings.preset("papers")


def test_paper_preset_is_the_published_pipeline():
    paper = Settings.preset("paper")
    assert paper.map.max_points == 5000
    assert paper.map.resolution == 0.03
    # The paper's kernel is exp(-d^2 / (2 l_k)) with l_k = 0.1: our length scale is its square root.
    assert paper.map.length_scale == pytest.approx(np.sqrt(0.1), abs=5e-4)
    assert paper.map.remove_plane is False
    assert paper.map.fit == "submap"
    assert paper.features.kind == "surf"
    assert paper.match.min_inliers in (4, 5)


def test_default_derives_its_lengths_from_the_data():
    settings = Settings()
    assert settings.map.length_scale is None
    assert settings.map.resolution is None
    assert settings.match.inlier_radius is None


def test_few_numbers():
    """Those that a user may turn: the calibration is measured."""
    kinds = [field.annotation for name, field in leaves(Settings()) if not name.startswith("calibration")]
    numbers = [kind for kind in kinds if {int, float} & {kind, *get_args(kind)}]
    assert 10 <= len(numbers) <= 15
    assert len(kinds) <= 21  # with switches


@pytest.mark.parametrize(("path", "name"), [("map", "max_points"), ("match", "iterations"), ("", "seed")])
def test_settings_cannot_be_changed(path, name):
    settings = Settings()
    owner = getattr(settings, path) if path else settings
    with pytest.raises(ValidationError):
        setattr(owner, name, 77)
    assert settings == Settings()


def test_unknown_names_in_code_are_refused():
    with pytest.raises(TerrainLoopError, match="sead: extra inputs"):
        Settings(sead=1)


# --- the one knob


def test_the_knob_may_be_given_at_the_top(file):
    assert Settings(max_false_loops=0.5).match.max_false_loops == 0.5
    both = Settings(match=MatchSettings(decision="inliers"), max_false_loops=0.5).match
    assert (both.decision, both.max_false_loops) == ("inliers", 0.5)
    file.write_text("max_false_loops: 0.5\nmatch: {iterations: 7}\n")
    assert Settings.from_yaml(file).match == MatchSettings(iterations=7, max_false_loops=0.5)


def test_settings_with_another_knob():
    assert Settings().with_max_false_loops(None) == Settings()
    assert Settings.preset("paper").with_max_false_loops(1).match.max_false_loops == 1


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_a_knob_that_promises_nothing_is_refused(value, file):
    with pytest.raises(TerrainLoopError, match="max_false_loops"):
        Settings().with_max_false_loops(value)
    file.write_text(f"max_false_loops: {str(value).replace('nan', '.nan').replace('inf', '.inf')}\n")
    assert "max_false_loops" in refusal(file)


def test_the_calibration_is_written_beside_every_result(file):
    changed = Settings.model_validate({"calibration": {"tail": 0.9, "motion_by_warp": (1.0, 2.0, 3.0)}})
    file.write_text(changed.to_yaml())
    assert "tail: 0.9" in changed.to_yaml()
    assert Settings.from_yaml(file) == changed


@pytest.mark.parametrize(
    ("section", "given", "named"),
    [
        (Settings, {"max_false_loops": 0}, "match.max_false_loops"),
        (Settings, {"max_false_loops": [1]}, "match.max_false_loops"),
        (Settings, {"max_false_loops": 0.1, "match": 3}, "match: input"),
        (Settings, {"map": {"length_scale": -1}}, "map.length_scale"),
        (Settings, {"seed": 1.5}, "seed"),
        (MapSettings, {"resolution": 1e300}, "map.resolution"),
        (MatchSettings, {"decision": "surprise"}, "match.decision"),
    ],
)
def test_impossible_values_in_code_are_refused_by_name(section, given, named):
    with pytest.raises(TerrainLoopError, match=f"valid settings; found {named}"):
        section(**given)


def test_a_section_that_is_none_is_refused_beside_the_one_knob(tmp_path):
    path = tmp_path / "settings.yaml"
    path.write_text("match: 3\nmax_false_loops: 0.5\n")
    with pytest.raises(TerrainLoopError, match="match: input should be a valid dictionary"):
        Settings.from_yaml(path)


@pytest.mark.parametrize("allowed", [0, -1, float("nan"), float("inf"), 1e300, "many", [1]])
def test_an_impossible_number_of_false_loops_is_refused(allowed):
    with pytest.raises(TerrainLoopError, match="positive max_false_loops"):
        Settings().with_max_false_loops(allowed)
