import struct
import sys
import warnings
import zlib

import numpy as np
import pytest
from PIL import Image

from pnet.data.images import ENDINGS, MOST_PIXELS, npy_shape, read_exr, read_image

SHAPE = 6, 9


def pixels(kind) -> np.ndarray:
    """An image (6, 9) that uses the range of its type."""
    rng = np.random.default_rng(0)
    if np.dtype(kind).kind == "f":
        return rng.normal(size=SHAPE).astype(kind)
    limits = np.iinfo(kind)
    return rng.integers(limits.min, limits.max, SHAPE, limits.dtype.newbyteorder("="), True).astype(kind)


def save(path, image):
    """Write an image in the format that the ending names."""
    match path.suffix.lower():
        case ".npy":
            with path.open("wb") as file:  # np.save adds an ending to a name
                np.save(file, image)
        case ".exr":
            write_exr(path, {"Z": image})
        case ".png":
            Image.fromarray(image).save(path, format="PNG")
        case _:
            Image.fromarray(image).save(path, format="TIFF")


def open_exr():
    """The library; skips the test where it is not there."""
    return pytest.importorskip("OpenEXR", reason="needs the extra [formats]")


def write_exr(path, channels, **header):
    OpenEXR = open_exr()
    OpenEXR.File({"type": OpenEXR.scanlineimage} | header, channels).write(str(path))


@pytest.mark.parametrize(
    ("ending", "kind"),
    [
        *[(ending, np.uint8) for ending in (".png", ".PNG", ".tif", ".tiff", ".npy")],
        *[(ending, np.uint16) for ending in (".png", ".PNG", ".tif", ".tiff", ".npy")],
        *[(ending, kind) for ending in (".tif", ".npy") for kind in (np.int32, np.float32)],
        *[(".exr", kind) for kind in (np.float16, np.float32, np.uint32)],
        *[(".NPY", kind) for kind in (np.float16, np.float64, np.int64, ">f4", ">u2")],
    ],
)
def test_pixels_come_back_as_they_were_written(tmp_path, ending, kind):
    image, path = pixels(kind), tmp_path / f"image{ending}"
    save(path, image)
    found = read_image(path, SHAPE)
    assert found.dtype == np.dtype(kind).newbyteorder("=")
    np.testing.assert_array_equal(found, image)
    np.testing.assert_array_equal(read_image(path), image)


def test_a_tiff_image_may_have_its_high_bytes_first(tmp_path):
    image, path = pixels(np.uint16), tmp_path / "image.tif"
    strip = image.astype(">u2").tobytes()
    tags = [(256, 3, SHAPE[1]), (257, 3, SHAPE[0]), (258, 3, 16), (259, 3, 1), (262, 3, 1)]
    tags += [(273, 4, 8), (277, 3, 1), (278, 3, SHAPE[0]), (279, 4, len(strip))]
    values = {3: ">HHIHH", 4: ">HHII"}  # a short is followed by two bytes of nothing
    entries = b"".join(
        struct.pack(values[kind], tag, kind, 1, value, *[0] * (kind == 3)) for tag, kind, value in tags
    )
    directory = struct.pack(">H", len(tags)) + entries + bytes(4)
    path.write_bytes(b"MM\0*" + struct.pack(">I", 8 + len(strip)) + strip + directory)
    found = read_image(path)
    assert found.dtype == np.uint16 and found.dtype.isnative
    np.testing.assert_array_equal(found, image)


@pytest.mark.parametrize("ending", ENDINGS)
def test_another_size_than_the_cameras_is_refused(tmp_path, ending):
    path = tmp_path / f"image{ending}"
    save(path, pixels(np.float32 if ending == ".exr" else np.uint8))
    with pytest.raises(ValueError, match=rf"image\{ending}: has 9 x 6 pixels, the camera 6 x 9"):
        read_image(path, (9, 6))


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("share", [0.02, 0.2, 0.6, 0.99])
def test_a_truncated_file_is_refused(tmp_path, capfd, ending, share):
    path = tmp_path / f"image{ending}"
    image = np.random.default_rng(1).integers(0, 65535, (64, 80), np.uint16)
    save(path, image.astype(np.float32) if ending == ".exr" else image)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(ValueError, match=rf"image\{ending}: not readable as an image"):
        read_image(path)


@pytest.mark.parametrize("ending", ENDINGS)
def test_missing_and_empty_files_are_named(tmp_path, ending):
    path = tmp_path / f"image{ending}"
    with pytest.raises(FileNotFoundError, match=rf"image\{ending}: no such image file"):
        read_image(path)
    path.write_bytes(b"")
    with pytest.raises(ValueError, match=rf"image\{ending}: the image file is empty"):
        read_image(path)


@pytest.mark.parametrize("name", ["image.jpg", "image", "image.png.gz"])
def test_other_endings_are_refused(tmp_path, name):
    (tmp_path / name).write_bytes(b"x")
    with pytest.raises(ValueError, match=r"expected one of \.png, \.tif, \.tiff, \.exr, \.npy"):
        read_image(tmp_path / name)


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "LA", "P", "1"])
def test_colours_are_refused(tmp_path, mode):
    Image.new(mode, (9, 6)).save(tmp_path / "image.png")
    with pytest.raises(ValueError, match=rf"image\.png: has pixels of mode {mode}, expected one channel"):
        read_image(tmp_path / "image.png")


def test_a_bitmap_of_another_format_is_not_read_under_a_known_ending(tmp_path):
    Image.new("L", (9, 6)).save(tmp_path / "image.png", format="BMP")
    with pytest.raises(ValueError, match=r"image\.png: not readable as an image"):
        read_image(tmp_path / "image.png")


def test_a_png_image_with_a_flipped_byte_is_refused(tmp_path):
    path = tmp_path / "image.png"
    save(path, pixels(np.uint16))
    content = bytearray(path.read_bytes())
    content[content.index(b"IDAT") + 20] ^= 1
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"image\.png: not readable as an image"):
        read_image(path)


# sizes that a header claims


def png_of_size(path, width, height):
    """A PNG image of 16 bits that claims a size and holds a line of pixels."""

    def chunk(name, data):
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0))
    body = chunk(b"IDAT", zlib.compress(bytes(2 * 9 + 1))) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + header + body)


@pytest.mark.parametrize("size", [(9000, 9000), (100_000, 100_000), (2**31 - 1, 2**31 - 1)])
def test_a_png_image_that_claims_too_much_costs_no_memory(tmp_path, size):
    png_of_size(tmp_path / "image.png", *size)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ValueError, match=r"png: (claims 9000 x 9000 pixels|not readable as an image)"):
            read_image(tmp_path / "image.png")


def npy_of_shape(path, shape):
    """An array of bytes that claims a shape and holds nothing."""
    header = f"{{'descr': '|u1', 'fortran_order': False, 'shape': {shape}, }}".ljust(117).encode() + b"\n"
    path.write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(100))


@pytest.mark.parametrize("shape", [(10**6, 10**6), (9000, 9000), (0, 5), (-3, 5)])
def test_an_array_that_claims_too_much_costs_no_memory(tmp_path, shape):
    npy_of_shape(tmp_path / "image.npy", shape)
    with pytest.raises(ValueError, match=r"image\.npy: (not readable as an image|claims 5 x 0 pixels)"):
        read_image(tmp_path / "image.npy")


@pytest.mark.parametrize("corner", [(7999, 7999), (8, 99), (2**31 - 1, 2**31 - 1), (-5, -5)])
def test_an_exr_image_that_claims_too_much_costs_no_memory(tmp_path, capfd, corner):
    path = tmp_path / "image.exr"
    save(path, pixels(np.float32))
    content, mark = bytearray(path.read_bytes()), b"dataWindow\0box2i\0"
    place = content.index(mark) + len(mark) + 4
    assert struct.unpack_from("<4i", content, place) == (0, 0, 8, 5)
    struct.pack_into("<4i", content, place, 0, 0, *corner)
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"image\.exr: (not readable as an image|claims)"):
        read_image(path)


def test_an_exr_image_with_many_channels_is_refused_before_it_is_read(tmp_path, monkeypatch):
    write_exr(tmp_path / "image.exr", {f"c{i}": pixels(np.float32) for i in range(40)})
    assert len(read_exr(tmp_path / "image.exr")) == 40
    monkeypatch.setattr("pnet.data.images.MOST_PIXELS", 40 * 54 - 1)
    with pytest.raises(ValueError, match=r"image\.exr: claims 40 channels, at most 2,159 numbers"):
        read_exr(tmp_path / "image.exr")


def test_the_limit_leaves_room_for_cameras():
    assert MOST_PIXELS >= 6000 * 4000


# OpenEXR


def test_channels_have_their_names(tmp_path):
    red, depth = pixels(np.float16), pixels(np.float32)
    write_exr(tmp_path / "image.exr", {"R": red, "Z": depth})
    found = read_exr(tmp_path / "image.exr", SHAPE)
    assert set(found) == {"R", "Z"}
    np.testing.assert_array_equal(found["R"], red)
    np.testing.assert_array_equal(found["Z"], depth)
    with pytest.raises(ValueError, match=r"image\.exr: has the channels R, Z, expected one"):
        read_image(tmp_path / "image.exr")


def test_a_window_may_lie_anywhere(tmp_path):
    image = pixels(np.float32)
    windows = {"dataWindow": ((3, 4), (11, 9)), "displayWindow": ((0, 0), (99, 99))}
    write_exr(tmp_path / "image.exr", {"Z": image}, **windows)
    np.testing.assert_array_equal(read_image(tmp_path / "image.exr", SHAPE), image)


def test_several_depths_a_pixel_are_refused(tmp_path):
    deep = np.empty((2, 3), object)
    for place in np.ndindex(2, 3):
        deep[place] = np.array([1.0, 2.0], np.float32)
    OpenEXR = open_exr()
    header = {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION}
    write_exr(tmp_path / "image.exr", {"Z": deep}, **header)
    with pytest.raises(ValueError, match=r"image\.exr: channel 'Z' has \(3, 2\) pixels of type object"):
        read_image(tmp_path / "image.exr")


def test_a_channel_of_reduced_size_is_refused(tmp_path):
    channel = open_exr().Channel("Z", np.ones((4, 6), np.float32), 2, 2)  # of each other column and row
    write_exr(tmp_path / "image.exr", {"Z": channel})
    with pytest.raises(ValueError, match=r"image\.exr: channel 'Z' has \(3, 2\) pixels of type float32"):
        read_image(tmp_path / "image.exr")


def test_without_the_library_the_extra_is_named(tmp_path, monkeypatch):
    (tmp_path / "image.exr").write_bytes(b"x")
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(ModuleNotFoundError, match=r'image\.exr: .* pip install "pnet\[formats\]"'):
        read_image(tmp_path / "image.exr")


# NumPy


class Trap:
    """Leaves a trace where it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return exec, (f"open({str(self.path)!r}, 'w')",)


def test_pickled_objects_are_refused_and_not_run(tmp_path):
    path, trace = tmp_path / "image.npy", tmp_path / "trace"
    np.save(path, np.array([[Trap(trace)]], object), allow_pickle=True)
    assert b"trace" in path.read_bytes()
    with pytest.raises(ValueError, match=r"image\.npy: not readable as an image"):
        read_image(path)
    assert not trace.exists()


@pytest.mark.parametrize(
    "array", [np.zeros(4), np.zeros((2, 3, 3)), np.zeros((2, 3), bool), np.zeros((2, 3), complex)]
)
def test_arrays_that_are_no_image_are_refused(tmp_path, array):
    np.save(tmp_path / "image.npy", array)
    with pytest.raises(ValueError, match=r"image\.npy: holds .* expected numbers \(height, width\)"):
        read_image(tmp_path / "image.npy")


def test_an_archive_of_arrays_is_refused(tmp_path):
    with (tmp_path / "image.npy").open("wb") as file:
        np.savez(file, a=np.zeros((2, 3)))
    with pytest.raises(ValueError, match=r"image\.npy: holds several arrays, expected one"):
        read_image(tmp_path / "image.npy")


def test_the_shape_of_an_array_is_known_without_reading_it(tmp_path):
    np.save(tmp_path / "cloud.npy", np.zeros((5, 3)))
    assert npy_shape(tmp_path / "cloud.npy") == (5, 3)
