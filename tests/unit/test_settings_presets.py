"""Schedules and families: all load, and what they promise about the paper and its program."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from vtslam.common.config import ConfigError, load, to_dict
from vtslam.common.preset_loading import FAMILIES, SCHEDULES, load_settings
from vtslam.common.settings import Settings
from vtslam.common.splat.engine import RasterSettings
from vtslam.common.splat.native_engine import NativeEngine


def leaves(table: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """A nested table as dotted keys."""
    out: dict[str, Any] = {}
    for key, value in table.items():
        out |= leaves(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return out


@pytest.mark.parametrize("schedule", SCHEDULES)
@pytest.mark.parametrize("family", FAMILIES)
def test_every_schedule_and_family_load_together(schedule: str, family: str) -> None:
    settings = load_settings(preset=schedule, family=family)
    assert load(Settings, [("itself", to_dict(settings))]) == settings
    splat = settings.splat
    NativeEngine(RasterSettings(low_pass_px2=splat.low_pass_px2, near_m=splat.near_m, alpha_cap=splat.alpha_cap))


def test_the_default_is_fast_and_differs_from_the_paper() -> None:
    assert load_settings() == load_settings(preset="fast", family="tum")
    assert load_settings().tracker.optimizer == "gauss_newton"


def test_paper_is_the_tree_of_defaults_for_tum() -> None:
    assert load_settings(preset="paper", family="tum") == Settings()


def test_paper_follows_the_equations() -> None:
    for family in FAMILIES:
        settings = load_settings(preset="paper", family=family)
        assert settings.tracker.optimizer == "adam"
        assert settings.tracker.visibility_tolerance == (0.05 if family == "kitti" else 0.01)
        assert not settings.mapper.edge_supplement
        assert settings.mapper.depth_factor == 1.0
        assert settings.mapper.neighbour_weight == 1.0
        assert settings.mapper.bundle_rotation_rate == settings.mapper.bundle_translation_rate == 1e-4
        assert settings.mapper.initial_opacity == 0.5


def test_released_has_the_figures_of_the_program() -> None:
    for family in FAMILIES:
        settings = load_settings(preset="released", family=family)
        assert settings.splat.alpha_cap == 0.99
        assert settings.splat.low_pass_px2 == 0.001
        assert settings.mapper.edge_supplement
        assert settings.mapper.depth_factor == 1.005
        assert settings.mapper.bundle_rotation_rate == 1e-8
        assert settings.mapper.bundle_translation_rate == 1e-7
        assert settings.tracker.overlap.skip_previous


def test_families_have_the_figures_of_the_paper() -> None:
    lengths = {family: load_settings(preset="paper", family=family).section.length for family in FAMILIES}
    assert lengths["replica"] == 40
    assert lengths["tum"] == lengths["scannet"] == 30
    assert lengths["scannetpp"] == 100
    replica = load_settings(preset="paper", family="replica").tracker.adam
    assert (replica.iterations, replica.first_section_iterations) == (60, 80)
    assert (replica.color_weight, replica.depth_weight) == (0.5, 0.025)
    assert replica.silhouette_adaptive
    assert load_settings(preset="paper", family="scannet").tracker.far_factor == 3.5


def test_realtime_does_the_least_work() -> None:
    realtime, fast = load_settings(preset="realtime").mapper, load_settings(preset="fast").mapper
    for name in ("iterations_head", "iterations_regular", "iterations_seal"):
        assert getattr(realtime, name) <= getattr(fast, name)
    assert realtime.iterations_regular < fast.iterations_regular


def test_layers_win_in_order(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text("seed = 7\n[section]\nlength = 12\n[mapper]\niterations_head = 3\n")
    settings = load_settings(
        preset="paper", family="replica", file=file, assignments=["section.length=13", "tracker.far_factor=2"]
    )
    assert (settings.seed, settings.section.length) == (7, 13)
    assert settings.mapper.iterations_head == 3
    assert settings.mapper.iterations_regular == 100  # the family's
    assert settings.tracker.far_factor == 2.0


def test_an_assignment_changes_its_key_alone() -> None:
    before = leaves(to_dict(load_settings()))
    after = leaves(to_dict(load_settings(assignments=["mapper.iterations_regular=77"])))
    assert {key for key in before if before[key] != after[key]} == {"mapper.iterations_regular"}


@pytest.mark.parametrize(
    ("preset", "family", "message"),
    [
        ("fats", "tum", "unknown schedule 'fats'; one of fast, paper, released, realtime"),
        ("fast", "tmu", "unknown family 'tmu'; one of tum, replica, scannet, scannetpp, kitti"),
    ],
)
def test_unknown_presets_are_refused(preset: str, family: str, message: str) -> None:
    with pytest.raises(ConfigError) as refused:
        load_settings(preset=preset, family=family)
    assert str(refused.value) == message


@pytest.mark.parametrize(
    ("assignment", "parts"),
    [
        ("mapper.iterations_haed=3", ["--set mapper.iterations_haed=3", "iterations_head"]),
        ("tracker.optimizer=newton", ["--set tracker.optimizer=newton", "adam", "gauss_newton"]),
        ("section.length=1", ["--set section.length=1", "section.length", "2"]),
        ("splat.alpha_cap=1.5", ["--set splat.alpha_cap=1.5", "splat.alpha_cap", "0.9999"]),
        ("holdout=-1", ["--set holdout=-1", "holdout"]),
        ("mapper.edge_supplement=1", ["--set mapper.edge_supplement=1", "mapper.edge_supplement"]),
        ("mapper=3", ["--set mapper=3", "a table"]),
    ],
)
def test_bad_assignments_are_refused_with_their_origin(assignment: str, parts: list[str]) -> None:
    with pytest.raises(ConfigError) as refused:
        load_settings(assignments=[assignment])
    assert all(part in str(refused.value) for part in parts), str(refused.value)


def test_a_bad_file_is_refused_by_name_even_where_an_assignment_wins(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text("[section]\nlength = 0\n")
    with pytest.raises(ConfigError) as refused:
        load_settings(file=file, assignments=["section.length=5"])
    assert str(file) in str(refused.value)
    assert "section.length" in str(refused.value)
    file.write_text("[sections]\nlength = 5\n")
    with pytest.raises(ConfigError) as refused:
        load_settings(file=file)
    assert str(file) in str(refused.value)
    assert "sections" in str(refused.value)


def test_every_number_is_bounded_where_it_must_be() -> None:
    for key, value in leaves(to_dict(Settings())).items():
        if isinstance(value, bool | str):
            continue
        if key not in ("source.seed",):
            with pytest.raises(ConfigError, match=key.replace(".", r"\.")):
                load_settings(assignments=[f"{key}=-5"])


def test_settings_cannot_change_after_loading() -> None:
    settings = load_settings()
    with pytest.raises(dataclasses.FrozenInstanceError):
        settings.tracker.adam.iterations = 3  # type: ignore[misc]
