"""Matrix files: what comes back is what was saved, and anything else is refused in one line."""

import errno
import json
import os
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zarr
from conftest import FORMS, altered, made_up

import mi_sparse_prt as prt
from mi_sparse_prt import transport as transport_module
from mi_sparse_prt.io import store
from mi_sparse_prt.transport import LightTransport

COMPRESSED = {"wavelets", "clusters"}


def assert_same(a: LightTransport, b: LightTransport) -> None:
    """Bit by bit, factors, order and report."""
    factors = [t.stored()[1] for t in (a, b)]
    assert factors[0].keys() == factors[1].keys()
    for name, array in factors[0].items():
        assert array.dtype == factors[1][name].dtype, name
        assert array.tobytes() == factors[1][name].tobytes(), name
        assert array.shape == factors[1][name].shape, name
    assert (a.basis, a.meshes, a.scene_hash) == (b.basis, b.meshes, b.scene_hash)
    assert a.lighting.resolution == b.lighting.resolution
    assert a.report == b.report


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> tuple[LightTransport, Path]:
    """A small matrix with all kinds of arrays, and its file."""
    transport = made_up("bits and coarse indirect", n=2, n_vertices=8)
    path = tmp_path_factory.mktemp("saved") / "scene.prt"
    transport.save(path)
    return transport, path


def rewritten(path: Path, target: Path, change) -> Path:
    """A copy of a file in which ``change(name, bytes)`` returns the members' new bytes, or None to drop one."""
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(target, "w") as copy:
        for name in source.namelist():
            content = change(name, source.read(name))
            if content is not None:
                copy.writestr(name, content)
    return target


def changed_attributes(**values: object):
    def change(name: str, content: bytes) -> bytes:
        if name != "zarr.json":
            return content
        group = json.loads(content)
        group["attributes"] |= values
        return json.dumps(group).encode()

    return change


# ------------------------------------------------------------------------------------ round trips


@pytest.mark.parametrize("form", FORMS)
def test_round_trip(tmp_path, form):
    transport = made_up(form)
    transport.save(tmp_path / "a.prt")
    loaded = prt.load_transport(tmp_path / "a.prt")
    assert_same(transport, loaded)
    assert np.array_equal(transport.rows([0, 7]), loaded.rows([0, 7]))
    assert np.array_equal(transport.relight([1, 2, 3]), loaded.relight([1, 2, 3]))
    assert [p.name for p in tmp_path.iterdir()] == ["a.prt"]


def test_several_chunks(tmp_path, monkeypatch):
    """More vertices than a chunk, and a last chunk that is not full."""
    monkeypatch.setattr(store, "_ROWS", 16)
    transport = made_up("fixed point and full indirect", n=1, n_vertices=50)
    transport.save(tmp_path / "a.prt")
    assert_same(transport, prt.load_transport(tmp_path / "a.prt"))


def test_a_dark_matrix(tmp_path):
    """Zeros are Zarr's fill value: such chunks must be written all the same, or a lost one would go unnoticed."""
    transport = made_up("bits")
    dark = altered(transport, direct=replace(transport.direct, bits=np.zeros_like(transport.direct.bits)))
    dark.save(tmp_path / "a.prt")
    assert_same(dark, prt.load_transport(tmp_path / "a.prt"))
    with zipfile.ZipFile(tmp_path / "a.prt") as file:
        assert any(name.startswith("direct.visibility/c/") for name in file.namelist())


def test_the_report_of_a_precomputation_comes_back(tmp_path, grey_scene):
    lighting = prt.CubemapLighting(2)
    transport = prt.precompute(grey_scene, lighting, method="brute_force", spp=2, progress=False)
    transport.save(tmp_path / "a.prt")
    loaded = prt.load_transport(tmp_path / "a.prt", grey_scene)
    assert_same(transport, loaded)
    assert loaded.report["seconds"]["total"] > 0
    assert json.loads(json.dumps(loaded.report)) == transport.report


def test_names_beyond_ascii(tmp_path):
    transport = made_up("bits")
    mesh = replace(transport.meshes[0], name="Häschen / 兎 #1")
    transport = altered(transport, meshes=(mesh, *transport.meshes[1:]))
    path = tmp_path / "Wörter mit Leerzeichen.prt"
    transport.save(path)
    assert_same(transport, prt.load_transport(str(path)))


# ------------------------------------------------------------------------------------ bad files


def refused(path: Path, match: str = "damaged") -> None:
    with pytest.raises(prt.PrtError, match=match) as error:
        prt.load_transport(path)
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)


def test_no_file(tmp_path):
    refused(tmp_path / "none.prt", "no such matrix file")
    refused(tmp_path, "no such matrix file")


@pytest.mark.parametrize("content", [b"", b"PK", b"not a zip", b"PK\x05\x06" + 18 * b"\0", 5000 * b"\xa7"])
def test_not_a_matrix(tmp_path, content):
    path = tmp_path / "a.prt"
    path.write_bytes(content)
    refused(path)


def test_another_zarr_file(tmp_path):
    path = tmp_path / "a.prt"
    store = zarr.storage.ZipStore(path, mode="w")
    zarr.create_group(store, attributes={"format": "something else"})
    store.close()
    refused(path)


def test_truncated_at_any_length(tmp_path, saved):
    content = saved[1].read_bytes()
    path = tmp_path / "a.prt"
    for length in [1, 10, *range(100, len(content), 97), len(content) - 1]:
        path.write_bytes(content[:length])
        refused(path)


@pytest.mark.filterwarnings("ignore::zarr.errors.ZarrUserWarning")
def test_a_flipped_byte_anywhere(tmp_path, saved):
    """150 random bytes, and a fifth of the zip's directory at the end, changed to a random other value.

    Expected: refused in one line, or it did not matter (a date, a unix mode): never another matrix, never another
    exception. At least one in two is refused: the data itself is protected.
    """
    transport, source = saved
    content = source.read_bytes()
    rng = np.random.default_rng(5)
    directory = content.index(b"PK\x01\x02")
    positions = np.concatenate(
        [rng.choice(len(content), 150, replace=False), np.arange(directory, len(content), 5)]
    )
    path = tmp_path / "a.prt"
    count = 0
    for position in positions:
        damaged = bytearray(content)
        damaged[position] ^= int(rng.integers(1, 256))
        path.write_bytes(damaged)
        try:
            loaded = prt.load_transport(path)
        except prt.PrtError as error:
            assert "\n" not in str(error)
            count += 1
        else:
            assert_same(transport, loaded)
    assert count > 0.5 * len(positions)


@pytest.mark.filterwarnings("ignore::zarr.errors.ZarrUserWarning")
def test_any_missing_member(tmp_path, saved):
    """Chunks and descriptions of arrays: without any one of them the file is refused."""
    with zipfile.ZipFile(saved[1]) as file:
        members = file.namelist()
    assert len(members) > 10
    for missing in members:
        path = rewritten(saved[1], tmp_path / "a.prt", lambda n, c, lost=missing: None if n == lost else c)
        refused(path)


def test_arrays_that_do_not_fit_together(tmp_path, saved):
    """Members of another matrix, with checksums that are right: 12 vertices among 8."""
    other = tmp_path / "other.prt"
    made_up("bits and coarse indirect", n=2, n_vertices=12).save(other)
    with zipfile.ZipFile(other) as file:
        strange = {name: file.read(name) for name in file.namelist()}
    members = ("direct.visibility", "direct.normals", "indirect.density")
    for array in ("reflection.albedo", "measurement.keys", *members):
        path = rewritten(
            saved[1], tmp_path / "a.prt", lambda n, c, a=array: strange[n] if n.startswith(a + "/") else c
        )
        refused(path)


@pytest.mark.parametrize(
    "attributes",
    [
        {"emission": {"kind": "cubemap", "resolution": 3}},
        {"emission": {"kind": "cubemap", "resolution": 4}},
        {"emission": {"kind": "moon"}},
        {"basis": "sphere"},
        {"measurement": {"kind": "vertices", "groups": [["a", 0]]}},
        {"reflection": {"kind": "velvet"}},
        {"operators": {"direct": "magic"}},
        {"version": None},
    ],
    ids=str,
)
def test_attributes_that_make_no_sense(tmp_path, saved, attributes):
    with pytest.raises(prt.PrtError) as error:
        prt.load_transport(rewritten(saved[1], tmp_path / "a.prt", changed_attributes(**attributes)))
    assert "\n" not in str(error.value)


def test_a_file_of_a_newer_version(tmp_path, saved):
    path = rewritten(saved[1], tmp_path / "a.prt", changed_attributes(version=transport_module.VERSION + 1))
    refused(path, "newer")
    untouched = rewritten(saved[1], tmp_path / "b.prt", changed_attributes())
    assert_same(saved[0], prt.load_transport(untouched))  # the tool above does no damage by itself


DATA = Path(__file__).parents[1] / "data"


@pytest.mark.parametrize("number", range(len(FORMS)))
def test_files_of_version_6(number):
    """Written by the code that wrote that version, of every form; what it computed from them is beside them."""
    loaded, known = prt.load_transport(DATA / f"version_6_{number}.prt"), np.load(DATA / "version_6.npz")
    np.testing.assert_allclose(loaded.rows(np.arange(24)), known[f"rows_{number}"], rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(loaded.relight(known["light"]), known[f"relit_{number}"], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(("name", "key"), [("glossy", "glossy"), ("glossy_clusters", "clusters")])
def test_glossy_files_of_version_6(name, key):
    loaded, known = prt.load_transport(DATA / f"version_6_{name}.prt"), np.load(DATA / "version_6.npz")
    found = loaded.coefficients(known["light"])
    np.testing.assert_allclose(found.unit_albedo, known[f"{key}_white"], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(found.terms, known[f"{key}_terms"], rtol=1e-4, atol=1e-5)
    if name == "glossy":
        towards = loaded.relight(known["light"], [0.1, 0.9, 0.3])
        np.testing.assert_allclose(towards, known["glossy_up"], rtol=1e-4, atol=1e-6)


def test_files_of_version_4(tmp_path):
    """They had no areas: all are alike then."""

    def without_areas(name: str, content: bytes) -> bytes | None:
        return None if name.startswith("areas/") else changed_attributes(version=4)(name, content)

    old = rewritten(DATA / "version_6_0.prt", tmp_path / "b.prt", without_areas)
    assert (prt.load_transport(old).measurement.areas == 1).all()


def test_labels_of_clusters_that_are_not_there(tmp_path):
    transport = made_up("clusters")
    clustered = transport.operators["compressed"]
    labels = clustered.labels.copy()
    labels[3] = len(clustered.means)
    replace(transport, operators={"compressed": replace(clustered, labels=labels)}).save(tmp_path / "a.prt")
    refused(tmp_path / "a.prt", "clusters")


@pytest.mark.parametrize("what", ["starts", "length", "order", "range"])
def test_lists_of_texels_that_make_no_sense(tmp_path, what):
    transport = made_up("shares")
    direct = transport.direct
    starts, texels, shares = direct.starts.copy(), direct.texels.copy(), direct.shares
    if what == "starts":
        starts[3] = starts[5]
    elif what == "length":
        shares = shares[:-1]
    elif what == "order":
        texels[[starts[1], starts[1] + 1]] = texels[[starts[1] + 1, starts[1]]]
    else:
        texels[starts[2] - 1] = 96
    damaged = replace(direct, starts=starts, texels=texels, shares=shares)
    altered(transport, direct=damaged).save(tmp_path / "a.prt")
    refused(tmp_path / "a.prt")


def test_no_texel_seen_in_part(tmp_path):
    """Lists of nothing."""
    transport = made_up("shares")
    direct = transport.direct
    starts = np.zeros_like(direct.starts)
    empty = replace(direct, starts=starts, texels=direct.texels[:0], shares=direct.shares[:0])
    transport = altered(transport, direct=empty)
    transport.save(tmp_path / "a.prt")
    assert_same(transport, prt.load_transport(tmp_path / "a.prt"))


def test_a_file_of_another_scene(saved, grey_scene):
    with pytest.raises(prt.PrtError, match="belongs to another scene"):
        prt.load_transport(saved[1], grey_scene)


# ------------------------------------------------------------------------------------ failing writes


def failing_write(error: BaseException):
    def write(path: Path, attributes: dict, arrays: dict) -> None:
        Path(path).write_bytes(b"half of it")
        raise error

    return write


@pytest.mark.parametrize(
    "error", [KeyboardInterrupt(), MemoryError(), ValueError("bug"), SystemExit(1)], ids=repr
)
def test_an_interrupted_save_leaves_nothing(tmp_path, monkeypatch, error):
    monkeypatch.setattr(store, "_write", failing_write(error))
    with pytest.raises(type(error)):
        made_up("bits").save(tmp_path / "a.prt")
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(store, "_write", failing_write(OSError(errno.ENOSPC, "No space left on device")))
    with pytest.raises(prt.PrtError, match="No space left") as error:
        made_up("bits").save(tmp_path / "a.prt")
    assert "\n" not in str(error.value)
    assert str(tmp_path / "a.prt") in str(error.value)
    assert list(tmp_path.iterdir()) == []


def test_an_existing_file_survives_a_failed_save(tmp_path, monkeypatch):
    path = tmp_path / "a.prt"
    first = made_up("bits")
    first.save(path)
    for error in (KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left on device")):
        with monkeypatch.context() as patch:
            patch.setattr(store, "_write", failing_write(error))
            with pytest.raises((KeyboardInterrupt, prt.PrtError)):
                made_up("fixed point").save(path)
    assert_same(first, prt.load_transport(path))
    assert list(tmp_path.iterdir()) == [path]
    second = made_up("fixed point")
    second.save(path)  # and a good save replaces it
    assert_same(second, prt.load_transport(path))


def test_interrupted_inside_zarr(tmp_path, monkeypatch):
    """The store is open and half written when the interrupt comes."""
    create = zarr.Group.create_array
    calls = []

    def interrupted(self: zarr.Group, name: str, **parameters: object) -> object:
        calls.append(name)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return create(self, name, **parameters)

    monkeypatch.setattr(zarr.Group, "create_array", interrupted)
    with pytest.raises(KeyboardInterrupt):
        made_up("bits").save(tmp_path / "a.prt")
    assert len(calls) == 3
    assert list(tmp_path.iterdir()) == []


def test_places_that_cannot_be_written(tmp_path):
    transport = made_up("bits")
    with pytest.raises(prt.PrtError, match="does not exist"):
        transport.save(tmp_path / "no" / "a.prt")
    with pytest.raises(prt.PrtError, match="folder"):
        transport.save(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(prt.PrtError):
        transport.save(tmp_path / "file" / "a.prt")


def test_the_umask_decides_who_may_read(tmp_path):
    """As with any file that a program writes, and not as `mkstemp` has it (the owner alone)."""
    old = os.umask(0o027)
    try:
        made_up("bits").save(tmp_path / "a.prt")
    finally:
        os.umask(old)
    assert (tmp_path / "a.prt").stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize("what", ["starts", "length", "order", "range", "channels"])
def test_wavelet_coefficients_that_make_no_sense(tmp_path, what):
    transport = made_up("wavelets")
    direct = transport.operators["compressed"]
    starts, places, values, scales = (
        x.copy() for x in (direct.starts, direct.places, direct.values, direct.scales)
    )
    if what == "starts":
        starts[3] = starts[5]
    elif what == "length":
        values = values[:-1]
    elif what == "order":
        places[[starts[1], starts[1] + 1]] = places[[starts[1] + 1, starts[1]]]
    elif what == "range":
        places[starts[2] - 1] = 96
    else:
        scales = scales[:, :1]
    damaged = replace(direct, starts=starts, places=places, values=values, scales=scales)
    replace(transport, operators={"compressed": damaged}).save(tmp_path / "a.prt")
    refused(tmp_path / "a.prt")


def test_one_line_of_error_is_all_that_is_said(tmp_path):
    """Rationale: chunks are read beside each other; those in flight when one was found damaged made Python complain
    of destroyed tasks as it ended.
    """
    path = tmp_path / "a.prt"
    store.write_store(path, {}, {"values": np.random.default_rng(0).random((200_000, 20), np.float32)})
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    code = (
        "import sys; from pathlib import Path; from mi_sparse_prt.io.store import DAMAGE, read_store\n"
        "try: read_store(Path(sys.argv[1]))\n"
        "except DAMAGE as error: print(error)"
    )
    found = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True)
    assert "Bad CRC-32" in found.stdout
    assert found.stderr == ""
