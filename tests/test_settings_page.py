"""docs/settings.md: that it is what the settings say, and that they say enough."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.test_layers import CHECKOUT
from tgslam.config.reference import EXPERT, settings_page
from tgslam.config.schema import Config
from tgslam.config.setting import settings_of
from tools import settings_page as tool

SETTINGS = {key: field for key, (_, field) in settings_of(Config())}
USER = [key for key in SETTINGS if EXPERT not in key.split(".")]
TABLES = sorted({key.rpartition(".")[0] for key in USER if "." in key})


def test_the_page_is_up_to_date() -> None:
    """If not: python -m tools.settings_page."""
    assert (CHECKOUT / "docs" / "settings.md").read_text(encoding="utf-8") == settings_page()


def test_the_page_names_every_setting_in_its_tier() -> None:
    user, _, expert = settings_page().partition("## Expert settings")
    for key, _ in settings_of(Config()):
        section, _, name = key.rpartition(".")
        tier = expert if EXPERT in section.split(".") else user
        table = tier.partition(f"### `{section}`" if section else "### At the top level")[2].partition("###")[0]
        assert f"\n| `{name}` | " in table, key


@pytest.mark.parametrize("key", SETTINGS)
def test_every_setting_says_what_it_means(key: str) -> None:
    doc = SETTINGS[key].metadata["doc"]
    assert doc.endswith(".") and "|" not in doc
    unit = key.rpartition("_")[2]
    if unit in ("m", "s", "px", "rad") and "_per_" not in key:
        assert unit in doc.replace(",", " ").replace(".", " ").replace("/", " ").split(), f"{key}: in which unit?"


@pytest.mark.parametrize("table", TABLES)
def test_what_users_turn_is_little(table: str) -> None:
    assert len([key for key in USER if key.rpartition(".")[0] == table]) <= 10


def test_the_tool_writes_the_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert tool.main([str(tmp_path / "page.md")]) == 0
    assert (tmp_path / "page.md").read_text(encoding="utf-8") == settings_page()
    assert tool.main([str(tmp_path / "gone" / "page.md")]) == 1
    assert "error:" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="0"):
        tool.main(["--help"])
    assert "docs/settings.md" in capsys.readouterr().out
