"""Every document that sources and documents cite is there, and so is the section they name."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted(
    path
    for folder in ("tasks", "factory", "planners", "conf", "deploy", "tests", "examples")
    for path in (ROOT / folder).rglob("*")
    if path.suffix in (".py", ".yaml", ".yml", ".sh") and path != Path(__file__).resolve()
)
FOLDERS = ("docs", "deploy", "experiments")
PAGES = sorted([*ROOT.glob("*.md"), *(page for folder in FOLDERS for page in (ROOT / folder).rglob("*.md"))])
WRITTEN_BY_A_RUN = {
    "ab.md": "`python -m planners ab` writes it beside its CSVs",
}

CITED = re.compile(r"(?<![\w/<{])((?:[\w.-]+/)*[\w-]+\.md)\b")
OF_REWARD = re.compile(r"docs/reward\.md ((?:\d[a-l]?(?:,? and |, )?)+)")
LINK = re.compile(r"\]\(([^)\s]+)\)")


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_every_document_that_a_source_cites_is_there() -> None:
    cited = {(path, name) for path in [*SOURCES, ROOT / "Makefile"] for name in CITED.findall(path.read_text())}
    assert len(cited) > 60
    lost = [f"{path.relative_to(ROOT)} cites {name}" for path, name in sorted(cited) if not found(name)]
    assert not lost, "\n".join(lost)


def found(name: str) -> bool:
    """A name without a folder is that of a page in docs/."""
    return name in WRITTEN_BY_A_RUN or (ROOT / name).is_file() or (ROOT / "docs" / name).is_file()


def test_every_section_of_the_rewards_rules_that_is_cited_is_there() -> None:
    page = (ROOT / "docs/reward.md").read_text()
    there = set(re.findall(r"^##+ (\d[a-l]?)\.? ", page, re.M))
    lost, n_cited = [], 0
    for path in SOURCES:
        for listed in OF_REWARD.findall(path.read_text()):
            cited = re.findall(r"\d[a-l]?", listed)
            n_cited += len(cited)
            lost += [f"{path.relative_to(ROOT)} cites {section}" for section in cited if section not in there]
    assert n_cited > 80
    assert not lost, "\n".join(lost)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_of_a_page_leads_somewhere(page: Path) -> None:
    for target in LINK.findall(re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.M | re.S)):
        if "://" in target:
            continue
        name, _, anchor = target.partition("#")
        to = (page.parent / name).resolve() if name else page
        assert to.exists(), f"{target} is not there"
        if anchor:
            assert anchor in anchors(to), f"{to.name} has no heading #{anchor}"
