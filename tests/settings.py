"""Settings for tests: sections with some other values, however deep those lie."""

from __future__ import annotations

import dataclasses
from typing import Any, TypeVar

Section = TypeVar("Section")


def changed(section: Section, **values: Any) -> Section:
    """The section with these values, by name: each name occurs once in it and in the sections below it."""
    found, left = _changed(section, values)
    assert not left, f"no such settings: {', '.join(left)}"
    return found


def _changed(section: Any, values: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
    changes, left = {}, dict(values)
    for field in dataclasses.fields(section):
        inner = getattr(section, field.name)
        if field.name in left:
            changes[field.name] = left.pop(field.name)
        elif dataclasses.is_dataclass(inner):
            changes[field.name], left = _changed(inner, left)
    return dataclasses.replace(section, **changes), left
