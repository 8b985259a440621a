"""Depth images by other programs: PNG, TIFF, EXR and NPY become metres."""

import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.mutations import mutate_folder

from pnet.data.depth_files import check_depth, read_depth
from pnet.geometry.camera import Camera

MUTATIONS = int(os.environ.get("PNET_MUTATIONS", "200"))
CAMERA = Camera(3, 2, 10.0, 20.0, 1.0, 0.5)
NAN = np.nan
MILLIMETRES = [[650, 0, 700], [65535, 1, 30000]]


def write_png16(path, rows):
    """A PNG of 16 bits by its specification, big endian."""
    raw = b"".join(b"\0" + struct.pack(f">{len(row)}H", *row) for row in rows)
    head = struct.pack(">IIBBBBB", len(rows[0]), len(rows), 16, 0, 0, 0, 0)
    chunks = [(b"IHDR", head), (b"IDAT", zlib.compress(raw)), (b"IEND", b"")]
    body = b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + body)


def write_exr(path, channels):
    exr = pytest.importorskip("OpenEXR")
    header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
    arrays = {name: np.ascontiguousarray(values) for name, values in channels.items()}
    with exr.File(header, arrays) as file:
        file.write(str(path))


def test_a_png_of_16_bits_is_in_millimetres(tmp_path):
    write_png16(tmp_path / "a.png", MILLIMETRES)
    depth = read_depth(tmp_path / "a.png", CAMERA)
    assert depth.dtype == np.float64
    np.testing.assert_allclose(depth, [[0.65, NAN, 0.7], [NAN, 0.001, 30.0]], rtol=1e-12)


def test_the_scale_is_in_metres_a_unit(tmp_path):
    write_png16(tmp_path / "a.png", MILLIMETRES)
    depth = read_depth(tmp_path / "a.png", scale=0.0001)
    np.testing.assert_allclose(depth, [[0.065, NAN, 0.07], [NAN, 0.0001, 3.0]], rtol=1e-12)


def test_a_coding_of_integers_leaves_floating_point_numbers_alone(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[0.65, 0.0], [0.7, 0.8]]))
    depth = read_depth(tmp_path / "a.npy", scale=0.0001, offset=0.5, missing=[0.7], of_integers=True)
    np.testing.assert_array_equal(depth, [[0.65, NAN], [0.7, 0.8]])
    write_png16(tmp_path / "a.png", MILLIMETRES)
    coded = read_depth(tmp_path / "a.png", scale=0.0001, offset=0.5, of_integers=True)
    np.testing.assert_array_equal(coded, read_depth(tmp_path / "a.png", scale=0.0001, offset=0.5))


def test_the_offset_is_added_in_metres_to_what_was_measured_and_0_is_a_depth_then(tmp_path):
    write_png16(tmp_path / "a.png", MILLIMETRES)
    depth = read_depth(tmp_path / "a.png", scale=0.0001, offset=0.5)
    np.testing.assert_allclose(depth, [[0.565, 0.5, 0.57], [NAN, 0.5001, 3.5]], rtol=1e-12)
    depth = read_depth(tmp_path / "a.png", offset=-0.66)  # nothing is measured behind the camera
    np.testing.assert_allclose(depth, [[NAN, NAN, 0.04], [NAN, NAN, 29.34]], rtol=1e-12)


def test_the_values_that_mean_missing_can_be_named(tmp_path):
    write_png16(tmp_path / "a.png", MILLIMETRES)
    named = read_depth(tmp_path / "a.png", missing=[1, 700])
    np.testing.assert_allclose(named, [[0.65, NAN, NAN], [65.535, NAN, 30.0]], rtol=1e-12)
    none = read_depth(tmp_path / "a.png", missing=[])
    np.testing.assert_allclose(none, [[0.65, NAN, 0.7], [65.535, 0.001, 30.0]], rtol=1e-12)


@pytest.mark.parametrize("dtype", ["<u2", ">u2", "<i4", "<u8"])
def test_arrays_of_integers_are_in_millimetres(tmp_path, dtype):
    np.save(tmp_path / "a.npy", np.array([[650, 0, 700], [2, 1, 30000]], dtype))
    np.testing.assert_allclose(
        read_depth(tmp_path / "a.npy", CAMERA), [[0.65, NAN, 0.7], [0.002, 0.001, 30.0]], rtol=1e-12
    )


def test_65535_is_a_depth_where_integers_are_longer(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[65535]], np.int32))
    assert read_depth(tmp_path / "a.npy") == pytest.approx(65.535)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_floating_point_numbers_are_in_metres(tmp_path, dtype):
    values = np.array([[0.5, NAN, np.inf], [-np.inf, 0, 2]], dtype)
    np.save(tmp_path / "a.npy", values)
    np.testing.assert_array_equal(read_depth(tmp_path / "a.npy", CAMERA), [[0.5, NAN, NAN], [NAN, NAN, 2]])


def test_what_renderers_write_for_nothing_is_missing(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[0.5, 1e10, 1e9]], np.float32))
    np.testing.assert_array_equal(read_depth(tmp_path / "a.npy"), [[0.5, NAN, NAN]])


@pytest.mark.parametrize(
    ("array", "expected"),
    [
        (np.array(MILLIMETRES, np.uint16), [[0.65, NAN, 0.7], [NAN, 0.001, 30.0]]),
        (np.array([[0.25, 0, 1], [2, NAN, 4]], np.float32), [[0.25, NAN, 1], [2, NAN, 4]]),
    ],
    ids=["16 bits", "float"],
)
def test_tiff_holds_either(tmp_path, array, expected):
    Image.fromarray(array).save(tmp_path / "a.tiff")
    np.testing.assert_allclose(read_depth(tmp_path / "a.tiff", CAMERA), expected, rtol=1e-12)


FLAT = np.array([[0.5, 0, 0.75], [1, np.inf, 2]], np.float32)
FLAT_METRES = [[0.5, NAN, 0.75], [1, NAN, 2]]


@pytest.mark.parametrize(
    ("names", "depths"),
    [
        ("anything", "anything"),
        ("R,G,B,Z", "Z"),
        ("Y,Z", "Z"),
        ("D,depth", "depth"),
        ("view.Z,view.A", "view.Z"),
        ("Depth,normal.X", "Depth"),
        ("Y,A", "Y"),
        ("D,R,G,B", "D"),
        ("R,G,B", "R,G,B"),
        ("R,G,B,A", "R,G,B"),
    ],
)
def test_the_channel_of_an_exr_file_that_holds_depth_is_found(tmp_path, names, depths):
    other = iter(np.float32([3, 4, 5, 6]))
    channels = {
        name: FLAT if name in depths.split(",") else np.full_like(FLAT, next(other))
        for name in names.split(",")
    }
    write_exr(tmp_path / "a.exr", channels)
    np.testing.assert_array_equal(read_depth(tmp_path / "a.exr", CAMERA), FLAT_METRES)


def test_an_exr_file_without_depth_is_an_error_with_its_channels(tmp_path):
    write_exr(tmp_path / "a.exr", {"R": FLAT, "G": FLAT + 1, "B": FLAT})
    with pytest.raises(ValueError, match=r"a\.exr: has the channels B, G, R; expected one, or one named Z"):
        read_depth(tmp_path / "a.exr", CAMERA)


def test_a_distance_along_the_ray_becomes_planar_depth(tmp_path):
    v, u = np.mgrid[:2, :3]
    points = np.stack([(u - 1) / 10 * 0.6, (v - 0.5) / 20 * 0.6, np.full((2, 3), 0.6)], -1)
    np.save(tmp_path / "a.npy", np.sqrt((points**2).sum(-1)))
    np.testing.assert_allclose(
        read_depth(tmp_path / "a.npy", CAMERA, radial=True), np.full((2, 3), 0.6), rtol=1e-12
    )


@pytest.mark.parametrize(
    ("array", "arguments", "message"),
    [
        (np.float32([[1, -0.5]]), {}, r"negative depths \(lowest -0.5\)"),
        (np.uint8([[1]]), {}, "8 bits.*set depth.scale="),
        (np.uint16([[1]]), {"scale": 0}, "scale is 0, expected more than 0"),
        (np.uint16([[1]]), {"offset": NAN}, "offset is nan"),
        (np.uint16([[1]]), {"scale": NAN}, "scale is nan, expected more than 0"),
        (np.uint16([[1]]), {"camera": CAMERA}, "has 1 x 1 pixels, the camera 3 x 2"),
        (np.uint16([[1]]), {"radial": True}, "needs the camera"),
        (np.uint16([[1]]), {"missing": ["x"]}, "missing is .*expected a list of numbers"),
        (np.zeros((2, 3, 1)), {}, "expected numbers"),
    ],
)
def test_what_is_wrong_is_an_error_that_says_so(tmp_path, array, arguments, message):
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(ValueError, match=message):
        read_depth(tmp_path / "a.npy", **arguments)


def test_a_negative_value_may_mean_missing(tmp_path):
    np.save(tmp_path / "a.npy", np.float32([[1, -1]]))
    np.testing.assert_array_equal(read_depth(tmp_path / "a.npy", missing=[-1]), [[1, NAN]])


@pytest.mark.parametrize(
    ("depth", "message"),
    [
        ([NAN, NAN], "no pixel was measured"),
        ([650.0, 700, NAN], "median depth is 675 m.*set depth.scale="),
        ([0.00065], "median depth is 0.00065 m.*set depth.scale="),
        ([0.05, 11], r"from 0.05 to 11 m, none lies within the camera's 0.1 to 10 m; set depth.scale="),
    ],
)
def test_an_unlikely_depth_is_an_error_that_names_the_scale(depth, message):
    with pytest.raises(ValueError, match=message):
        check_depth(np.array([depth]), Path("a.png"), CAMERA)


def test_a_likely_depth_passes():
    check_depth(np.array([[NAN, 0.6, 60.0, 0.2]]), Path("a.png"), CAMERA)
    check_depth(np.array([[20.0]]), Path("a.png"))


def write_all(folder):
    write_png16(folder / "a.png", MILLIMETRES)
    np.save(folder / "a.npy", np.array([[650, 1], [2, 3]], np.uint16))
    Image.fromarray(FLAT).save(folder / "a.tif")
    Image.fromarray(np.array(MILLIMETRES, np.uint16)).save(folder / "b.tif", compression="tiff_lzw")
    write_exr(folder / "a.exr", {"Z": FLAT, "R": FLAT + 1})


@pytest.mark.filterwarnings("ignore::UserWarning:PIL")
def test_damaged_images_give_a_depth_image_or_one_error(tmp_path):
    rng = np.random.default_rng(int(os.environ.get("PNET_MUTATIONS_SEED", "0")))
    read = 0
    for number in range(MUTATIONS):
        folder = tmp_path / str(number)
        folder.mkdir()
        write_all(folder)
        done = mutate_folder(folder, rng)
        path = folder / done.split(":")[0]
        try:
            depth = read_depth(path)
        except (ValueError, OSError) as fault:
            assert path.name in str(fault), done
            continue
        read += 1
        known = depth[~np.isnan(depth)]
        assert depth.ndim == 2 and depth.size <= 64_000_000, done
        assert np.isfinite(known).all() and (known > 0).all(), done
    assert 0 < read < MUTATIONS
