"""YAML text to plain values and back, by YAML 1.2's core rules: `1e-6` is a number, `no` is text, a key stands once."""

from __future__ import annotations

import re
from collections.abc import Hashable
from typing import Any

import yaml


class YamlTextError(Exception):
    """Text that is not YAML, or that names a key twice; `line` counts from 1 where it is known."""

    def __init__(self, message: str, line: int | None) -> None:
        super().__init__(message)
        self.line = line


def parse_yaml(text: str) -> Any:
    """The value of one YAML document; None when it is empty. Raises YamlTextError."""
    try:
        return yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        raise YamlTextError(f"invalid YAML: {error.problem}", None if mark is None else mark.line + 1) from error
    except (yaml.YAMLError, ValueError) as error:
        raise YamlTextError(f"invalid YAML: {str(error).splitlines()[0]}", None) from error
    except RecursionError as error:
        raise YamlTextError("invalid YAML: nested too deeply", None) from error


def to_yaml(mapping: dict[str, Any]) -> str:
    """YAML text that `parse_yaml` reads back to equal values; keys keep their order."""
    return yaml.dump(mapping, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120)


class _Loader(yaml.SafeLoader):
    """SafeLoader with the scalars below and no key twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        keys: set[Any] = set()
        for key_node, _ in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                raise yaml.constructor.ConstructorError(None, None, "a key must be a name", key_node.start_mark)
            if key_node.value in keys:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key `{key_node.value}` stands here a second time", key_node.start_mark
                )
            keys.add(key_node.value)
        return super().construct_mapping(node, deep)


class _Dumper(yaml.SafeDumper):
    """SafeDumper that quotes what `_Loader` would not read as text."""


def _int_of_scalar(loader: _Loader, node: yaml.ScalarNode) -> int:
    return int(node.value)


def _float_of_scalar(loader: _Loader, node: yaml.ScalarNode) -> float:
    return float(node.value)


_NUMBER_STARTS = list("-+.0123456789")
_SCALARS = [
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+", _NUMBER_STARTS),
    ("float", r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?", _NUMBER_STARTS),
]
for _class in (_Loader, _Dumper):
    _class.yaml_implicit_resolvers = {}
    for _name, _pattern, _starts in _SCALARS:
        _class.add_implicit_resolver(f"tag:yaml.org,2002:{_name}", re.compile(rf"^(?:{_pattern})$"), _starts)
_Loader.add_constructor("tag:yaml.org,2002:int", _int_of_scalar)
_Loader.add_constructor("tag:yaml.org,2002:float", _float_of_scalar)
