"""Images of a board: which are taken, and what grey levels they have."""

import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from capture4d.calibration.board_images import find_images, read_grey
from capture4d.errors import InputError


def ramp(bits: int = 8, shape: tuple[int, int] = (60, 100)) -> np.ndarray:
    """Grey levels from none to all that so many bits can say."""
    levels = np.linspace(0, 2**bits - 1, shape[0] * shape[1]).reshape(shape)
    return np.rint(levels).astype(np.uint8 if bits == 8 else np.uint16)


def write(path: Path, image: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)
    return path


@pytest.mark.parametrize("ending", ["png", "PNG", "tif", "TIFF", "bmp", "Bmp", "webp", "pgm", "ppm", "jpg", "JPEG"])
def test_every_ending_is_read_in_any_case(tmp_path: Path, ending: str):
    image = np.repeat(ramp()[:, :, None], 3, axis=2) if ending == "ppm" else ramp()
    write(tmp_path / "a" / f"1.{ending.lower()}", image).rename(tmp_path / "a" / f"1.{ending}")
    (image,) = find_images(tmp_path)
    lossy = ending.lower() in ("jpg", "jpeg", "webp")
    np.testing.assert_allclose(read_grey(image.path).astype(int), ramp(), atol=6 if lossy else 0)


@pytest.mark.parametrize("name", ["._1.png", ".1.png", ".thumbs/1.png", "__MACOSX/1.png", "a/._2.JPG"])
def test_what_a_system_leaves_behind_is_no_image(tmp_path: Path, name: str):
    write(tmp_path / "a" / "1.png", ramp())
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_bytes(b"\0\5\x16\7")
    assert [image.pose for image in find_images(tmp_path)] == ["1"]
    (tmp_path / "a" / "1.png").unlink()
    with pytest.raises(InputError, match=r"expected images \(\.png, .*, found none"):
        find_images(tmp_path)


@pytest.mark.parametrize("ending", ["png", "tif", "pgm"])
@pytest.mark.parametrize("bits", [10, 12, 14, 16])
@pytest.mark.parametrize("hot", [0, 1, 5])
def test_the_bits_that_are_used_are_stretched(tmp_path: Path, ending: str, bits: int, hot: int):
    image = ramp(bits, (300, 400))
    expected = np.rint(image / (2**bits - 1) * 255)
    image.ravel()[100 : 100 + 7 * hot : 7] = 65535
    found = read_grey(write(tmp_path / f"x.{ending}", image)).astype(int)
    assert np.count_nonzero(np.abs(found - expected) > 0) <= hot
    assert found.max() == 255


def test_a_colour_image_of_many_bits_is_grey(tmp_path: Path):
    colour = np.repeat(ramp(12)[:, :, None], 3, axis=2)
    np.testing.assert_allclose(read_grey(write(tmp_path / "x.png", colour)).astype(int), ramp(8), atol=1)


def test_floating_point_is_scaled_to_the_next_power_of_two(tmp_path: Path):
    image = (ramp() / 255).astype(np.float32)
    np.testing.assert_allclose(read_grey(write(tmp_path / "x.tif", image)).astype(int), ramp(), atol=1)
    image[0, 0] = np.nan
    with pytest.raises(InputError, match="expected grey levels of 8 or 16 bits"):
        read_grey(write(tmp_path / "x.tif", image))


def test_a_black_image_is_black_and_one_of_a_pixel_is_read(tmp_path: Path):
    assert not read_grey(write(tmp_path / "x.png", np.zeros((20, 30), np.uint16))).any()
    assert read_grey(write(tmp_path / "y.png", np.full((1, 1), 255, np.uint16))).tolist() == [[255]]


def test_exif_does_not_turn_an_image(tmp_path: Path):
    exif = Image.Exif()
    exif[0x0112] = 6
    buffer = io.BytesIO()
    Image.fromarray(ramp()).save(buffer, "JPEG", exif=exif)
    (tmp_path / "x.jpg").write_bytes(buffer.getvalue())
    assert read_grey(tmp_path / "x.jpg").shape == (60, 100)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"P5 60000 60000 255\n",
        b"P5 60000 60000 65535\n" + 100 * b"x",
        b"P6 4 4 255\n" + 16 * b"x",
        b"P2 9999 9999 255\n1 2 3",
        b"P7 whatever",
        b"P5 # a comment without an end",
        b"BM" + 60 * b"\0",
        b"RIFF\0\0\0\0WEBPVP8 ",
        b"\x89PNG\r\n\x1a\n",
        b"%!PS-Adobe-3.0 EPSF-3.0",
    ],
)
def test_damage_is_one_line(tmp_path: Path, data: bytes):
    path = tmp_path / "x.pgm"
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"x\.pgm: not a readable image") as caught:
        read_grey(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("header", [b"P5 5 4 255\n", b"P5\n# of a camera\n5 4\n255\n", b"P5\n5\n# more\n4 255 "])
def test_comments_in_a_pgm_are_read(tmp_path: Path, header: bytes):
    (tmp_path / "x.pgm").write_bytes(header + bytes(range(20)))
    assert read_grey(tmp_path / "x.pgm").ravel().tolist() == list(range(20))
