"""How the house is built, from its source alone: what the contracts of `pyproject.toml` can't say."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

import zscout
from tests.fleets import PLAIN_ONLY, QUICK, SECURED, TESTS

ROOT = Path(__file__).parents[1]
MODULES = {path.relative_to(ROOT): ast.parse(path.read_text()) for path in sorted((ROOT / "zscout").rglob("*.py"))}
TOP_PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"]
PAGES = [*TOP_PAGES, *sorted((ROOT / "docs").rglob("*.md"))]
SOURCES = {path.name for tree in ("zscout", "tests", "studies", "benchmarks") for path in (ROOT / tree).rglob("*.py")}
WROTE = re.compile(r"`([\w./]+)`")
TREES = {"zscout", "tests", "studies", "benchmarks", "examples"} | {path.parts[1] for path in MODULES}
LIVE = re.compile(r"pytest\.mark\.live\b")
LINK = re.compile(r"\]\(([^)#:]+)(?:#([^)]*))?\)")
HEADLESS = (
    r"(?:^|[.:;,(]\s+|\b(?:of|by|from|to|for|with|than|and|as|how|is) )(?:[Ww]ho|[Ww]hat)(?:ever)? (?:is|was|has|had|"
    r"can|can't|may|asks?|holds?|waits?|comes?|goes|ends?|runs?|came|went|needs?|reads?|makes?|would|does|did|will|takes?|"
    r"stands?|lives?|says?|leads?|joins?|changes|changed|follows|wants?|knows?|they|it|others|a|an|the|one|its|nobody|"
    r"somebody)\b"
)
"""A clause without its noun: who holds it, what was asked."""
PLAIN = [
    "studies",
    *("zscout/behaviors", "zscout/cli", "zscout/drivers"),
    *("zscout/components", "zscout/config", "zscout/placement", "zscout/simulation", "zscout/testing"),
    *("zscout/mesh", "zscout/messages", "zscout/services/bookings", "zscout/services/node"),
    *("zscout/services/journal", "zscout/services/metrics", "zscout/services/notify", "zscout/services/placement"),
    "zscout/services/recorder",
    "zscout/services/plain_http.py",
    *("benchmarks", "zscout/__init__.py", "zscout/node.py"),
    *("zscout/keyexpr.py", "zscout/logs.py", "zscout/ports.py", "zscout/streams.py", "zscout/terminal.py"),
    *("zscout/trace.py", "zscout/types.py"),
    *("zscout/rcm", "zscout/scheduling", "zscout/services/rcm"),
]
"""Folders and files in plain English: docstrings, comments and messages keep the rates of WORN."""
WORN = {
    HEADLESS: 1.0,
    r"\b(?:told|tells?|telling|said|says|hears?|heard)\b": 1.0,
    r"\b(?:[Nn]obody|[Ss]omebody|[Aa]nybody|[Ee]verybody|[Ww]hom|[Ww]hoever)\b": 0.5,
    r"\b(?:(?:go|goes|going|gone|went) on|anew|mend(?:s|ed|ing)?|lately|likewise)\b": 0.5,
    r"\bstands? (?:by|still|for|in|one|there|nowhere)\b": 0.5,
    r"\b(?:is|are|was|were) to be\b|\bof what\b|\bthat of\b|\bthose (?:of|that|who)\b": 0.5,
    r"\b(?:that|this|each|another|such a|which|no) one\b": 0.5,
}
"""Phrases that make a reader read twice, each with its most uses per 1,000 words."""
ONE = re.compile(r"\bfor one in\b|\bone\.\w")


def imports(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute here"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def test_a_public_class_name_stands_in_one_module() -> None:
    homes = defaultdict(set)
    for path, tree in MODULES.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes[node.name].add(str(path))
    assert len(homes) > 400
    assert {name: paths for name, paths in homes.items() if len(paths) > 1} == {}


def test_nothing_but_the_command_line_imports_the_simulation() -> None:
    outside = {
        path: found
        for path, tree in MODULES.items()
        if path.parts[1] not in ("simulation", "cli")
        and (found := [name for name in imports(tree) if f"{name}.".startswith("zscout.simulation.")])
    }
    assert outside == {}


@pytest.mark.parametrize("name", zscout.__all__)
def test_a_public_name_of_the_package_resolves(name: str) -> None:
    assert getattr(zscout, name) is not None


def exists(written: str) -> bool:
    """Whether a path is there, below the project, `zscout/` or `docs/`; a name alone: anywhere."""
    if "/" in written:
        return any((ROOT / base / written).exists() for base in ("", "zscout", "docs"))
    return written in SOURCES


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_a_path_of_source_that_a_page_names_exists(page: Path) -> None:
    words = WROTE.findall(page.read_text())
    trees = {word for word in words if word.endswith("/") and word.partition("/")[0] in TREES}
    named = {word for word in words if word.endswith(".py")} | trees
    assert {word for word in named if not exists(word)} == set()


def test_a_function_that_the_page_of_questions_names_is_in_its_file() -> None:
    page = (ROOT / "docs" / "architecture" / "questions.md").read_text()
    named = {
        (Path("zscout") / path, name)
        for path, names in re.findall(r"`([\w/]+\.py)`: ((?:`\w+`(?:, )?)+)", page)
        for name in re.findall(r"`(\w+)`", names)
    }
    assert len(named) > 20
    kinds = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
    found = {(path, node.name) for path, tree in MODULES.items() for node in ast.walk(tree) if isinstance(node, kinds)}
    assert named - found == set()


def slugs(page: Path) -> set[str]:
    """The anchors of a page's headings."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading).lower().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", TOP_PAGES, ids=lambda page: page.name)
def test_a_file_and_heading_that_a_page_links_exists(page: Path) -> None:
    links = [(page.parent / file, heading) for file, heading in LINK.findall(page.read_text())]
    assert [str(file) for file, _ in links if not file.exists()] == []
    assert [f"{file}#{heading}" for file, heading in links if heading and heading not in slugs(file)] == []


def test_the_page_on_the_architecture_names_every_room() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text()
    rooms = {
        f"{path.name}/" if path.is_dir() else path.name
        for path in (ROOT / "zscout").iterdir()
        if path.name not in ("__init__.py", "__pycache__", "py.typed")
    }
    assert {room for room in rooms if f"`{room}`" not in page} == set()


def test_every_live_module_is_on_both_fleets_secured_or_says_why_not() -> None:
    live = {path.relative_to(TESTS).as_posix() for path in TESTS.rglob("test_*.py") if LIVE.search(path.read_text())}
    assert not SECURED & PLAIN_ONLY.keys()
    assert {*SECURED, *PLAIN_ONLY, *QUICK} - live == set()
    page = (ROOT / "docs" / "suite.md").read_text()
    rows = {f"| {reason} | {count} |" for reason, count in Counter(PLAIN_ONLY.values()).items()}
    assert {row for row in rows if row not in page} == set()
    secured, plain = len(SECURED), len(PLAIN_ONLY)
    counts = f"{len(live) - secured - plain} run on both, {secured} are about rights, {plain} on a plain fleet alone"
    assert counts in page


def prose(source: str) -> Iterator[str]:
    """Yield the lines of comments, docstrings and texts with a blank."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT and not re.search("noqa|type:", token.string):
            yield token.string.lstrip("# ")
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            yield from (line.strip() for line in node.value.splitlines())


@pytest.mark.parametrize("room", PLAIN)
def test_a_swept_room_is_in_plain_english(room: str) -> None:
    path = ROOT / room
    sources = [file.read_text() for file in ([path] if path.is_file() else sorted(path.rglob("*.py")))]
    lines = [line for source in sources for line in prose(source)]
    words = sum(len(line.split()) for line in lines)
    for phrase, limit in WORN.items():
        found = [line for line in lines for _ in re.findall(phrase, line)]
        assert len(found) <= limit * words / 1000, found
    assert [name for source in sources for name in ONE.findall(source)] == [], "name the variable by its noun"
