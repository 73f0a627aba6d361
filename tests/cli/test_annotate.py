"""Inputs refused by `glassplat annotate`, and the opening of its page."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

import pytest

from glassplat.annotate.server import AnnotationServer
from glassplat.cli import serving
from glassplat.cli.main import main
from tests.annotate.conftest import marked_document, saved, write_room
from tests.annotate.conftest import serving as serving_room
from tests.browser_needed import needs_browser
from tools.browser import Browser, wait_until


@pytest.fixture
def room(tmp_path: Path) -> Path:
    return write_room(tmp_path / "room")


def test_a_folder_that_is_not_a_capture_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["annotate", str(tmp_path / "nothing"), "--no-open-browser"])
    said = capsys.readouterr()
    told = " ".join((said.out + said.err).split())
    assert code == 2
    assert "nothing" in told and "Traceback" not in told


def served(room: Path, monkeypatch: pytest.MonkeyPatch, opened: Callable[[str, AnnotationServer], None]) -> None:
    """Runs the command as with a screen; `opened` receives the address given to the browser, and the server."""

    def serve(server: AnnotationServer, poll_interval: float) -> None:
        opened(asked[0], server)

    asked: list[str] = []
    monkeypatch.setattr("glassplat.cli.serving.has_screen", lambda: True)
    monkeypatch.setattr("webbrowser.open", asked.append)
    monkeypatch.setattr(AnnotationServer, "serve_forever", serve)
    assert main(["annotate", str(room), "--port", "0"]) == 0


def test_the_url_of_the_started_browser_grants_no_access(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All users of a computer can read command lines."""

    def opened(address: str, server: AnnotationServer) -> None:
        assert server.access.key not in address
        page = Path(url2pathname(urlsplit(address).path))
        assert server.address in page.read_text()
        assert sys.platform == "win32" or page.stat().st_mode & 0o077 == 0

    before = {path.name for path in room.iterdir()}
    served(room, monkeypatch, opened)
    assert {path.name for path in room.iterdir()} <= before | {"annotations.json"}


@pytest.mark.parametrize("changes", ["nothing", "a mark", "masks", "masks, then a mark"])
def test_the_end_of_the_command_says_if_masks_lack_the_latest_marks(
    changes: str, room: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def opened(address: str, server: AnnotationServer) -> None:
        session = server.session
        for change in () if changes == "nothing" else changes.split(", then "):
            if change == "masks":
                saved(session, marked_document())
                session.finish()
            else:
                saved(session, marked_document((0, 1, 2, 3)))

    served(room, monkeypatch, opened)
    told, lack = " ".join(capsys.readouterr().out.split()), "masks and planes do not contain the latest marks"
    assert (lack in told) is changes.endswith("mark")
    assert ("next: glassplat train planar" in told) is not changes.endswith("mark")
    served(room, monkeypatch, lambda *unused: None)  # Marks that were never written are reported again.
    assert (lack in capsys.readouterr().out) is (changes == "a mark")


@pytest.mark.parametrize(
    ("variables", "expected"),
    [({}, False), ({"DISPLAY": ":0"}, True), ({"DISPLAY": "localhost:10.0", "SSH_CONNECTION": "1 2 3 4"}, False)],
    ids=str,
)
def test_a_browser_is_opened_only_where_somebody_sees_it(
    variables: dict[str, str], expected: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SSH_CONNECTION"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert serving.has_screen() is expected


def text_of(browser: Browser) -> str:
    """Text of a page that may be navigating to another one."""
    with suppress(RuntimeError):
        return str(browser.evaluate("document.body?.innerText"))
    return ""


@needs_browser
def test_the_link_may_stand_on_another_page(room: Path, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    with serving_room(room) as server:
        page.write_text(f'<meta http-equiv="refresh" content="0; url={server.address}">')
        with Browser(page, query="") as browser:
            wait_until(lambda: "corners" in text_of(browser), "the page")
            assert server.access.key not in browser.evaluate("location.href")
