"""Marks tests of pages, which are skipped where there is no browser."""

from __future__ import annotations

import pytest

from tools.browser import CHROMIUM, DRIVER

needs_browser = pytest.mark.skipif(
    CHROMIUM is None or DRIVER is None, reason="chromium and chromedriver are not installed; `make browser` does it"
)
