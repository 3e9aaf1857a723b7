"""How a setting is declared: its default, and what is allowed."""

from __future__ import annotations

import dataclasses
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
