"""The config loader: what it takes, what it refuses, and that a written config reads back the same."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tgslam.config.loader import dump, find_config, load, packaged_names
from tgslam.config.schema import Config
from tgslam.config.tracking_settings import LostSettings
from tgslam.errors import ConfigError


def written(folder: Path, text: str, name: str = "my.yaml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def message(path: Path | None, *overrides: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load(path, overrides)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_defaults() -> None:
    assert load() == Config()


@pytest.mark.parametrize("name", packaged_names())
def test_packaged_configs_load(name: str) -> None:
    assert load(Path(name)) == load(Path(f"configs/{name}.yaml"))


def test_a_packaged_config_is_found_by_name_from_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("tum", "tum.yaml", "configs/tum.yaml"):
        assert load(Path(name)).dataset.format == "tum"
    assert load(Path("tum_fr3")).dataset.format == "tum"
    with pytest.raises(ConfigError, match=r"packaged are: .*tum_fr3"):
        find_config(Path("elsewhere/tum.yaml"))


def test_file_then_overrides(tmp_path: Path) -> None:
    path = written(tmp_path, "seed: 3\ndataset:\n  max_depth_m: 4\n  distortion: [0.1, -2e-1]\nloss:\n")
    config = load(path, ["seed=4", "loss.weight_l1=1e-3", "synthetic.noise=false", "synthetic.scene=1"])
    assert (config.seed, config.dataset.max_depth_m, config.dataset.distortion) == (4, 4.0, (0.1, -0.2))
    assert type(config.dataset.max_depth_m) is float
    assert (config.loss.weight_l1, config.synthetic.noise, config.synthetic.scene) == (1e-3, False, "1")
    assert load(None, ["dataset.distortion=0.1, 0.2"]).dataset.distortion == (0.1, 0.2)
    assert load(None, ["dataset.distortion="]).dataset.distortion == ()


def test_settings_of_the_expert_tier(tmp_path: Path) -> None:
    path = written(tmp_path, "tracking:\n  references: 3\n  expert:\n    lost: {max_condition: 1e6}\n    motion:\n")
    config = load(path, ["tracking.expert.lost.min_map_overlap=0.2", "tracking.expert.first_order.adam_steps=3, 4"])
    assert (config.tracking.references, config.tracking.expert.lost.max_condition) == (3, 1e6)
    assert config.tracking.expert.lost == dataclasses.replace(LostSettings(), max_condition=1e6, min_map_overlap=0.2)
    assert config.tracking.expert.first_order.adam_steps == (3, 4)
    assert config.tracking.expert.motion == Config().tracking.expert.motion


def test_errors_in_the_expert_tier_name_the_whole_key() -> None:
    near = "did you mean `tracking.expert.lost.max_condition` (a number from 1.0 to 1000000000000000.0)?"
    assert near in message(None, "tracking.expert.lost.max_conditions=1e6")
    assert near in message(None, "tracking.max_condition=1e6")
    assert near in message(None, "max_condition=1e6")
    assert near in message(None, "tracking.expert.max_condition=1e6")
    assert "did you mean the section `tracking.expert.lost`?" in message(None, "tracking.expert.losst.max_condition=1")
    assert "did you mean the section `tracking.expert`?" in message(None, "tracking.experts.lost.max_condition=1")
    assert "`tracking.expert.lost.max_condition` = 0 is out of range" in message(
        None, "tracking.expert.lost.max_condition=0"
    )
    assert "`tracking.expert.lost` is a section" in message(None, "tracking.expert.lost=1")
    assert "valid here are: residuals, model, motion, first_order, lost" in message(None, "tracking.expert.zzzz=1")


def test_scientific_notation_without_a_point_is_a_number(tmp_path: Path) -> None:
    assert load(written(tmp_path, "loss: {depth_sigma_per_m2: 1e-6}")).loss.depth_sigma_per_m2 == 1e-6


def test_base_is_relative_then_packaged_then_overridden(tmp_path: Path) -> None:
    written(tmp_path, "base: tum_fr1\nseed: 1\ndataset: {fx: 1.0}\n", "parent.yaml")
    config = load(written(tmp_path, "base: parent.yaml\ndataset: {fy: 2.0}\n"))
    assert (config.seed, config.dataset.fx, config.dataset.fy, config.dataset.cx) == (1, 1.0, 2.0, 318.6)
    assert config.dataset.format == "tum"


def test_base_errors(tmp_path: Path) -> None:
    written(tmp_path, "base: my.yaml\n", "other.yaml")
    assert "circle: my.yaml -> other.yaml -> my.yaml" in message(written(tmp_path, "base: other.yaml\n"))
    assert "circle" in message(written(tmp_path, "base: my.yaml\n"))
    assert "my.yaml: `base: gone.yaml`" in message(written(tmp_path, "base: gone.yaml\n"))
    assert "must be a file name" in message(written(tmp_path, "base: 7\n"))


def test_an_unknown_key_names_file_key_neighbour_and_range(tmp_path: Path) -> None:
    path = written(tmp_path, "loss:\n  weight_l2: 1.0\n")
    text = message(path)
    assert str(path) in text
    assert "`loss.weight_l2`" in text
    assert "did you mean `loss.weight_l1` (a number from 0.0 to 100.0)?" in text
    assert "did you mean `evaluation.holdout_interval` (a whole number from 2 to 1000)" in message(
        None, "holdout_interval=3"
    )
    assert "did you mean the section `dataset`" in message(None, "datasets.format=tum")
    assert "valid here are: seed" in message(None, "zzzz=1")
    assert "base" in message(None, "base=tum")


def test_expert_settings_lie_below_their_section(tmp_path: Path) -> None:
    config = load(None, ["planes.expert.association.gate_sigmas=3", "structure.expert.shape.thinness=0.2"])
    assert (config.planes.expert.association.gate_sigmas, config.structure.expert.shape.thinness) == (3.0, 0.2)
    assert config.planes.expert.gaps == Config().planes.expert.gaps
    path = written(tmp_path, "planes:\n  expert:\n    association: {gate_sigmas: 2.0}\n    gaps: {bridge_m: 1}\n")
    expert = load(path, ["planes.expert.gaps.bridge_m=2"]).planes.expert
    assert (expert.association.gate_sigmas, expert.gaps.bridge_m) == (2.0, 2.0)


def test_errors_of_expert_settings_lead_to_them() -> None:
    gate = "`planes.expert.association.gate_sigmas`"
    assert f"did you mean {gate} (a number from 0.5 to 100.0)?" in message(None, "planes.gate_sigmas=3")
    assert f"did you mean {gate}" in message(None, "planes.expert.gate_sigmas=3")
    assert f"did you mean {gate}" in message(None, "planes.expert.association.gate_sigma=3")
    assert "did you mean the section `planes.expert.association`" in message(None, "planes.expert.asociation.x=3")
    assert f"{gate} = 0 is out of range" in message(None, "planes.expert.association.gate_sigmas=0")
    assert "`planes.expert` is a section" in message(None, "planes.expert=3")


def declarations(section: Any) -> Iterator[tuple[str, type, str]]:
    """(name, the dataclass that declares it, what it says of itself) of all settings and groups below a section."""
    for field in dataclasses.fields(section):
        value = getattr(section, field.name)
        group = dataclasses.is_dataclass(value)
        yield field.name, type(value) if group else type(section), "" if group else field.metadata["doc"]
        if group:
            yield from declarations(value)


def test_no_name_has_two_meanings() -> None:
    """A small dataclass that two sections share is one meaning; a section may be switched on, and have experts.

    Images have a width whether they are drawn or read.
    """
    meanings: dict[str, set[tuple[type, str]]] = defaultdict(set)
    for name, owner, doc in declarations(Config()):
        meanings[name].add((owner, doc))
    assert {name for name, found in meanings.items() if len(found) > 1} == {"enabled", "expert", "width"}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("seed: 5.0", "`seed` = 5.0 must be a whole number from 0 to"),
        ("seed: true", "must be a whole number"),
        ("seed: -1", "`seed` = -1 is out of range: it must be a whole number from 0"),
        ("seed: null", "must be a whole number"),
        ("seed: '5'", "must be a whole number"),
        ("seed: [1]", "must be a whole number"),
        ("dataset: {fx: .nan}", "`dataset.fx` = '.nan' must be a number"),
        ("dataset: {fx: .inf}", "must be a number"),
        ("dataset: {fx: 1e999}", "must be a number"),
        ("dataset: {fx: true}", "must be a number"),
        ("dataset: {fx: '5'}", "must be a number"),
        ("dataset: {format: kitti}", "`dataset.format` = kitti must be one of auto, synthetic, tum, icl"),
        ("dataset: {format: 1}", "must be one of"),
        ("dataset: {distortion: 1.0}", "must be a list (each a number)"),
        ("dataset: {distortion: [1.0, a]}", "must be a list"),
        ("dataset: 5", "`dataset` is a section"),
        ("synthetic: {noise: 1}", "must be true or false"),
        ("synthetic: {noise: yes}", "must be true or false"),
        ("synthetic: {scene: 5}", "must be text"),
        ("seed: 1\nseed: 2", "my.yaml:2: invalid YAML: the key `seed` stands here a second time"),
        ("dataset:\n  fx: 1.0\n  fx: 2.0", "my.yaml:3: invalid YAML"),
        ("seed: [1", "invalid YAML"),
        ("? [a]\n: 1", "a key must be a name"),
        ("- 1\n- 2", "not a list"),
        ("5", "not a int"),
        ("seed: 1\n\x07", "invalid YAML"),
        ("loss: !!python/object:os.system {}", "my.yaml:1: invalid YAML"),
        ("1: 2", "unknown key `1`"),
    ],
)
def test_wrong_values_are_errors_that_say_why(tmp_path: Path, text: str, expected: str) -> None:
    got = message(written(tmp_path, text))
    assert expected in got
    assert "my.yaml" in got


def test_invalid_yaml_names_the_line(tmp_path: Path) -> None:
    assert "my.yaml:3: invalid YAML" in message(written(tmp_path, "seed: 1\ndataset:\n  fx: : 2\n"))


def test_unreadable_files(tmp_path: Path) -> None:
    path = tmp_path / "bytes.yaml"
    path.write_bytes(b"seed: \xff\xfe")
    assert "not UTF-8" in message(path)
    assert "no such config file" in message(tmp_path / "gone.yaml")
    assert "no such config file" in message(tmp_path)


@pytest.mark.parametrize("text", ["seed", "=3", ".=3", "dataset.=3", ""])
def test_an_override_without_key_or_value(text: str) -> None:
    assert "section.key=value" in message(None, text)


@pytest.mark.parametrize("text", ["seed=", "seed=[", "seed=1: 2", "dataset=1", "dataset.distortion=[1"])
def test_an_override_with_a_wrong_value(text: str) -> None:
    assert f"--set {text}" in message(None, text)


def _field_values(hint: Any, field: dataclasses.Field[Any]) -> st.SearchStrategy[Any]:
    low, high, choices = (field.metadata[name] for name in ("low", "high", "choices"))
    if choices:
        return st.sampled_from(choices)
    if hint is bool:
        return st.booleans()
    if hint is int:
        return st.integers(low, high)
    if hint is float:
        return st.floats(low, high, allow_nan=False, allow_infinity=False, allow_subnormal=False)
    if hint is str:
        return st.text(
            st.characters(codec="utf-8", exclude_characters="\r\x85\u2028\u2029", exclude_categories=("Cs", "Cc"))
        )
    if isinstance(hint, types.UnionType):
        (given_hint,) = (option for option in typing.get_args(hint) if option is not type(None))
        return st.none() | _field_values(given_hint, field)
    assert typing.get_origin(hint) is tuple
    elements = typing.get_args(hint)
    size = None if elements[-1] is Ellipsis else len(elements)
    element = (
        st.floats(low, high, allow_nan=False, allow_infinity=False, allow_subnormal=False)
        if elements[0] is float
        else st.integers(low, high)
    )
    return st.lists(element, min_size=size or field.metadata["min_items"], max_size=size or 6).map(tuple)


def configs_of(cls: type) -> st.SearchStrategy[Any]:
    hints = typing.get_type_hints(cls)
    values = {
        field.name: configs_of(hints[field.name])
        if dataclasses.is_dataclass(hints[field.name])
        else _field_values(hints[field.name], field)
        for field in dataclasses.fields(cls)
    }
    return st.builds(cls, **values)


@settings(max_examples=60)
@given(config=configs_of(Config))
def test_a_dumped_config_loads_back_equal(config: Config, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("round") / "config.yaml"
    path.write_text(dump(config), encoding="utf-8")
    assert load(path) == config


@given(text=st.sampled_from(["true", "1e5", "null", "~", "", "1", "- a", "a: b", "# x", "no", "1.5", "'", '"', "é"]))
def test_text_that_looks_like_something_else_survives(text: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    config = load(None, [f"synthetic.scene={text}"])
    path = tmp_path_factory.mktemp("text") / "config.yaml"
    path.write_text(dump(config), encoding="utf-8")
    assert load(path).synthetic.scene == text
