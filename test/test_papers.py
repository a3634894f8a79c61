"""``docs/papers.md`` covers everything in the papers; its names exist, and their docstrings cite the equations."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "papers.md"

NOT_YET, NONE = "not yet", "none"
AUTHORS = {
    "schlagenhauf2017": ("Schlagenhauf", "thesis"),
    "gaschler2011": ("Gaschler",),
    "jatesiktat2018": ("Jatesiktat",),
}
NUMBERED = {
    "schlagenhauf2017": "eq. 3.1-3.27, 4.1-4.2, 5.1-5.22; algorithms 1-2; "
    "tables 2.1, 3.1-3.4, 4.1-4.4, 5.1-5.3, C.1, E.1; "
    "figures 1.1, 2.1-2.3, 3.1-3.6, 4.1-4.22, 5.1-5.19, A.1-A.3, D.1-D.2",
    "gaschler2011": "eq. 3.1-3.20, 4.1-4.19, 5.1-5.20, 6.1-6.3; tables 4.1, 6.1-6.2; "
    "figures 1.1-1.4, 2.1-2.2, 3.1-3.5, 4.1-4.4, 5.1-5.9, 6.1-6.4, 7.1",
    "jatesiktat2018": "eq. 1-19; figures 1-5",
}
"""All numbered items of each paper, which have to be on the page."""

_NUMBER = r"(?:[A-E]\.\d+|[IVX]+(?:-[A-J])?|\d+(?:\.\d+)*)"
_ITEM = rf"{_NUMBER}(?:-{_NUMBER})?"
_MENTION = re.compile(
    rf"(eq\.|table|figure|algorithm|section)s?\s+({_ITEM}(?:(?:,\s+|\s+and\s+){_ITEM})*)", re.IGNORECASE
)
_REFERENCE = re.compile(r"`([\w/]+\.py)::([\w.]+)`")


@dataclass(frozen=True)
class Row:
    """One line of a table: numbers in the paper, subject, place in this package, remark."""

    paper: str
    numbers: str
    what: str
    here: str
    remark: str


def mentions(text: str) -> dict[str, set[str]]:
    """Numbers by kind (``eq.``, ``table``, ...) that a text mentions; ranges as all that is in them."""
    found: dict[str, set[str]] = defaultdict(set)
    for kind, listed in _MENTION.findall(text):
        for item in re.findall(_ITEM, listed):
            first, dash, last = item.partition("-")
            if not dash or not last[-1].isdigit():
                found[kind.lower()].add(item)
                continue
            stem, _, low = first.rpartition(".")
            high = last.rpartition(".")[2]
            found[kind.lower()] |= {f"{stem}.{n}" if stem else str(n) for n in range(int(low), int(high) + 1)}
    return found


def sections() -> dict[str, str]:
    """The text below each heading of the page, by the paper's name."""
    parts = re.split(r"^## (\w+).*\n", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def rows() -> list[Row]:
    """Every line of every table."""
    found = []
    for paper, text in sections().items():
        lines = [line for line in text.splitlines() if line.startswith("|")]
        cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]
        assert all(len(row) == 4 for row in cells), [row for row in cells if len(row) != 4]
        found += [Row(paper, *row) for row in cells]
    return found


@cache
def module(path: str) -> ast.Module:
    return ast.parse((ROOT / path).read_text(encoding="utf-8"))


def docstring(path: str, name: str) -> str | None:
    """The docstring of a class, function, method or constant; empty where it has none, None where there is no such."""
    inside: ast.Module | ast.stmt = module(path)
    for part in name.split("."):
        body: list[ast.stmt] = getattr(inside, "body", [])
        for node, after in zip(body, [*body[1:], None], strict=True):
            targets = getattr(node, "targets", [getattr(node, "target", None)])
            if getattr(node, "name", None) == part:
                inside = node
                break
            if any(isinstance(target, ast.Name) and target.id == part for target in targets):
                text = getattr(getattr(after, "value", None), "value", None)
                return text if isinstance(text, str) else ""
        else:
            return None
    assert isinstance(inside, ast.ClassDef | ast.FunctionDef)
    return ast.get_docstring(inside) or ""


def missing(wanted: Mapping[str, set[str]], found: Mapping[str, set[str]]) -> list[str]:
    return sorted(f"{kind} {number}" for kind in wanted for number in wanted[kind] - found.get(kind, set()))


def test_mentions_are_read_as_people_read_them() -> None:
    text = "eq. 5.1-5.3, 3.9 and 5.11; tables C.1, E.1, sections 4.3.3-4.3.4 and II-H; algorithm 1, Figure 5.1"
    assert mentions(text) == {
        "eq.": {"5.1", "5.2", "5.3", "3.9", "5.11"},
        "table": {"C.1", "E.1"},
        "section": {"4.3.3", "4.3.4", "II-H"},
        "algorithm": {"1"},
        "figure": {"5.1"},
    }


@pytest.mark.parametrize("paper", AUTHORS)
def test_everything_with_a_number_is_on_the_page_and_nothing_else(paper: str) -> None:
    wanted = mentions(NUMBERED[paper])
    (results,) = re.findall(r"^Not methods: (.*?)\n\n", sections()[paper] + "\n", re.MULTILINE | re.DOTALL)
    named = [row.numbers for row in rows() if row.paper == paper]
    found = mentions("; ".join([*named, results]))
    assert missing(wanted, found) == []
    del found["section"]
    assert missing(found, wanted) == []
    assert all(mentions(each) for each in named)


def test_every_line_says_where_it_is_or_why_it_is_not() -> None:
    assert set(AUTHORS) == set(sections())
    for row in rows():
        if row.here == NOT_YET:
            assert row.paper != "schlagenhauf2017", row
        elif row.here == NONE:
            assert row.remark, row
        else:
            assert _REFERENCE.sub("", row.here).strip(", ") == "", row


def test_every_name_on_the_page_exists() -> None:
    named = _REFERENCE.findall(PAGE.read_text(encoding="utf-8"))
    assert [f"{path}::{name}" for path, name in named if docstring(path, name) is None] == []


@pytest.mark.parametrize(
    "row", [row for row in rows() if "::" in row.here], ids=lambda row: f"{row.paper} {row.numbers}"
)
def test_implementations_cite_number_and_paper(row: Row) -> None:
    for path, name in _REFERENCE.findall(row.here):
        text = docstring(path, name) or ""
        assert missing(mentions(row.numbers), mentions(text)) == [], f"{path}::{name}"
        around = text + (ast.get_docstring(module(path)) or "")
        assert any(author in around for author in AUTHORS[row.paper]), f"{path}::{name}"
