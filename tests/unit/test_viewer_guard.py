"""Access control of the viewer, and the address on which it listens."""

import socket
from types import SimpleNamespace

import pytest

import fidsplat as fs
from fidsplat.viewer.guard import guarded, refusal


@pytest.mark.parametrize(
    ("origin", "host", "listens", "words"),
    [
        (None, "localhost:8080", "127.0.0.1", ""),  # no browser
        ("http://localhost:8080", "localhost:8080", "127.0.0.1", ""),
        ("http://127.0.0.1:9", "127.0.0.1:9", "127.0.0.1", ""),  # a tunnel has a port of its own
        ("http://[::1]:8080", "[::1]:8080", "::1", ""),
        ("https://LOCALHOST", "localhost", "localhost", ""),
        ("http://evil.test", "localhost:8080", "127.0.0.1", "from another site"),
        ("http://localhost:3000", "localhost:8080", "127.0.0.1", "from another site"),
        ("null", "localhost:8080", "127.0.0.1", "from another site"),
        ("http://localhost:8080", None, "127.0.0.1", "from another site"),
        ("null", None, "127.0.0.1", "another name"),
        ("http://[x", "localhost:8080", "127.0.0.1", "valid address"),
        # a name of theirs that was made to point here
        ("http://evil.test:8080", "evil.test:8080", "127.0.0.1", "another name"),
        ("http://evil.test:8080", "evil.test:8080", "0.0.0.0", "another name"),
        ("http://10.0.0.7:8080", "10.0.0.7:8080", "127.0.0.1", "another name"),
        ("http://10.0.0.7:8080", "10.0.0.7:8080", "0.0.0.0", ""),
        ("http://lab.test:8080", "lab.test:8080", "lab.test", ""),
        (f"http://{socket.gethostname()}:1", f"{socket.gethostname()}:1", "0.0.0.0", ""),
    ],
)
def test_pages_of_others_are_refused(origin, host, listens, words):
    refused = refusal(origin, host, listens)
    assert words in refused
    assert bool(words) == bool(refused)


def test_a_server_that_is_not_guarded_is_stopped():
    pytest.importorskip("websockets", reason="the extra viewer is not installed")
    stopped = []
    with pytest.raises(fs.FidsplatError, match="cannot guard"):
        guarded(lambda: SimpleNamespace(stop=lambda: stopped.append(True)), "127.0.0.1")
    assert stopped == [True]


def test_a_port_in_use_is_reported():
    from fidsplat.viewer.server import check_port

    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(fs.InputError, match=rf"cannot listen on 127.0.0.1, port {port}: .*in use; give"):
            check_port("127.0.0.1", port)
    check_port("127.0.0.1", port)
    for none in (-1, 65536, 99999):
        with pytest.raises(
            fs.InputError, match=f"--port must be 1 to 65535, or 0 for any free port, got {none}"
        ):
            check_port("127.0.0.1", none)


def test_a_port_that_another_takes_meanwhile_is_reported(monkeypatch):
    """Between the check and viser, which would silently use the next port."""
    pytest.importorskip("viser", reason="the extra viewer is not installed")
    from fidsplat.viewer import server

    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        looks = []
        monkeypatch.setattr(server, "check_port", lambda *place: looks.append(place))
        with pytest.raises(fs.InputError, match=f"port {port}: it was in use; give another --port"):
            server.Viewer(
                fs.Scene(camera=fs.Camera.look_at(8, 8, 1.0, (0, 0, -1), (0, 0, 0))),
                None,
                "reference",
                port=port,
            )
        assert looks == [("127.0.0.1", port)] * 2


@pytest.mark.parametrize(
    ("host", "words"),
    [
        ("", "--host must be an address"),  # which would let the whole network in
        ("192.0.2.1", "--host must be an address of this machine"),
        ("a..b", "--host must be an address of this machine"),
    ],
)
def test_an_unknown_host_is_reported(host, words):
    from fidsplat.viewer.server import check_port

    with pytest.raises(fs.InputError, match=words):
        check_port(host, 0)


@pytest.mark.parametrize(
    ("host", "address"), [("127.0.0.1", "http://127.0.0.1:80"), ("::1", "http://[::1]:80")]
)
def test_the_address_can_be_opened(host, address):
    from fidsplat.viewer.server import Viewer

    server = SimpleNamespace(get_host=lambda: host, get_port=lambda: 80)
    assert Viewer.address.fget(SimpleNamespace(server=server)) == address
