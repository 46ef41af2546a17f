"""Cut the backgrounds that rendered objects are put in front of from photographs and environment maps of packages.

    apt-get download lomiri-wallpapers-16.04 sddm-theme-maldives supertuxkart-data
    pip download --no-deps bpy==5.0.1 scikit-image==0.26.0 scikit-learn==1.6.1
    mkdir packages
    for file in *.deb; do dpkg-deb -x $file packages/${file%%_*}; done
    for file in *.whl; do name=${file%%-*}; unzip -q $file -d packages/${name/_/-}; done
    pip install OpenEXR
    python tools/backgrounds.py packages outputs/backgrounds.npz

`backgrounds.json` names every picture: package, file, licence and author. All are under CC0 or CC BY. The
pictures themselves are not part of this repository.
"""

import io
import sys
from pathlib import Path

import cv2
import msgspec
import numpy as np
from jaxtyping import Float32, UInt8

from zsp_lite.data.annotations import decode
from zsp_lite.errors import InputError
from zsp_lite.io.files import read_bytes, write_atomic
from zsp_lite.io.images import decode_image

try:
    from tools.models import Source
except ModuleNotFoundError:  # run as a script
    from models import Source

CATALOGUE = Path(__file__).with_suffix(".json")
WIDTH, HEIGHT = 384, 256
MOST = 6  # crops of one photograph


class Picture(Source, frozen=True, omit_defaults=True):
    """One photograph or environment map.

    Attributes:
        box: Part of a photograph to use: left, top, right and bottom in pixels. Empty stands for all of it.
        views: Views of an environment map: azimuth, elevation and horizontal field of view in degrees. The azimuth
            runs from the left edge of the map to the right.
    """

    box: tuple[int, ...] = ()
    views: tuple[tuple[int, int, int], ...] = ()


class Catalogue(msgspec.Struct, frozen=True):
    """The content of the catalogue: versions of the packages, and the pictures by name."""

    packages: dict[str, str]
    pictures: dict[str, Picture]


def read_catalogue(path: Path = CATALOGUE) -> Catalogue:
    """Return the catalogue. Raises InputError if it is damaged."""
    return decode(read_bytes(path, "catalogue"), Catalogue, path)


def build(packages: Path, out: Path, catalogue: Catalogue) -> None:
    """Write the crops of all pictures: `images` (n, 256, 384, 3), RGB, and `source` (n), the index of their picture.

    Args:
        packages: Folder with one folder per unpacked package.
        out: File of type npz to write.
        catalogue: The pictures.

    Raises:
        InputError: If a package or a file is missing, or a file is another one than that of the catalogue.
    """
    images, source = [], []
    for index, picture in enumerate(catalogue.pictures.values()):
        data = picture.read(packages)
        if picture.views:
            found = views(_read_exr(picture.path(packages)), picture.views)
        else:
            image = cv2.cvtColor(decode_image(data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
            left, top, right, bottom = picture.box or (0, 0, image.shape[1], image.shape[0])
            found = crops(image[top:bottom, left:right])
        images += found
        source += [index] * len(found)
    file = io.BytesIO()
    np.savez_compressed(file, images=np.stack(images), source=np.array(source, np.int32))
    write_atomic(out, file.getvalue())


def crops(image: UInt8[np.ndarray, "height width 3"]) -> list[UInt8[np.ndarray, "256 384 3"]]:
    """Return crops that cover the image at up to three scales, at most `MOST`.

    The crops of the first scale are as large as possible; those of the next scales have a half and a quarter of their
    width, as long as no crop is enlarged.
    """
    height, width = image.shape[:2]
    largest = min(width, height * WIDTH / HEIGHT)
    found = []
    for scale in (1, 1 / 2, 1 / 4):
        across = largest * scale
        if scale < 1 and across < WIDTH:
            break
        down = across * HEIGHT / WIDTH
        columns, rows = (int(np.ceil(extent / part - 0.1)) for extent, part in ((width, across), (height, down)))
        for top in np.linspace(0, height - down, rows):
            for left in np.linspace(0, width - across, columns):
                part = image[round(top) : round(top + down), round(left) : round(left + across)]
                how = cv2.INTER_AREA if across > WIDTH else cv2.INTER_CUBIC
                found.append(cv2.resize(part, (WIDTH, HEIGHT), interpolation=how))
    chosen = np.linspace(0, len(found) - 1, min(len(found), MOST)).round().astype(int)
    return [found[i] for i in chosen]


def views(
    radiance: Float32[np.ndarray, "height width 3"], directions: tuple[tuple[int, int, int], ...]
) -> list[UInt8[np.ndarray, "256 384 3"]]:
    """Return perspective views of an environment map, exposed for the median of each view.

    Args:
        radiance: Equirectangular map, linear RGB; the columns run over 360 degrees of azimuth, the rows from the zenith
            to the nadir.
        directions: Azimuth, elevation and horizontal field of view of each view in degrees.
    """
    height, width = radiance.shape[:2]
    padded = np.concatenate([radiance, radiance[:, :1]], axis=1)  # to interpolate across the seam
    found = []
    for azimuth, elevation, field in np.radians(directions):
        focal = WIDTH / 2 / np.tan(field / 2)
        x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, HEIGHT / 2 - 0.5 - np.arange(HEIGHT))
        ahead = focal * np.cos(elevation) - y * np.sin(elevation)
        up = focal * np.sin(elevation) + y * np.cos(elevation)
        turn = (azimuth + np.arctan2(x, ahead)) % (2 * np.pi)
        polar = np.arccos(up / np.sqrt(x**2 + y**2 + focal**2))
        column = (turn / (2 * np.pi) * width - 0.5) % width
        row = np.clip(polar / np.pi * height - 0.5, 0, height - 1)
        view = cv2.remap(padded, column.astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR)
        exposed = 1 - np.exp(-0.35 * view / max(np.median(view), 1e-6))
        found.append((255 * exposed.clip(0, 1) ** (1 / 2.2)).round().astype(np.uint8))
    return found


def _read_exr(path: Path) -> Float32[np.ndarray, "height width 3"]:
    import OpenEXR

    return OpenEXR.File(str(path)).channels()["RGB"].pixels.astype(np.float32)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    try:
        build(Path(sys.argv[1]), Path(sys.argv[2]), read_catalogue())
    except InputError as error:
        sys.exit(str(error))
