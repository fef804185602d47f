"""Pages that relight a scene: what is in them, and who may see them. How they look: test_browser.py."""

import base64
import http.client
import json
import re
import socket
import struct
import threading
import time
import zlib

import mitsuba as mi
import numpy as np
import pytest
from conftest import build, still_life
from numpy.testing import assert_allclose, assert_array_equal

import mi_sparse_prt as prt
from mi_sparse_prt.core.metrics import relative_l2
from mi_sparse_prt.emission.haar import haar_colours
from mi_sparse_prt.relighting.clusters import cluster_columns
from mi_sparse_prt.relighting.viewer import server as server_module
from mi_sparse_prt.relighting.viewer.archive import KINDS, packed
from mi_sparse_prt.relighting.viewer.export import _basis_arrays, expected_sizes, make_page
from mi_sparse_prt.relighting.viewer.page_scene import HEIGHT, draw_order, environment_words
from mi_sparse_prt.relighting.viewer.server import PageServer
from mi_sparse_prt.relighting.viewer.truncated_clusters import truncate_clusters

LIGHTING = prt.CubemapLighting(8)
ENVIRONMENT = prt.Environment(np.random.default_rng(3).random((16, 32, 3), np.float32) ** 3)


@pytest.fixture(scope="module")
def compressed(coloured_scene):
    transport = prt.precompute(
        coloured_scene, LIGHTING, method="brute_force", spp=4, max_depth=3, progress=False
    )
    return prt.compress(transport, clusters=6, bases=10, progress=False)


def unpacked(text: str) -> dict:
    """What the page reads of an archive, by its definition."""
    content = zlib.decompress(base64.b64decode(text))
    (length,) = struct.unpack("<I", content[:4])
    header, at = json.loads(content[4 : 4 + length]), 4 + length
    for about in header["arrays"]:
        kind = np.dtype(about["dtype"])
        planes = np.frombuffer(content, np.uint8, about["size"] * kind.itemsize, at)
        values = np.ascontiguousarray(planes.reshape(kind.itemsize, -1).T).view(kind).ravel()
        header[about["name"]] = np.cumsum(values, dtype=kind) if about["differences"] else values
        at += len(planes)
    assert at == len(content)
    return header


def in_page(page) -> dict:
    return unpacked(re.search(r'type="text/plain">([^<]*)<', page.text)[1])


@pytest.mark.parametrize("kind", KINDS)
def test_arrays_come_back_as_they_were(kind):
    rng = np.random.default_rng(0)
    values = rng.integers(0, 256, (13, 5 * np.dtype(kind).itemsize), np.uint8).view(kind)
    if kind.endswith("f4"):
        values = rng.normal(size=values.shape).astype(kind)
    differences = frozenset() if kind.endswith("f4") else frozenset({"values"})
    for kept in (frozenset(), differences):
        assert_array_equal(
            unpacked(packed({"a": [1, "x"]}, {"values": values}, kept))["values"], values.ravel()
        )


def test_all_coefficients_leave_rounding_alone(compressed):
    clusters = cluster_columns(compressed.operators["compressed"])
    light, order = np.ones(LIGHTING.n_directions, np.float32), np.arange(LIGHTING.n_directions)
    errors = {}
    wavelets = haar_colours(LIGHTING.project(ENVIRONMENT), np.sqrt(LIGHTING.solid_angles, dtype=np.float32))
    for kept in (1.0, 0.2, 0.02):
        found = truncate_clusters(clusters, kept, light, order)
        decoded = found.decoded()
        assert len(found.values) <= kept * clusters.columns.size + 1
        errors[kept] = relative_l2(rows(decoded, wavelets), rows(clusters, wavelets))
    assert errors[1.0] < 0.01 < errors[0.02]
    assert errors[1.0] < errors[0.2] < errors[0.02]


def rows(clusters, wavelets):
    """Light (n, 3) of rows, by cluster: both steps, written out."""
    of = np.repeat(np.arange(len(clusters.starts) - 1), np.diff(clusters.starts))
    values = (wavelets.T @ clusters.columns).reshape(
        3, len(clusters.starts) - 1, -1
    )  # [rgb, cluster, vector]
    channels = len(clusters.weights)
    return np.stack(
        [
            values[c, of, 0] + np.einsum("bn,nb->n", clusters.weights[c % channels], values[c, of, 1:])
            for c in range(3)
        ],
        axis=1,
    )


def test_a_page_has_what_it_plays(coloured_scene, compressed):
    page = make_page(coloured_scene, compressed, {"noise": ENVIRONMENT}, kept=0.3, title="<still> life")
    found = in_page(page)
    assert "<title>&lt;still&gt; life</title>" in page.text
    head = page.text.split('id="data"')[0].replace('href="data:,"', "")  # no icon is asked for
    assert not re.search(r"(src|href)=|https?://", head)  # nothing from a network
    n = coloured_scene.n_vertices
    positions = found["positions"].reshape(-1, 3) / 65535 * found["extent"] + found["low"]
    order = draw_order(coloured_scene).order
    assert_array_equal(np.sort(order), np.arange(n))
    assert_allclose(positions, coloured_scene.positions[order], atol=2e-5 * np.max(found["extent"]))
    assert_allclose(found["albedo"].reshape(-1, 3) / 65535, coloured_scene.albedo[order], atol=1e-5)
    mesh = coloured_scene.meshes[1]
    own = found["meshes"][1]
    triangles = found["triangles"][own["first"] : own["first"] + own["count"]].reshape(-1, 3)
    assert sorted(map(tuple, order[triangles])) == sorted(map(tuple, mesh.triangles + mesh.vertices.start))
    assert_array_equal(found["labels"], compressed.operators["compressed"].labels[order])
    assert found["weights"].shape == (found["channels"] * found["vectors"] * n,)
    assert_same_columns(found, page.clusters)


def test_a_page_turns_light_about_what_its_camera_calls_up(coloured_scene, compressed):
    for up, axis in (([0, 1, 0], "y"), ([0, 0, 1], "z")):
        towards = mi.ScalarTransform4f().look_at(origin=[3, 3, 3], target=[0, 0, 0], up=up)
        sensor = mi.load_dict({"type": "perspective", "to_world": towards})
        page = make_page(coloured_scene, compressed, {"noise": ENVIRONMENT}, kept=0.3, sensor=sensor)
        assert in_page(page)["axis"] == axis


def assert_same_columns(found, clusters):
    """Lists of wavelets with their gaps, read as the page reads them."""
    columns, gap = np.zeros_like(clusters.columns), 0
    for column, scale in enumerate(found["scales"]):
        place = -1
        for at in range(found["starts"][column], found["starts"][column + 1]):
            while found["gaps"][gap] == 255:
                place, gap = place + 255, gap + 1
            place, gap = place + int(found["gaps"][gap]) + 1, gap + 1
            root = found["values"][at] / 127
            columns[found["order"][place], column] = root * abs(root) * scale
    assert gap == len(found["gaps"])
    assert_allclose(columns, clusters.columns, rtol=1e-5)


def test_gaps_longer_than_a_byte(compressed):
    clusters, m = cluster_columns(compressed.operators["compressed"]), LIGHTING.n_directions
    light = np.where(np.arange(m) % 290 == 3, 1.0, 1e-9).astype(np.float32)  # wavelets 3 and 293 alone matter
    truncated = truncate_clusters(clusters, 2 / m, light, np.arange(m))
    found = _basis_arrays(truncated)
    assert (found["gaps"] == 255).any()
    assert_same_columns(found, truncated.decoded())


def shared_exponents(words: np.ndarray) -> np.ndarray:
    """RGB of OpenGL's RGB9_E5, by its specification."""
    scale = 2.0 ** ((words >> 27).astype(int) - 24)
    return np.stack([(words >> (9 * c) & 511) * scale for c in range(3)], axis=-1)


@pytest.mark.parametrize("rotation", [None, 33.0])
def test_environments_keep_their_power(rotation):
    rng = np.random.default_rng(1)
    pixels = rng.random((90, 180, 3), np.float32) ** 20 * 3000
    environment = prt.Environment(pixels) if rotation is None else prt.Environment(pixels).rotated(rotation)
    found = prt.Environment(shared_exponents(environment_words(environment)).reshape(HEIGHT, 2 * HEIGHT, 3))
    power = [np.einsum("hwc,hw->c", e.pixels, e.solid_angles) for e in (environment, found)]
    assert_allclose(power[1], power[0], rtol=0.005 if rotation is None else 0.05)
    lighting = prt.CubemapLighting(4)
    assert relative_l2(lighting.project(found), lighting.project(environment)) < (
        0.02 if rotation is None else 0.1
    )


def test_expected_sizes_fall_from_coarse_to_fine():
    smooth = prt.Environment(np.broadcast_to(np.linspace(0, 1, 32)[:, None, None], (32, 64, 3)))
    sizes = expected_sizes({"smooth": smooth}, LIGHTING)
    assert np.all(np.diff(np.unique(sizes)) > 0) and sizes[0] == sizes.max() and sizes[-1] == sizes.min()


def test_black_environments_have_pages(coloured_scene, compressed):
    dark = prt.Environment(np.zeros((8, 16, 3), np.float32))
    assert np.isfinite(expected_sizes({"dark": dark}, LIGHTING)).all()
    mixed = expected_sizes({"dark": dark, "noise": ENVIRONMENT}, LIGHTING)
    assert_allclose(mixed, expected_sizes({"noise": ENVIRONMENT}, LIGHTING))
    page = make_page(coloured_scene, compressed, {"dark": dark}, kept=0.3)
    assert np.isfinite(page.clusters.columns).all() and page.clusters.columns.any()


def test_bad_input_is_told_in_a_line(coloured_scene, compressed):
    light = {"noise": ENVIRONMENT}
    with pytest.raises(prt.PrtError, match="at least one environment"):
        make_page(coloured_scene, compressed, {})
    with pytest.raises(prt.PrtError, match="above 0 and up to 1"):
        make_page(coloured_scene, compressed, light, kept=0)
    with pytest.raises(prt.PrtError, match="another scene|other scene|not the scene|belongs"):
        make_page(build(ball=still_life()["ball"]), compressed, light)
    whole = prt.precompute(
        coloured_scene, prt.CubemapLighting(2), method="brute_force", spp=1, progress=False
    )
    with pytest.raises(prt.PrtError, match="compress the matrix first"):
        make_page(coloured_scene, whole, light)


# --- who may see it


@pytest.fixture
def server():
    with PageServer(b"<p>page</p>") as serving:
        threading.Thread(target=serving.serve_forever, daemon=True).start()
        yield serving
        serving.shutdown()


def asked(server, path=None, method="GET", **headers):
    port = server.server_address[1]
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    path = server.url.split(str(port))[1] if path is None else path
    connection.request(method, path, headers={"Host": f"127.0.0.1:{port}"} | headers)
    answer = connection.getresponse()
    return answer.status, answer.read()


def test_the_page_is_for_those_who_know_its_address(server):
    port = server.server_address[1]
    assert server.server_address[0] == "127.0.0.1"
    assert asked(server) == (200, b"<p>page</p>")
    assert asked(server, Host=f"localhost:{port}", Origin=f"http://localhost:{port}")[0] == 200
    assert asked(server, method="HEAD") == (200, b"")
    for path in ("/", "/token/", "/../etc/passwd", server.url.split(str(port))[1] + "../../etc/passwd"):
        assert asked(server, path)[0] == 404
    for headers in (
        {"Host": "evil.example"},
        {"Host": f"evil.example:{port}"},
        {"Origin": "http://evil.example"},
    ):
        assert asked(server, **headers)[0] == 403
    assert asked(server, method="POST")[0] == 404
    assert asked(server, method="PUT")[0] == 501


@pytest.fixture
def answering():
    """A server whose answers are the questions, and that is told what was asked."""
    heard = []

    def answer(question, content):
        heard.append((question, content))
        return question | {"length": len(content)}, content[::-1]

    with PageServer(b"<p>page</p>", 0, answer) as serving:
        threading.Thread(target=serving.serve_forever, daemon=True).start()
        yield serving, heard
        serving.shutdown()


def posted(server, body, path=None, **headers):
    port = server.server_address[1]
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    path = server.url.split(str(port))[1] + "ask" if path is None else path
    connection.request("POST", path, body, headers={"Host": f"127.0.0.1:{port}"} | headers)
    answer = connection.getresponse()
    return answer.status, answer.read()


def question(header: dict, content: bytes = b"") -> bytes:
    words = json.dumps(header).encode()
    return struct.pack("<I", len(words)) + words + content


def test_questions_are_answered(answering):
    server, heard = answering
    status, found = posted(server, question({"ask": "row"}, b"abc"))
    assert (status, found) == (200, question({"ask": "row", "length": 3}, b"cba"))
    assert heard == [({"ask": "row"}, b"abc")]
    for body in (b"", b"ab", struct.pack("<I", 99) + b"{}", struct.pack("<I", 2) + b"{]", question(3)):
        status, found = posted(server, body)
        assert status == 200 and b'"error": "this is no question of a page"' in found
    assert len(heard) == 1


def test_questions_are_for_those_who_know_the_address(answering):
    server, heard = answering
    port, asks = server.server_address[1], question({"ask": "row"})
    for path in ("/", "/ask", "/token/ask", server.url.split(str(port))[1]):
        assert posted(server, asks, path)[0] == 404
    for headers in ({"Host": "evil.example"}, {"Origin": "http://evil.example"}, {"Origin": "null"}):
        assert posted(server, asks, **headers)[0] == 403
    for length in ("-1", "1e3", str(1 << 40)):
        assert posted(server, asks, **{"Content-Length": length})[0] == 400
    assert heard == []


def test_one_that_stops_reading_holds_nobody_up(answering, monkeypatch):
    """A browser that asks and never reads, and one that never sends what it said; others are answered meanwhile."""
    server, heard = answering
    monkeypatch.setattr(server_module._Answer, "timeout", 0.5)
    port = server.server_address[1]
    path = server.url.split(str(port))[1] + "ask"
    head = f"POST {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nContent-Length: {{}}\r\n\r\n"
    large = question({}, bytes(1 << 25))
    silent = socket.create_connection(("127.0.0.1", port))
    silent.sendall(head.format(1000).encode())
    deaf = socket.create_connection(("127.0.0.1", port))
    deaf.sendall(head.format(len(large)).encode() + large)
    start = time.monotonic()
    assert posted(server, question({"ask": "row"}))[0] == 200
    assert time.monotonic() - start < 5
    time.sleep(1.5)  # both are given up
    waiting = [t for t in threading.enumerate() if "process_request_thread" in t.name]
    silent.close()
    deaf.close()
    assert waiting == []
    assert len(heard) == 2


def test_a_port_that_is_taken(server):
    with pytest.raises(prt.PrtError, match="in use.*--port"):
        PageServer(b"", server.server_address[1])
    with pytest.raises(prt.PrtError, match="--port"):
        PageServer(b"", 1 << 17)
