"""Lists of recordings, as text (a line each) or as YAML."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tgslam.config.yaml_text import YamlTextError, parse_yaml
from tgslam.errors import ConfigError

_YAML = (".yaml", ".yml")
_KEYS = ("path", "config", "set")


@dataclass(frozen=True)
class Entry:
    """A recording to run."""

    where: str  # in the list, for messages
    path: Path
    config: Path | None  # None = that of the command line
    overrides: tuple[str, ...]  # section.key=value


def read_list(path: Path) -> list[Entry]:
    """The recordings of a list; relative paths in it count from its folder. Raises ConfigError."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise ConfigError(f"{path}: cannot be read: {reason}") from error
    entries = _of_yaml(text, path) if path.suffix.lower() in _YAML else _of_text(text, path)
    if not entries:
        raise ConfigError(f"{path}: names no recording; write a path a line, with a config and settings if need be")
    return entries


def names_of(entries: list[Entry]) -> list[str]:
    """Short names that differ: the folder's; where that is not enough, with its settings; and else its whole path."""
    names = [entry.path.name or str(entry.path) for entry in entries]
    for longer in (_with_settings, _in_full):
        names = [longer(entry) if names.count(name) > 1 else name for entry, name in zip(entries, names, strict=True)]
    return names


def _with_settings(entry: Entry) -> str:
    config = [] if entry.config is None else [entry.config.stem]
    return " ".join([entry.path.name or str(entry.path), *config, *entry.overrides])


def _in_full(entry: Entry) -> str:
    config = [] if entry.config is None else [str(entry.config)]
    return " ".join([str(entry.path), *config, *entry.overrides])


def _of_text(text: str, path: Path) -> list[Entry]:
    """PATH [CONFIG] [SECTION.KEY=VALUE ...] a line; quotes hold names with spaces, # begins a comment."""
    entries = []
    for number, line in enumerate(text.splitlines(), 1):
        where = f"{path}:{number}"
        words = _words(line, where)
        if not words:
            continue
        configs = [word for word in words[1:] if "=" not in word]
        if len(configs) > 1:
            raise ConfigError(
                f"{where}: expected PATH [CONFIG] [SECTION.KEY=VALUE ...], but {configs[1]!r} is one word too many; "
                "put names with spaces in quotes"
            )
        overrides = [word for word in words[1:] if "=" in word]
        entries.append(_entry(where, words[0], configs[0] if configs else None, overrides, path))
    return entries


def _words(line: str, where: str) -> list[str]:
    lexer = shlex.shlex(line, posix=True, punctuation_chars=False)
    lexer.whitespace_split, lexer.escape = True, ""  # a backslash belongs to a path
    try:
        return list(lexer)
    except ValueError as error:
        raise ConfigError(f"{where}: a quote is not closed") from error


def _of_yaml(text: str, path: Path) -> list[Entry]:
    """A list of paths, or of mappings with path, config and set."""
    try:
        items = parse_yaml(text)
    except YamlTextError as error:
        line = "" if error.line is None else f":{error.line}"
        raise ConfigError(f"{path}{line}: {error}") from error
    if items is None:
        return []
    if not isinstance(items, list):
        raise ConfigError(f"{path}: must be a list of recordings (`- path: ...`), not a {type(items).__name__}")
    return [_of_item(item, f"{path}, recording {number}", path) for number, item in enumerate(items, 1)]


def _of_item(item: Any, where: str, path: Path) -> Entry:
    facts: Any = {"path": item} if isinstance(item, str) else item
    if not isinstance(facts, Mapping) or "path" not in facts:
        raise ConfigError(f"{where}: must be a path, or a mapping with path")
    unknown = [str(key) for key in facts if key not in _KEYS]
    if unknown:
        raise ConfigError(f"{where}: unknown key {unknown[0]!r}; there are {', '.join(_KEYS)}")
    overrides = facts.get("set") or []
    if not isinstance(overrides, list) or not all(isinstance(text, str) for text in overrides):
        raise ConfigError(f"{where}: `set` must be a list of section.key=value")
    for key in ("path", "config"):
        if not isinstance(facts.get(key, ""), str):
            raise ConfigError(f"{where}: `{key}` must be text, not {facts[key]!r}")
    return _entry(where, facts["path"], facts.get("config"), overrides, path)


def _entry(where: str, recording: str, config: str | None, overrides: list[str], path: Path) -> Entry:
    if not recording:
        raise ConfigError(f"{where}: the path is empty")
    beside = None if config is None else path.parent / Path(config).expanduser()
    settings = beside if beside is None or beside.is_file() else Path(str(config))  # else a packaged one
    return Entry(where, path.parent / Path(recording).expanduser(), settings, tuple(overrides))
