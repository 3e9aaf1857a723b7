"""The page of all settings, in Markdown: first what users turn, then the expert tier by component."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Iterator
from typing import Any

from tgslam.config.schema import Config
from tgslam.config.setting import allowed, own_settings

EXPERT = "expert"  # the name of a section's second tier

_HEAD = """# Settings

<!-- Written by `python -m tools.settings_page`: change the settings in tgslam/config, not this file. -->

A setting is given in a YAML file, as in `tgslam run my.yaml`, or on the command line:

```
tgslam run --set tracking.references=3 --set tracking.expert.lost.max_condition=1e6
```

```yaml
tracking:
  references: 3
  expert:
    lost:
      max_condition: 1e6
```

What is not given keeps its default. Every run writes all of its settings to `config.yaml` in its folder.
"""
_EXPERT_HEAD = """## Expert settings

What needs knowledge of the algorithm to be turned, by the component that it belongs to.
"""


def settings_page() -> str:
    """The text of docs/settings.md."""
    groups = list(_groups(Config(), ""))
    user = [_table(section, prefix) for section, prefix in groups if EXPERT not in prefix.split(".")]
    expert = [_table(section, prefix) for section, prefix in groups if EXPERT in prefix.split(".")]
    return "\n".join([_HEAD, "## User settings\n", *user, _EXPERT_HEAD, *expert])


def _groups(section: Any, prefix: str) -> Iterator[tuple[Any, str]]:
    """(section, dotted name) of `section` and all below it that have settings of their own."""
    if own_settings(section):
        yield section, prefix
    for field in dataclasses.fields(section):
        value = getattr(section, field.name)
        if dataclasses.is_dataclass(value):
            yield from _groups(value, f"{prefix}.{field.name}".lstrip("."))


def _table(section: Any, prefix: str) -> str:
    lines = [f"### `{prefix}`" if prefix else "### At the top level", ""]
    lines += [inspect.cleandoc(type(section).__doc__ or ""), ""] if prefix else []
    lines += ["| key | default | allowed | meaning |", "| --- | --- | --- | --- |"]
    for hint, field in own_settings(section):
        default = _shown(getattr(section, field.name))
        lines.append(f"| `{field.name}` | `{default}` | {allowed(hint, field)} | {field.metadata['doc']} |")
    return "\n".join([*lines, ""])


def _shown(value: Any) -> str:
    """As it would be written in YAML."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(_shown, value))}]"
    return str(value).lower() if isinstance(value, bool) else str(value)
