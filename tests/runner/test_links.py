"""The check of the documents' links that `make lint` runs, and that of the built site."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "tools" / "docs"))
import build
import links


def test_the_documents_have_no_problem() -> None:
    assert list(build.problems()) == []


def test_links_that_lead_nowhere_are_found(tmp_path: Path) -> None:
    page = tmp_path / "a.md"
    (tmp_path / "b.md").write_text("# A `b`: c\n## Twice\n## Twice\n```\n# no heading\n```\n")
    page.write_text(
        "[1](b.md) [2](b.md#a-b-c) [3](b.md#twice-1) [4](https://example.org/x) [5](made.md) `[6](no.md)`\n"
        "```\n[7](no.md)\n```\n"
    )
    assert list(links.broken(page, {tmp_path / "made.md"})) == []
    for bad in ("[x](c.md)", "![x](c.png)", '<img src="c.png">', "[x](b.md#no-heading)", "[x](#here)"):
        page.write_text(f"{bad}\n")
        assert len(list(links.broken(page, set()))) == 1, bad


def test_what_a_site_loads_from_elsewhere_is_found(tmp_path: Path) -> None:
    page = tmp_path / "index.html"
    page.write_text('<p id="here"><a href="#here"></a><a href="https://example.org"></a><img src="index.html">')
    assert list(links.broken_site(tmp_path)) == []
    for bad in ('<script src="https://example.org/x.js">', '<link href="//example.org/x.css">', '<a href="#gone">', '<a href="gone.html">'):
        page.write_text(bad)
        assert len(list(links.broken_site(tmp_path))) == 1, bad
