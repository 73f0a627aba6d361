"""The server answers only the browser on this computer that received its key."""

from __future__ import annotations

import http.client
import json
import socket
import urllib.request
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from glassplat.access import cookie_name
from glassplat.annotate.document import MOST_CORNERS, MOST_STROKE_POINTS
from glassplat.annotate.server import LARGEST_BODY, AnnotationServer
from glassplat.annotate.session import open_session
from glassplat.errors import InputError
from tests.annotate.conftest import NAMES, marked_document, serving


@pytest.fixture
def server(room: Path) -> Iterator[AnnotationServer]:
    with serving(room) as running:
        yield running


def ask(
    server: AnnotationServer, path: str, body: Any = None, *, key: str | None = None, **headers: str
) -> tuple[int, bytes]:
    """Status and body of one request, with the headers of the page unless others are given."""
    port = server.server_address[1]
    host = headers.get("Host", f"127.0.0.1:{port}")
    known = {
        "Host": host,
        "Origin": f"http://127.0.0.1:{port}",
        "Cookie": f"{cookie_name(host)}={server.access.key if key is None else key}",
    }
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    data = None if body is None else body if isinstance(body, bytes) else json.dumps(body).encode()
    try:
        connection.putrequest("GET" if body is None else "POST", path, skip_host=True)
        for name, value in (known | headers).items():
            if value:
                connection.putheader(name, value)
        if data is not None and "Content-Length" not in headers:
            connection.putheader("Content-Length", str(len(data)))
        connection.endheaders(data)
        response = connection.getresponse()
        return response.status, response.read()
    finally:
        connection.close()


def save(server: AnnotationServer, document: Any, version: str | None = None) -> tuple[int, Any]:
    """Status and answer of a save by a page that has seen a version, by default the newest one."""
    if version is None:
        version = json.loads(ask(server, "/capture")[1])["version"]
    status, body = ask(server, "/document", {"document": document, "version": version})
    return status, json.loads(body)


def test_it_listens_on_this_computer_only(server: AnnotationServer) -> None:
    assert server.server_address[0] == "127.0.0.1"


def test_the_key_becomes_a_cookie_and_leaves_the_address(server: AnnotationServer) -> None:
    assert ask(server, f"/?key={server.access.key}", key="") == (200, b"")
    assert ask(server, "/")[0] == 200
    assert ask(server, "/?key=guessed")[0] == 403
    assert ask(server, "/?" + 17 * "a=1&")[0] == ask(server, "//[")[0] - 204 == 200


ODD_COOKIES = (
    'prefs={"a":"b"}', "note=hello world", "version=3", "path=/x", "name=Zoë", "a[b]=1", 'q="open', "flag", "=bare",
)  # fmt: skip
"""Cookies of other programs on this computer: a browser sends them to every port."""


def test_cookies_of_other_programs_do_not_block_access(server: AnnotationServer) -> None:
    name = cookie_name(f"127.0.0.1:{server.server_address[1]}")
    for odd, (value, status) in product(ODD_COOKIES, ((server.access.key, 200), ("guessed", 403))):
        ours = f"{name}={value}"
        for cookies in (f"{odd}; {ours}", f"{ours}; {odd}", f"{odd}; {ours}; {odd}"):
            assert ask(server, "/capture", Cookie=cookies)[0] == status, cookies


def test_requests_without_the_key_get_nothing(server: AnnotationServer) -> None:
    for path in ("/", "/page.js", "/capture", "/photo/0", "/thumbnail/0", "/nothing"):
        for key in ("", "guessed"):
            assert ask(server, path, key=key)[0] == 403, path
    assert ask(server, "/document", {}, key="guessed")[0] == 403


def test_an_outline_that_makes_no_sense_is_refused(server: AnnotationServer) -> None:
    for outline in (
        {},
        {"view": 0, "points": [[1, 1], [2, 2]]},
        {"view": 99, "points": [[1, 1], [9, 1], [9, 9]]},
        {"view": 0, "points": [[1, 1], [9, 1], [1e9, 9]]},
        {"view": 0, "points": [[-50, -50], [-9, -50], [-9, -9]]},
    ):
        status, body = ask(server, "/grab", outline)
        assert status == 400 and json.loads(body)["error"], outline


@pytest.mark.parametrize("path", ["/photo/0", "/thumbnail/0"])
def test_photographs_are_not_cached_by_browsers(path: str, server: AnnotationServer) -> None:
    """The next capture is served at the same address, and its photographs are numbered in the same way."""
    host = f"127.0.0.1:{server.server_address[1]}"
    request = urllib.request.Request(
        f"http://{host}{path}", headers={"Cookie": f"{cookie_name(host)}={server.access.key}"}
    )
    with urllib.request.urlopen(request, timeout=30) as response:
        assert response.headers["Cache-Control"] == "no-store"


def test_another_name_for_this_computer_is_refused(server: AnnotationServer) -> None:
    """For example, of a site whose name server points to 127.0.0.1."""
    assert ask(server, "/capture", Host="evil.example:80")[0] == 403
    assert ask(server, "/capture", Host="")[0] in (400, 403)
    for name in ("localhost:9999", "[::1]:9999", "127.0.0.1"):  # Another port, as with SSH.
        assert ask(server, "/capture", Host=name)[0] == 200


def test_requests_of_other_sites_are_refused(server: AnnotationServer) -> None:
    for origin in ("http://evil.example", "null", "", "http://127.0.0.1:1"):
        for path in ("/document", "/results", "/close"):
            assert ask(server, path, marked_document(), Origin=origin)[0] == 403, origin
    assert not server.is_finished


def test_unknown_photographs_and_paths_of_files_are_not_found(server: AnnotationServer) -> None:
    hidden = ("/photo/..%2f..%2fetc%2fpasswd", "/photo/../annotations.json", "/etc/passwd")
    for path in ("/photo/99", "/photo/-1", *hidden):
        assert [ask(server, path, body)[0] for body in (None, {})] == [404, 404], path


def test_browsers_find_an_icon_even_without_the_key(server: AnnotationServer) -> None:
    for key in (None, ""):
        assert ask(server, "/favicon.ico", key=key) == (200, b"")


def test_photographs_are_jpegs(server: AnnotationServer) -> None:
    for path in ("/photo/0", "/thumbnail/4"):
        status, body = ask(server, path)
        assert status == 200 and body.startswith(b"\xff\xd8")


def test_saving_a_document_returns_the_fits(server: AnnotationServer) -> None:
    status, body = save(server, marked_document())
    answer = body["panes"][0]
    assert status == 200 and answer["solved"] and answer["error"] < 0.1
    assert len(answer["outlines"]) == len(answer["corners"]) == len(NAMES)
    assert json.loads((server.session.root / "annotations.json").read_text()) == marked_document()
    assert json.loads(ask(server, "/capture")[1])["document"] == marked_document()


def test_one_view_gives_sight_lines_and_the_next_photograph(server: AnnotationServer) -> None:
    answer = save(server, marked_document((0,)))[1]["panes"][0]
    assert not answer["solved"] and "second photograph" in answer["message"]
    assert answer["next"] and all(one["view"] != 0 for one in answer["next"])
    assert all(line is not None for line in answer["lines"][0][1:]) and answer["lines"][0][0] is None


def too_many_corners() -> dict:
    return marked_document(corners=[{}] * (MOST_CORNERS + 1))


@pytest.mark.parametrize(
    ("body", "status"),
    [
        (b"{", 400),
        (b"[1]", 400),
        (b"{}", 400),
        ([1], 400),
        (b"\xff\xfe", 400),
        (b"[" * 5000, 400),
        ({"version": 2, "panes": []}, 400),
        (marked_document(label=0), 400),
        (marked_document(material="wood"), 400),
        (marked_document(corners=[{"0.png": [1, None]}]), 400),
        (marked_document(strokes={"0.png": [{"kind": "polygon", "effect": "burn", "points": []}]}), 400),
        (too_many_corners(), 400),
        ({"version": 1, "panes": marked_document()["panes"] * 2}, 400),
    ],
)
def test_invalid_messages_change_nothing(body: Any, status: int, server: AnnotationServer) -> None:
    save(server, marked_document())
    if isinstance(body, bytes):
        found, answer = ask(server, "/document", body)
        message = json.loads(answer)
    else:
        found, message = save(server, body)
    assert found == status and message["error"]
    assert server.session.describe()["document"] == marked_document()


def test_more_points_than_fit_are_counted_in_the_refusal(server: AnnotationServer) -> None:
    stroke = {"kind": "brush", "effect": "cut", "radius": 5, "points": [[1, 1]] * (MOST_STROKE_POINTS + 1)}
    _, answer = save(server, marked_document(strokes={"0.png": [stroke]}))
    assert "1 strokes of 20001 points; expected at most 32 and 500, of 20000 points" in answer["error"]


def panes(*labels: int, **more: Any) -> dict:
    """A document with panes of these labels, marked identically."""
    return {"version": 1, "panes": [marked_document(label=label, **more)["panes"][0] for label in labels]}


def on_disk(server: AnnotationServer) -> dict:
    return json.loads((server.session.root / "annotations.json").read_text())


def test_the_save_of_a_second_tab_drops_nothing_of_the_first(server: AnnotationServer) -> None:
    version = json.loads(ask(server, "/capture")[1])["version"]
    assert save(server, panes(1), version)[0] == 200
    status, answer = save(server, panes(1, material="mirror"), version)
    assert status == 409 and "pane 1 added" in answer["error"]
    assert on_disk(server) == panes(1)
    kept = answer["document"]["panes"]
    assert [(pane["label"], pane["material"]) for pane in kept] == [(1, "glass"), (2, "mirror")]
    assert save(server, answer["document"], answer["version"])[0] == 200
    assert on_disk(server) == answer["document"]


def test_marks_of_another_program_are_included(server: AnnotationServer) -> None:
    _, answer = save(server, panes(1))
    (server.session.root / "annotations.json").write_text(json.dumps(panes(1, 2)))
    status, refused = save(server, panes(1, 3), answer["version"])
    assert status == 409 and [pane["label"] for pane in refused["document"]["panes"]] == [1, 2, 3]
    assert on_disk(server) == panes(1, 2)


def test_a_body_that_is_too_long_is_not_read(server: AnnotationServer) -> None:
    for length in (str(LARGEST_BODY + 1), "-1", "many"):
        assert ask(server, "/document", b"{}", **{"Content-Length": length})[0] == 413


def test_the_page_loads_nothing_external(server: AnnotationServer) -> None:
    """No part of the page contains an address, and the browser is forbidden to load any."""
    for path in ("/", "/page.js", "/drawing.js", "/marking.js", "/style.css"):
        status, body = ask(server, path)
        assert status == 200 and b"http:" not in body and b"https:" not in body


def test_done_ends_the_server(room: Path) -> None:
    with serving(room) as server:
        assert ask(server, "/close", {})[0] == 200
        assert server.is_finished


def test_a_port_in_use_is_refused_with_advice(room: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=rf"port {port} is in use; choose another with --port"):
            AnnotationServer(open_session(room), port)
