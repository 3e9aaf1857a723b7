"""Settings changed by name, in whichever tier of a section they are."""

from __future__ import annotations

import dataclasses
from typing import Any, TypeVar

Section = TypeVar("Section")


def changed(section: Section, **values: Any) -> Section:
    """The section with these settings changed; TypeError for a name that it does not have."""
    result, unknown = _changed(section, values)
    if unknown:
        raise TypeError(f"{type(section).__name__} has no {', '.join(sorted(unknown))}")
    return result


def _changed(section: Any, values: dict[str, Any]) -> tuple[Any, set[str]]:
    changes, unknown = {}, set(values)
    for field in dataclasses.fields(section):
        present = getattr(section, field.name)
        if field.name in values:
            changes[field.name] = values[field.name]
            unknown.discard(field.name)
        elif dataclasses.is_dataclass(present):
            below, missing = _changed(present, values)
            changes[field.name] = below
            unknown &= missing
    return dataclasses.replace(section, **changes), unknown
