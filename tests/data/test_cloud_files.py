"""Clouds by other programs: PLY, PCD, NPY and text become points in metres."""

import os
import pickle
import struct
from pathlib import Path

import numpy as np
import pytest
from tests.mutations import mutate_folder

from pnet.data.cloud_files import check_cloud, read_cloud

MUTATIONS = int(os.environ.get("PNET_MUTATIONS", "200"))
POINTS = [(0.5, -0.25, 0.75), (0.125, 0.0, 1.5), (-1.0, 2.0, 0.625)]  # exact in float32
NAN = float("nan")


def header(order, elements):
    """A PLY header; elements: (name, count, [property …])."""
    lines = ["ply", f"format {order} 1.0", "comment by hand"]
    for name, count, properties in elements:
        lines += [f"element {name} {count}", *(f"property {one}" for one in properties)]
    return ("\n".join([*lines, "end_header"]) + "\n").encode()


XYZ = ["float x", "float y", "float z"]
ORDERS = [("<", "binary_little_endian"), (">", "binary_big_endian")]


def plain_ply(sign, order):
    body = b"".join(struct.pack(f"{sign}3f", *point) for point in POINTS)
    return header(order, [("vertex", 3, XYZ)]) + body


def check(path, expected=POINTS, missing=0, **arguments):
    found = read_cloud(path, **arguments)
    assert found.points.dtype == np.float32
    np.testing.assert_array_equal(found.points, np.array(expected, np.float32))
    assert found.missing == missing


@pytest.mark.parametrize(("sign", "order"), ORDERS)
def test_a_binary_ply_file_of_either_byte_order_is_read(tmp_path, sign, order):
    (tmp_path / "a.ply").write_bytes(plain_ply(sign, order))
    check(tmp_path / "a.ply")


@pytest.mark.parametrize(("sign", "order"), ORDERS)
def test_other_properties_and_elements_of_a_binary_ply_file_are_passed_over(tmp_path, sign, order):
    """Before the vertices: polygons, and a table without lists; behind the coordinates: more."""
    face = b"".join(struct.pack(f"{sign}B{n}i", n, *range(n)) for n in (3, 4, 0))
    camera = struct.pack(f"{sign}hd", 7, 0.5)
    vertex = b"".join(struct.pack(f"{sign}BdfHf", 9, z, y, 8, x) for x, y, z in POINTS)
    elements = [
        ("face", 3, ["list uchar int vertex_indices"]),
        ("camera", 1, ["short id", "double focus"]),
        ("vertex", 3, ["uchar red", "float64 z", "float y", "ushort label", "float32 x"]),
        ("edge", 1, ["list int8 uint16 ends"]),
    ]
    (tmp_path / "a.ply").write_bytes(header(order, elements) + face + camera + vertex + b"\x01\x01\x02")
    check(tmp_path / "a.ply")


@pytest.mark.parametrize(("sign", "order"), ORDERS)
def test_vertices_with_lists_are_read(tmp_path, sign, order):
    rows = [(1,), (), (4, 5, 6)]
    body = b"".join(
        struct.pack(f"{sign}fB{len(row)}hff", x, len(row), *row, y, z)
        for row, (x, y, z) in zip(rows, POINTS, strict=True)
    )
    properties = ["float x", "list uchar short seen_by", "float y", "float z"]
    whole = header(order, [("vertex", 3, properties)]) + body
    (tmp_path / "a.ply").write_bytes(whole)
    check(tmp_path / "a.ply")
    for cut in range(1, len(body)):
        (tmp_path / "a.ply").write_bytes(whole[:-cut])
        with pytest.raises(ValueError, match=r"(file|it) is cut off"):
            read_cloud(tmp_path / "a.ply")


def test_a_text_ply_file_is_read_with_what_surrounds_the_vertices(tmp_path):
    elements = [
        ("face", 2, ["list uchar int vertex_indices"]),
        ("vertex", 3, ["uchar red", "float z", "float x", "float y", "list uchar int seen_by"]),
        ("edge", 1, ["int a"]),
    ]
    rows = [f"255 {z} {x}\t{y} {n} {'7 ' * n}" for n, (x, y, z) in enumerate(POINTS)]
    text = "\n".join(["3 0 1 2", "4 0 1 2 3", "", *rows, "5"]) + "\n"
    content = header("ascii", elements) + text.encode()
    (tmp_path / "a.ply").write_bytes(content)
    check(tmp_path / "a.ply")
    (tmp_path / "b.ply").write_bytes(content.replace(b"\n", b"\r\n"))
    check(tmp_path / "b.ply")


def test_a_binary_ply_file_may_have_a_header_from_windows(tmp_path):
    body = b"".join(struct.pack("<3f", *point) for point in POINTS)
    (tmp_path / "a.ply").write_bytes(
        header(ORDERS[0][1], [("vertex", 3, XYZ)]).replace(b"\n", b"\r\n") + body
    )
    check(tmp_path / "a.ply")


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_ply_files_of_another_program_are_read(tmp_path, encoding):
    trimesh = pytest.importorskip("trimesh")
    mesh = trimesh.creation.box((1, 2, 4))
    mesh.export(tmp_path / "a.ply", encoding=encoding)
    check(tmp_path / "a.ply", mesh.vertices)


BAD_PLY = {
    "no ply": (b"solid x\n", "does not begin with the line ply"),
    "one line": (b"ply", "does not begin with the line ply"),
    "no end": (b"ply\nformat ascii 1.0\n", "the header has no end_header"),
    "no format": (b"ply\nelement vertex 1\nend_header\n", "line 'end_header' is not understood"),
    "version": (b"ply\nformat ascii 2.0\n", "line 'format ascii 2.0' is not understood"),
    "no vertices": (header("ascii", [("face", 0, [])]), "names no element vertex"),
    "no z": (header("ascii", [("vertex", 1, ["float x", "int y"])]) + b"1 2\n", "lack the property z"),
    "type": (header("ascii", [("vertex", 1, ["half x"])]), "property 'x' is of an unknown type .half."),
    "list of": (header("ascii", [("vertex", 1, ["list float int x"])]), "unknown type .list float int."),
    "count": (header("ascii", [("vertex", -1, XYZ)]), "count of 'vertex' is '-1', expected a whole number"),
    "few rows": (header("ascii", [("vertex", 3, XYZ)]) + b"1 2 3\n4 5 6\n", "claims 3 vertices, holds 2"),
    "few columns": (header("ascii", [("vertex", 1, XYZ)]) + b"1 2\n", "a point is not readable"),
    "a word": (header("ascii", [("vertex", 1, XYZ)]) + b"1 2 x\n", "a point is not readable .*'x'"),
    "a list first": (
        header("ascii", [("vertex", 1, ["list uchar int a", *XYZ])]) + b"0 1 2 3\n",
        "a list before their coordinates",
    ),
    "cut off": (plain_ply("<", ORDERS[0][1])[:-1], "claims 3 records of 12 bytes or more, but only 35 bytes"),
    "huge": (header(ORDERS[0][1], [("vertex", 10**12, XYZ)]) + bytes(36), "claims 1,000,000,000,000 records"),
    "huge text": (header("ascii", [("vertex", 10**12, XYZ)]) + b"1 2 3\n", "claims 1,000,000,000,000 rec"),
    "huge before": (
        header("binary_big_endian", [("face", 10**15, ["list uchar int i"]), ("vertex", 1, XYZ)]) + bytes(36),
        "claims 1,000,000,000,000,000 records",
    ),
    "list too long": (
        header(ORDERS[0][1], [("face", 1, ["list uint int i"]), ("vertex", 1, XYZ)])
        + struct.pack("<I", 2**32 - 1)
        + bytes(12),
        "ends within the rows of 'face'",
    ),
    "list below 0": (
        header(ORDERS[0][1], [("face", 1, ["list char int i"]), ("vertex", 1, XYZ)]) + b"\xff" + bytes(12),
        "a list 'i' has the length -1",
    ),
}


@pytest.mark.parametrize("case", BAD_PLY)
def test_a_damaged_ply_file_is_an_error_that_says_what_is_wrong(tmp_path, case):
    content, message = BAD_PLY[case]
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(ValueError, match=message) as fault:
        read_cloud(tmp_path / "a.ply")
    assert str(fault.value).startswith(str(tmp_path / "a.ply"))


def pcd(encoding, body, fields="x y z", size="4 4 4", kind="F F F", count="1 1 1", width=3, height=1, n=None):
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {fields}",
        f"SIZE {size}",
        f"TYPE {kind}",
        f"COUNT {count}",
        f"WIDTH {width}",
        f"HEIGHT {height}",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {width * height if n is None else n}",
        f"DATA {encoding}",
    ]
    return ("\n".join(lines) + "\n").encode() + body


EXTRA = {"fields": "_ z rgb x y", "size": "1 8 4 4 4", "kind": "U F F F F", "count": "3 1 1 1 1"}


def stored(data):
    """LZF without compression: runs of up to 32 bytes behind their length less one."""
    return b"".join(bytes([len(data[i : i + 32]) - 1]) + data[i : i + 32] for i in range(0, len(data), 32))


def compressed(data):
    return struct.pack("<II", len(stored(data)), len(data)) + stored(data)


def columns(*values):
    return b"".join(np.array(column, dtype).tobytes() for column, dtype in values)


X, Y, Z = np.array(POINTS).T
PLAIN_COLUMNS = columns((X, "<f4"), (Y, "<f4"), (Z, "<f4"))
PCD = {
    "text": pcd("ascii", "\n".join(f"{x} {y} {z}" for x, y, z in POINTS).encode()),
    "text with more": pcd(
        "ascii", "".join(f"1 2 3 {z}  9\t{x} {y}\r\n" for x, y, z in POINTS).encode(), **EXTRA
    ),
    "binary": pcd("binary", b"".join(struct.pack("<3f", *point) for point in POINTS)),
    "binary with more": pcd(
        "binary", b"".join(struct.pack("<3sdfff", b"abc", z, 1, x, y) for x, y, z in POINTS) + b"xx", **EXTRA
    ),
    "compressed": pcd("binary_compressed", compressed(PLAIN_COLUMNS), width=1, height=3),
    "compressed with more": pcd(
        "binary_compressed",
        compressed(columns(([1] * 9, "u1"), (Z, "<f8"), ([9] * 3, "<f4"), (X, "<f4"), (Y, "<f4"))),
        **EXTRA,
    ),
    "no count": pcd("binary", PLAIN_COLUMNS).replace(b"COUNT 1 1 1\n", b"")[:-36]
    + b"".join(struct.pack("<3f", *point) for point in POINTS),
}


def need_lzf(case):
    if "compressed" in case:
        pytest.importorskip("lzf")


@pytest.mark.parametrize("case", PCD)
def test_every_form_of_a_pcd_file_is_read(tmp_path, case):
    need_lzf(case)
    (tmp_path / "a.pcd").write_bytes(PCD[case])
    check(tmp_path / "a.pcd")


def test_integer_fields_of_a_pcd_file_are_numbers(tmp_path):
    body = struct.pack("<hbI", -500, 7, 650)
    (tmp_path / "a.pcd").write_bytes(
        pcd("binary", body, size="2 1 4", kind="I I U", width=1),
    )
    check(tmp_path / "a.pcd", [(-0.5, 0.007, 0.65)], unit="mm")


@pytest.mark.parametrize("encoding", ["ASCII", "BINARY", "BINARY_COMPRESSED"])
def test_pcd_files_of_another_program_are_read(tmp_path, encoding):
    pypcd4 = pytest.importorskip("pypcd4")
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3)).round(2).astype(np.float32)
    points[100:300] = points[:200]  # what comes again is compressed
    cloud = pypcd4.PointCloud.from_xyzi_points(np.column_stack([points, np.ones(500, np.float32)]))
    cloud.save(tmp_path / "a.pcd", encoding=pypcd4.Encoding[encoding])
    check(tmp_path / "a.pcd", points)


BAD_PCD = {
    "no header": (b"hello\n", "line 'hello' is not understood"),
    "no data": (b"VERSION 0.7\n", "no PCD file: its header has no line DATA"),
    "no fields": (b"DATA ascii\n", "the header lacks FIELDS"),
    "unequal": (pcd("binary", b"", size="4 4"), "unequal lengths"),
    "type": (pcd("binary", b"", kind="F F C"), "TYPE C with SIZE 4 is unknown"),
    "size": (pcd("binary", b"", size="4 4 3"), "TYPE F with SIZE 3 is unknown"),
    "no z": (pcd("binary", b"", fields="x y w"), "lack the field z"),
    "count": (pcd("binary", b"", count="1 1 2"), "COUNT of x, y and z must be 1"),
    "encoding": (pcd("zip", b""), "DATA is 'zip', expected ascii"),
    "twice": (b"VERSION .7\n" + pcd("binary", b""), "line 'VERSION 0.7' is not understood"),
    "points": (pcd("binary", bytes(36), n=4), "POINTS is 4, WIDTH times HEIGHT 3"),
    "negative": (pcd("binary", bytes(36), width=-3), "WIDTH is '-3', expected a whole number"),
    "cut off": (PCD["binary"][:-1], "claims 3 records of 12 bytes or more, but only 35 bytes are left"),
    "huge": (pcd("binary", bytes(36), width=10**12), "claims 1,000,000,000,000 records"),
    "huge text": (pcd("ascii", b"1 2 3\n", width=10**12), "claims 1,000,000,000,000 records"),
    "huge count": (
        pcd("ascii", b"1 2 3", "a x y z", "4 4 4 4", "F F F F", "9999990 1 1 1"),
        "column 9,999,992",
    ),
    "few rows": (pcd("ascii", b"1 2 3\n4 5 6\n"), "claims 3 points, holds 2"),
    "compressed huge": (
        pcd("binary_compressed", struct.pack("<II", 36, 2**32 - 4) + bytes(36), width=357_913_941),
        "36 bytes are said to hold 4,294,967,292",
    ),
    "compressed other size": (
        pcd("binary_compressed", struct.pack("<II", 37, 35) + bytes(37)),
        "37 bytes are said to hold 35, 3 points need 36",
    ),
    "compressed cut off": (PCD["compressed"][:-1], "but only 37 bytes are left"),
    "compressed without sizes": (pcd("binary_compressed", b"1234"), "but only 4 bytes are left"),
    "compressed damaged": (
        pcd("binary_compressed", struct.pack("<II", 3, 36) + b"\xff\xff\xff"),
        "the compressed points are damaged",
    ),
    "compressed too few": (
        pcd("binary_compressed", struct.pack("<II", 3, 36) + b"\x01ab"),
        "the compressed points are damaged",
    ),
}


@pytest.mark.parametrize("case", BAD_PCD)
def test_a_damaged_pcd_file_is_an_error_that_says_what_is_wrong(tmp_path, case):
    need_lzf(case)
    content, message = BAD_PCD[case]
    (tmp_path / "a.pcd").write_bytes(content)
    with pytest.raises(ValueError, match=message) as fault:
        read_cloud(tmp_path / "a.pcd")
    assert str(fault.value).startswith(str(tmp_path / "a.pcd"))


def test_compressed_clouds_need_a_package_that_the_error_names(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "lzf", None)
    (tmp_path / "a.pcd").write_bytes(PCD["compressed"])
    with pytest.raises(ModuleNotFoundError, match=r'pip install "pnet\[formats\]"$'):
        read_cloud(tmp_path / "a.pcd")


@pytest.mark.parametrize("dtype", ["<f4", ">f8", "<f2"])
@pytest.mark.parametrize("shape", ["rows", "more columns", "image"])
def test_arrays_are_read(tmp_path, dtype, shape):
    array = np.array(POINTS, dtype)
    array = {
        "rows": array,
        "more columns": np.column_stack([array, np.ones((3, 4), dtype)]),
        "image": array.reshape(1, 3, 3),
    }[shape]
    np.save(tmp_path / "a.npy", array)
    check(tmp_path / "a.npy")


@pytest.mark.parametrize(
    "array",
    [np.zeros(3), np.zeros((5, 2)), np.zeros((3, 17)), np.zeros((2, 2, 4)), np.zeros((1, 3), complex)],
    ids=["vector", "two columns", "transposed", "image of 4", "complex"],
)
def test_arrays_of_another_shape_are_an_error_that_gives_it(tmp_path, array):
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(
        ValueError, match=r"a\.npy: holds \(.*expected numbers \(n, 3 to 16\) or \(height, wi"
    ):
        read_cloud(tmp_path / "a.npy")


def test_an_array_that_claims_more_than_it_has_costs_nothing(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((3, 3)))
    content = (tmp_path / "a.npy").read_bytes()
    assert content.count(b"(3, 3)") == 1
    (tmp_path / "a.npy").write_bytes(content.replace(b"(3, 3), }          ", b"(300000000000, 3), }"))
    with pytest.raises(ValueError, match=r"a\.npy: not readable as an array"):
        read_cloud(tmp_path / "a.npy")


class Trap:
    """Makes a folder when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def test_pickled_objects_are_refused_and_not_run(tmp_path):
    trap = Trap(tmp_path / "sprung")
    (tmp_path / "a.npy").write_bytes(pickle.dumps(trap))
    np.save(tmp_path / "b.npy", np.array([[trap, None, None]], object), allow_pickle=True)
    for name in ("a.npy", "b.npy"):
        with pytest.raises(ValueError, match="not readable as an array"):
            read_cloud(tmp_path / name)
    assert not trap.path.exists()
    pickle.loads((tmp_path / "a.npy").read_bytes())
    assert trap.path.exists()  # it is one


@pytest.mark.parametrize("name", ["a.xyz", "a.txt", "A.XYZ"])
@pytest.mark.parametrize("separator", [" ", ", ", ",", ";", "\t"])
def test_text_is_read_with_any_separator(tmp_path, name, separator):
    lines = ["# x y z", "//X Y Z R", "", *(separator.join(map(str, point)) for point in POINTS)]
    lines[-1] += separator + separator.join(["255", "1e3"]) + " # the last"
    (tmp_path / name).write_text("\n".join(lines))
    check(tmp_path / name)


def test_comments_may_be_in_any_encoding(tmp_path):
    rows = "\r\n".join(" ".join(map(str, point)) for point in POINTS).encode()
    (tmp_path / "a.xyz").write_bytes(b"\xef\xbb\xbf# Gr\xf6\xdfe\n" + rows)
    check(tmp_path / "a.xyz")


@pytest.mark.parametrize("content", ["1 2\n", "1 2 x\n", "x y z\n1 2 3\n", "1 2 3\n4,5\n", "1,,2,3,\nx"])
def test_text_that_is_no_numbers_is_an_error(tmp_path, content):
    (tmp_path / "a.txt").write_text(content)
    with pytest.raises(ValueError, match=r"a\.txt: a point is not readable .*, expected x y z"):
        read_cloud(tmp_path / "a.txt")


@pytest.mark.parametrize(("unit", "factor"), [("m", 1), ("cm", 0.01), ("mm", 0.001)])
def test_the_unit_becomes_metres(tmp_path, unit, factor):
    np.save(tmp_path / "a.npy", np.array(POINTS) * 1000)
    found = read_cloud(tmp_path / "a.npy", unit)
    np.testing.assert_allclose(found.points, np.array(POINTS) * 1000 * factor, rtol=1e-7)


def test_points_that_were_not_measured_are_left_out_and_counted(tmp_path):
    rows = [POINTS[0], (NAN, 0, 1), (0, 0, 0), POINTS[1], (0, float("-inf"), 1), (1e300, 0, 1), POINTS[2]]
    np.save(tmp_path / "a.npy", np.array(rows))
    check(tmp_path / "a.npy", missing=4)
    (tmp_path / "a.txt").write_text("\n".join(" ".join(map(str, row)) for row in rows))
    check(tmp_path / "a.txt", missing=4)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.txt", b"0 0 0\nnan 1 1\n", r"a\.txt: has no finite point .2 in all."),
        ("a.txt", b"# nothing\n", r"a\.txt: has no finite point .0 in all."),
        ("a.pcd", pcd("binary", b"", width=0), "has no finite point .0 in all."),
        ("a.ply", header(ORDERS[1][1], [("vertex", 0, XYZ)]), "has no finite point .0 in all."),
        ("a.ply", b"", r"a\.ply: has 0 bytes"),
        ("a.las", b"x", r"a\.las: ends in \.las, expected one of \.ply, \.pcd, \.npy, \.xyz, \.txt"),
    ],
)
def test_a_cloud_without_points_is_an_error_that_names_the_file(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message):
        read_cloud(tmp_path / name)


def test_a_compressed_cloud_without_points_is_an_error_that_names_the_file(tmp_path):
    pytest.importorskip("lzf")
    (tmp_path / "a.pcd").write_bytes(pcd("binary_compressed", bytes(8), width=0))
    with pytest.raises(ValueError, match=r"has no finite point \(0 in all\)"):
        read_cloud(tmp_path / "a.pcd")


def test_a_missing_file_and_an_unknown_unit_are_errors(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"a\.ply: no such cloud file"):
        read_cloud(tmp_path / "a.ply")
    with pytest.raises(ValueError, match="unit is 'inch', expected one of m, cm, mm"):
        read_cloud(tmp_path / "a.ply", "inch")


@pytest.mark.parametrize(
    ("z", "message"),
    [
        ([-0.5, -0.6, 0.7], r"most points lie behind the camera .z from -0.6 to 0.7 m."),
        ([600, 700, 0.7], "median depth is 600 m, expected 0.001 to 50 m; set cloud.unit="),
        ([0.0006, 0.0007, 0.7], "median depth is 0.0007 m"),
    ],
)
def test_unlikely_points_are_an_error_that_names_the_remedy(z, message):
    points = np.column_stack([np.zeros((3, 2)), z])
    with pytest.raises(ValueError, match=message):
        check_cloud(points, Path("a.ply"))
    check_cloud(np.abs(points[[2, 2]]), Path("a.ply"))


def write_all(folder):
    rng = np.random.default_rng(0)
    np.save(folder / "a.npy", np.array(POINTS))
    (folder / "a.xyz").write_text("# a\n" + "\n".join(",".join(map(str, row)) for row in rng.random((9, 4))))
    (folder / "big.ply").write_bytes(plain_ply(*ORDERS[1]))
    face = struct.pack("<B3i", 3, 0, 1, 2)
    vertex = b"".join(struct.pack("<3fB2h", *point, 2, 3, 4) for point in POINTS)
    elements = [
        ("face", 1, ["list uchar int vertex_indices"]),
        ("vertex", 3, [*XYZ, "list uchar short seen"]),
    ]
    (folder / "lists.ply").write_bytes(header(ORDERS[0][1], elements) + face + vertex)
    text = "3 0 1 2\n" + "\n".join(f"{x} {y} {z} 1 {i}" for i, (x, y, z) in enumerate(POINTS))
    (folder / "text.ply").write_bytes(header("ascii", elements) + text.encode())
    for name, case in [("t", "text with more"), ("b", "binary with more"), ("c", "compressed with more")]:
        (folder / f"{name}.pcd").write_bytes(PCD[case])


def test_damaged_clouds_give_finite_points_or_one_error(tmp_path):
    rng = np.random.default_rng(int(os.environ.get("PNET_MUTATIONS_SEED", "0")))
    read = 0
    for number in range(MUTATIONS):
        folder = tmp_path / str(number)
        folder.mkdir()
        write_all(folder)
        done = mutate_folder(folder, rng)
        path = folder / done.split(":")[0]
        try:
            found = read_cloud(path)
        except (ValueError, OSError, ModuleNotFoundError) as fault:
            assert path.name in str(fault), done
            continue
        read += 1
        assert found.points.ndim == 2 and found.points.shape[1] == 3, done
        assert 1 <= len(found.points) + found.missing <= path.stat().st_size, done
        assert np.isfinite(found.points).all(), done
    assert 0 < read < MUTATIONS
