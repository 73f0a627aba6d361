"""Marks tests of pages, which are skipped where there is no browser."""

from __future__ import annotations

import pytest

from tools.browser import CHROMIUM

needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed; `make browser` does it")
