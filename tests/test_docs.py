"""The pages: the README stays short, links and symbols exist, and what readers are told to run runs."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests.test_layers import RANKS
from tgslam import __version__
from tgslam.config.schema import Config
from tgslam.config.setting import settings_of
from tools import markdown_block

CHECKOUT = Path(__file__).resolve().parents[1]
README = CHECKOUT / "README.md"
PAPER = CHECKOUT / "docs" / "paper.md"
NOW = [README, *sorted((CHECKOUT / "docs").glob("*.md"))]  # say what is; the changelog also what was
PAGES = [*NOW, CHECKOUT / "CHANGELOG.md"]
EQUATIONS = range(1, 15)
COMMANDS = [
    "python3 -m venv .venv && .venv/bin/pip install . && .venv/bin/tgslam run\n",
    'python3 -m venv .venv && .venv/bin/pip install -e ".[test]" && .venv/bin/pytest\n',
]


def blocks(page: Path, language: str) -> list[str]:
    return markdown_block.blocks(page.read_text(encoding="utf-8"), language)


def links(page: Path) -> list[str]:
    """Targets of the links and pictures of a page, without those in code."""
    prose = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    return re.findall(r"\]\(([^)\s]+)\)", prose)


def anchors(page: Path) -> set[str]:
    """What GitHub calls the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def symbols(path: Path) -> set[str]:
    """What a module defines: functions, classes, and methods as Class.method."""
    found = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            found.add(node.name)
        if isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{inner.name}" for inner in node.body if isinstance(inner, ast.FunctionDef)}
    return found


def equations() -> dict[int, tuple[str, str]]:
    """Equation -> file and symbol, of the table in docs/paper.md."""
    row = re.compile(r"^\| (\d+) \| [^|]+ \| \[`[^`]+`\]\(\.\./([^)]+)\) \| `([\w.]+)` \|$", flags=re.MULTILINE)
    found = row.findall(PAPER.read_text(encoding="utf-8"))
    assert len(found) == len({number for number, _, _ in found}), "an equation stands in the table twice"
    return {int(number): (path, symbol) for number, path, symbol in found}


def run_python(code: str, folder: Path) -> str:
    """Run a script in a folder of its own, with this checkout's tgslam, and return what it printed."""
    path = os.pathsep.join([str(CHECKOUT), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_readme_is_a_front_page() -> None:
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 120


def test_the_picture_of_the_readme_is_there_and_small() -> None:
    (picture,) = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", README.read_text(encoding="utf-8"))
    data = (CHECKOUT / picture).read_bytes()
    assert data.startswith(b"\x89PNG")
    assert len(data) < 400_000


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in links(page):
        if "://" in target:
            continue
        file, _, anchor = target.partition("#")
        path = (page.parent / file).resolve() if file else page
        assert path.exists(), f"{page.name}: {target}"
        assert not anchor or anchor in anchors(path), f"{page.name}: {target}"


def test_the_index_has_every_page() -> None:
    index = CHECKOUT / "docs" / "index.md"
    assert {page.name for page in index.parent.glob("*.md")} - {"index.md"} <= set(links(index))


@pytest.mark.parametrize("number", EQUATIONS)
def test_the_equation_leads_to_its_code(number: int) -> None:
    path, symbol = equations()[number]
    assert symbol in symbols(CHECKOUT / path)


def test_no_other_equation_is_in_the_table() -> None:
    assert set(equations()) == set(EQUATIONS)


def test_the_total_objective_is_stated_in_one_place() -> None:
    stated = [page.name for page in PAGES if "lambda_pgi E_pgi + lambda_pho E_pho" in page.read_text(encoding="utf-8")]
    assert stated == ["paper.md"]


def test_the_page_on_architecture_has_every_part_in_its_row() -> None:
    text = (CHECKOUT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows: dict[int, set[str]] = {}
    for number, parts in re.findall(r"^\| (\d+) \| ([^|]+) \|", text, flags=re.MULTILINE):
        rows.setdefault(int(number), set()).update(re.findall(r"`(\w+)`", parts))
    assert rows == dict(enumerate((rank for rank in RANKS if rank != {"__main__"}), start=1))


def in_backticks(page: Path) -> list[str]:
    prose = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    return re.findall(r"`([^`\n]+)`", prose)


def known_keys() -> set[str]:
    """Dotted keys of all settings, and of the sections and groups that hold them."""
    keys = {key for key, _ in settings_of(Config())}
    return keys | {key[:at] for key in keys for at, letter in enumerate(key) if letter == "."}


@pytest.mark.parametrize("page", NOW, ids=lambda page: page.name)
def test_settings_that_a_page_names_are_settings(page: Path) -> None:
    sections, keys = {key for key in known_keys() if "." not in key} - {"seed"}, known_keys()
    text = page.read_text(encoding="utf-8")
    given = [code.split()[0] for code in in_backticks(page)] + re.findall(r"--set[ =]([\w.]+)", text)
    named = [re.split("[=:]", word)[0] for word in given if re.match(r"[a-z_]+\.[a-z_]+[a-z_0-9.]*(?:[=:]|$)", word)]
    files = {".txt", ".json", ".glb", ".py"}
    wrong = [key for key in named if key.split(".")[0] in sections and key not in keys]
    assert [key for key in wrong if Path(key).suffix not in files] == []


@pytest.mark.parametrize("page", NOW, ids=lambda page: page.name)
def test_modules_that_a_page_names_exist(page: Path) -> None:
    names = [code for code in in_backticks(page) if re.fullmatch(r"[\w/]+\.py", code)]
    paths = [path for path in names if path.split("/")[0] in ("tgslam", "kernels", "tools", "tests", "docs", "configs")]
    assert [path for path in paths if not (CHECKOUT / path).exists()] == []
    assert not set(names) - set(paths), "in full, from the top of the checkout"


def test_the_citation_names_the_software_and_the_paper() -> None:
    citation = yaml.safe_load((CHECKOUT / "CITATION.cff").read_text(encoding="utf-8"))
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    assert citation["version"] == __version__
    (paper,) = citation["references"]
    assert {"authors", "title", "type"} <= set(paper)
    assert all(author["family-names"] in README.read_text(encoding="utf-8") for author in paper["authors"])


def test_ci_takes_its_commands_from_the_readme() -> None:
    assert blocks(README, "sh") == COMMANDS
    assert len(blocks(README, "python")) == 1
    script = (CHECKOUT / ".ci" / "run").read_text(encoding="utf-8")
    for call in ("$(block sh 1)", "$(block sh 2)", "$(block python 1)"):
        assert call in script
    assert "pip install" not in script


def test_a_block_is_printed_as_it_stands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "page.md"
    page.write_text("a\n```sh\none\n```\n```python\nsh = 1\n```\n\n```sh\n  two &&\n\nthree\n```\n")
    assert markdown_block.main([str(page), "sh", "2"]) == 0
    assert capsys.readouterr().out == "  two &&\n\nthree\n"
    assert markdown_block.main([str(page), "sh", "3"]) == 1
    assert "2 sh blocks" in capsys.readouterr().err


def test_the_page_on_python_runs(tmp_path: Path) -> None:
    printed = run_python("\n".join(blocks(CHECKOUT / "docs" / "python.md", "python")), tmp_path)
    assert "frame 11: tracked" in printed
    assert "plane 0: " in printed
    assert (tmp_path / "my-room" / "planes.json").exists()
