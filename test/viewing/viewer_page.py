"""The viewer's page with one view and nothing behind its controls."""

from __future__ import annotations

from typing import Any, cast

from body_tracking.viewing.page import Page


class Nobody:
    """A target for the page's controls without effect."""

    def __getattr__(self, name: str) -> Any:
        return lambda *given: ""


def page_with(view: Any) -> Page:
    return Page("127.0.0.1", 0, (), cast(Any, Nobody()), ("ekf",), ("model",), 5.0, (), (view,))
