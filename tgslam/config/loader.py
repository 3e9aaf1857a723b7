"""Reads settings: defaults in code, then a YAML file (and the `base:` that it names), then `section.key=value`.

The loader knows no setting by name: it walks the dataclasses of `schema`, so a new section needs no change here.
Anything it does not understand is an error that names the key, where it stands, and what is allowed there.
"""

from __future__ import annotations

import dataclasses
import difflib
import importlib.resources
import math
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from tgslam.config.schema import Config
from tgslam.config.setting import allowed, settings_of
from tgslam.config.yaml_text import YamlTextError, parse_yaml, to_yaml
from tgslam.errors import ConfigError

_BASE_KEY = "base"


def load(path_or_name: str | Path | None = None, overrides: Sequence[str] = ()) -> Config:
    """The settings of a run: defaults, overridden by a YAML file, overridden by `overrides`.

    path_or_name: a file, or the name of a packaged config ("tum", "tum.yaml", "configs/tum.yaml"); None = defaults.
    overrides: "section.key=value" each, the value written as in YAML; later ones win.
    Raises ConfigError for a file that cannot be read and for an unknown key, a wrong type or a value out of range.
    """
    config = Config()
    if path_or_name is not None:
        for path, mapping in _chain_of_files(find_config(path_or_name)):
            config = _apply(config, mapping, where=str(path), prefix="")
    return override(config, overrides)


def override(config: Config, overrides: Sequence[str]) -> Config:
    """`config` with "section.key=value" of `overrides`; see `load`. Raises ConfigError."""
    for text in overrides:
        config = _apply(config, _mapping_of_override(text), where=f"--set {text}", prefix="")
    return config


def dump(config: Config) -> str:
    """The YAML text of every setting; `load` of it gives the same Config."""
    return to_yaml(_to_mapping(config))


def find_config(path_or_name: str | Path) -> Path:
    """The file that `path_or_name` means: itself if it exists, else the packaged config of that name.

    Raises ConfigError that lists the packaged names when there is neither.
    """
    path = Path(path_or_name)
    if path.is_file():
        return path
    folder = _packaged_folder()
    parts = path.parts[1:] if path.parts[:1] == ("configs",) else path.parts
    if parts and not path.is_absolute() and ".." not in parts:
        packaged = folder.joinpath(*parts)
        for candidate in (packaged, packaged.with_name(packaged.name + ".yaml")):
            if candidate.is_file() and candidate.suffix == ".yaml":
                return candidate
    names = ", ".join(packaged_names())
    raise ConfigError(f"{path}: no such config file, and no packaged config of that name; packaged are: {names}")


def packaged_names() -> list[str]:
    """The names of the configs that come with the package, without `.yaml`."""
    folder = _packaged_folder()
    return sorted(file.relative_to(folder).with_suffix("").as_posix() for file in folder.rglob("*.yaml"))


def _packaged_folder() -> Path:
    return Path(str(importlib.resources.files("tgslam.configs")))


def _chain_of_files(path: Path) -> Iterator[tuple[Path, Mapping[str, Any]]]:
    """(file, its mapping without `base`) from the outermost base to `path` itself."""
    chain: list[tuple[Path, Mapping[str, Any]]] = []
    seen: list[Path] = []
    current: Path | None = path
    while current is not None:
        if current.resolve() in seen:
            cycle = " -> ".join(file.name for file in [*seen, current])
            raise ConfigError(f"{path}: its `{_BASE_KEY}:` files name each other in a circle: {cycle}")
        seen.append(current.resolve())
        mapping = dict(_read_mapping(current))
        base = mapping.pop(_BASE_KEY, None)
        chain.append((current, mapping))
        current = None if base is None else _base_file(current, base)
    yield from reversed(chain)


def _base_file(path: Path, base: object) -> Path:
    if not isinstance(base, str):
        raise ConfigError(f"{path}: `{_BASE_KEY}` must be a file name, not {base!r}")
    beside = path.parent / base
    try:
        return beside if beside.is_file() else find_config(Path(base))
    except ConfigError as error:
        raise ConfigError(f"{path}: `{_BASE_KEY}: {base}`: {error}") from None


def _read_mapping(path: Path) -> Mapping[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise ConfigError(f"{path}: cannot be read: {reason}") from error
    try:
        mapping = parse_yaml(text)
    except YamlTextError as error:
        line = "" if error.line is None else f":{error.line}"
        raise ConfigError(f"{path}{line}: {error}") from error
    if mapping is None:
        return {}
    if not isinstance(mapping, dict):
        raise ConfigError(f"{path}: must hold `section: {{key: value}}`, not a {type(mapping).__name__}")
    return mapping


def _mapping_of_override(text: str) -> dict[str, Any]:
    key, equals, value_text = text.partition("=")
    names = key.strip().split(".")
    if not equals or not all(names):
        raise ConfigError(f"--set {text}: write it as section.key=value, for example --set dataset.max_depth_m=5")
    value: Any = _Text(value_text.strip())
    for name in reversed(names):
        value = {name: value}
    return typing.cast(dict[str, Any], value)


class _Text(str):
    """A value from the command line: YAML unless the setting is a string, which takes it as it stands."""


def _apply(section: Any, mapping: Mapping[Any, Any], where: str, prefix: str) -> Any:
    """`section` (a dataclass) with the values of `mapping`; every error names `where` and the dotted key."""
    fields = {field.name: field for field in dataclasses.fields(section)}
    hints = typing.get_type_hints(type(section))
    changes: dict[str, Any] = {}
    for name, value in mapping.items():
        key = f"{prefix}{name}"
        if name not in fields:
            raise ConfigError(f"{where}: unknown key `{key}`{_advice(section, str(name), prefix)}")
        if dataclasses.is_dataclass(hints[name]):
            if value is None:
                continue
            if not isinstance(value, Mapping):
                raise ConfigError(f"{where}: `{key}` is a section: give it `key: value` lines, not {value!r}")
            changes[name] = _apply(getattr(section, name), value, where, prefix=f"{key}.")
        else:
            changes[name] = _checked(hints[name], fields[name], value, where, key)
    return dataclasses.replace(section, **changes)


def _advice(section: Any, name: str, prefix: str) -> str:
    """The nearest valid key with what it allows: one of that very name, else in this section, else anywhere."""
    settings = dict(settings_of(Config()))
    known = [*settings, *dict.fromkeys(parent for key in settings for parent in _sections_of(key))]
    here = [field.name for field in dataclasses.fields(section)]
    near = [key for key in known if key.rpartition(".")[2] == name]
    near.sort(key=lambda key: not key.startswith(prefix))
    near = near or [prefix + match for match in difflib.get_close_matches(name, here, n=1)]
    if not near:
        leaves = {key.rpartition(".")[2]: key for key in settings}
        near = [leaves[match] for match in difflib.get_close_matches(name, leaves, n=1)]
    if not near:
        return f"; valid here are: {', '.join(here)}"
    if near[0] in settings:
        return f"; did you mean `{near[0]}` ({allowed(*settings[near[0]])})?"
    return f"; did you mean the section `{near[0]}`?"


def _sections_of(key: str) -> list[str]:
    """The sections that a setting is in: tracking, tracking.expert, tracking.expert.lost."""
    names = key.split(".")[:-1]
    return [".".join(names[: count + 1]) for count in range(len(names))]


def _checked(hint: Any, field: dataclasses.Field[Any], value: Any, where: str, key: str) -> Any:
    """`value` as `hint` says, within the field's range or choices."""
    shown = value
    if isinstance(value, _Text):
        value = _value_of_text(hint, value, where)
    wanted = allowed(hint, field)
    try:
        result = _converted(hint, value)
    except (TypeError, OverflowError):
        raise ConfigError(f"{where}: `{key}` = {_short(shown)} must be {wanted}") from None
    low, high, choices = (field.metadata.get(name) for name in ("low", "high", "choices"))
    if isinstance(result, tuple) and len(result) < field.metadata.get("min_items", 0):
        raise ConfigError(f"{where}: `{key}` = {_short(shown)} is too short: it must be {wanted}")
    for item in result if isinstance(result, tuple) else (result,):
        if item is None:
            continue
        if choices and item not in choices:
            raise ConfigError(f"{where}: `{key}` = {_short(shown)} must be {wanted}")
        if (low is not None and item < low) or (high is not None and item > high):
            raise ConfigError(f"{where}: `{key}` = {_short(shown)} is out of range: it must be {wanted}")
    return result


def _value_of_text(hint: Any, text: _Text, where: str) -> Any:
    if hint is str:
        return str(text)
    if typing.get_origin(hint) is tuple and not text.startswith("["):
        text = _Text(f"[{text}]")
    try:
        return parse_yaml(text)
    except YamlTextError as error:
        raise ConfigError(f"{where}: the value is not valid YAML: {error}") from error


def _converted(hint: Any, value: Any) -> Any:
    """`value` as type `hint`; raises TypeError when it is another type. No rounding, no truth of numbers, no NaN."""
    if isinstance(hint, types.UnionType):
        for option in typing.get_args(hint):
            try:
                return _converted(option, value)
            except TypeError:
                continue
        raise TypeError
    if typing.get_origin(hint) is tuple:
        elements = typing.get_args(hint)
        if not isinstance(value, (list, tuple)):
            raise TypeError
        if elements[-1] is not Ellipsis and len(value) != len(elements):
            raise TypeError
        return tuple(_converted(elements[0], item) for item in value)
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        number = float(value)
        if not math.isfinite(number):
            raise TypeError
        return number
    if type(value) is hint:
        return value
    raise TypeError


def _short(value: Any) -> str:
    text = (
        value
        if isinstance(value, _Text)
        else yaml.safe_dump(value, default_flow_style=True).removesuffix("...\n").strip()
    )
    return text if len(text) <= 60 else text[:57] + "..."


def _to_mapping(section: Any) -> dict[str, Any]:
    def plain(value: Any) -> Any:
        if dataclasses.is_dataclass(value):
            return _to_mapping(value)
        return [plain(item) for item in value] if isinstance(value, tuple) else value

    return {field.name: plain(getattr(section, field.name)) for field in dataclasses.fields(section)}
