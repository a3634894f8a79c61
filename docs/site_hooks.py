"""A hook of mkdocs: README.md is the start page, and files of the repository that pages link to are in the site.

Pages are written to be read in a checkout, where links such as ``../config/robots/iiwa7.yaml`` lead somewhere. In the
site these files stand under ``repository/``; links to folders become plain text.
"""

from __future__ import annotations

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parent.parent
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)#\s]+)(#[^)\s]*)?\)")


def _rewrite(text: str, folder: Path) -> tuple[str, set[str]]:
    """A page that stands in ``folder``, with its links as in the site; the files of the repository that it links to."""
    found: set[str] = set()

    def link(match: re.Match[str]) -> str:
        picture, words, target, anchor = match[1], match[2], match[3], match[4] or ""
        if "://" in target or target.startswith("mailto:"):
            return match[0]
        path = (folder / target).resolve().relative_to(ROOT)
        if path == Path("README.md"):
            return f"{picture}[{words}](index.md{anchor})"
        if path.parts[0] == "docs" and path.suffix != ".py":
            return f"{picture}[{words}]({path.relative_to('docs').as_posix()}{anchor})"
        if (ROOT / path).is_dir():
            return words
        found.add(path.as_posix())
        return f"{picture}[{words}](repository/{path.as_posix()}.txt)"

    return LINK.sub(link, text), found


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the start page and the linked files."""
    text, linked = _rewrite((ROOT / "README.md").read_text(encoding="utf-8"), ROOT)
    files.append(File.generated(config, "index.md", content=text))
    for file in files.documentation_pages():
        if file.src_uri != "index.md":
            linked |= _rewrite(file.content_string, ROOT / "docs")[1]
    for path in sorted(linked):
        files.append(File.generated(config, f"repository/{path}.txt", content=(ROOT / path).read_bytes()))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """The links of a page."""
    return markdown if page.file.src_uri == "index.md" else _rewrite(markdown, ROOT / "docs")[0]
