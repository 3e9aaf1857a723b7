"""How a setting is declared: its default, what is allowed, and what it means."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Iterator
from typing import Any


def setting(
    default: Any,
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    min_items: int = 0,
    doc: str = "",
) -> Any:
    """A dataclass field with its allowed range [low, high] or choices (of a list: of each item), for `loader`.

    doc: its unit and meaning, for `docs/settings.md`.
    """
    metadata = {"low": low, "high": high, "choices": choices, "min_items": min_items, "doc": doc}
    if isinstance(default, tuple):
        return dataclasses.field(default_factory=lambda: default, metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def own_settings(section: Any) -> list[tuple[Any, dataclasses.Field[Any]]]:
    """(type, field) of the settings of `section` itself, without those of sections within it."""
    hints = typing.get_type_hints(type(section))
    fields = dataclasses.fields(section)
    return [(hints[field.name], field) for field in fields if not dataclasses.is_dataclass(hints[field.name])]


def settings_of(section: Any, prefix: str = "") -> Iterator[tuple[str, tuple[Any, dataclasses.Field[Any]]]]:
    """(dotted key, (type, field)) of every setting below `section`."""
    for hint, field in own_settings(section):
        yield prefix + field.name, (hint, field)
    for field in dataclasses.fields(section):
        value = getattr(section, field.name)
        if dataclasses.is_dataclass(value):
            yield from settings_of(value, f"{prefix}{field.name}.")


def allowed(hint: Any, field: dataclasses.Field[Any]) -> str:
    """What a setting takes, in words: "a whole number from 2 to 1000"."""
    choices = field.metadata.get("choices")
    if choices:
        return "one of " + ", ".join(choices)
    low, high = field.metadata.get("low"), field.metadata.get("high")
    bounds = ""
    if low is not None and high is not None:
        bounds = f" from {low} to {high}"
    elif low is not None:
        bounds = f" of {low} or more"
    elif high is not None:
        bounds = f" of {high} or less"
    return _in_words(hint, bounds)


def _in_words(hint: Any, bounds: str) -> str:
    if typing.get_origin(hint) is tuple:
        elements = typing.get_args(hint)
        length = "" if elements[-1] is Ellipsis else f"{len(elements)} values, "
        return f"a list ({length}each {_in_words(elements[0], bounds)})"
    if isinstance(hint, types.UnionType):
        return " or ".join(_in_words(option, "") for option in typing.get_args(hint)) + bounds
    words = {bool: "true or false", int: "a whole number", float: "a number", str: "text", type(None): "null"}
    return words[hint] + bounds
