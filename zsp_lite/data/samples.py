"""Sample data: the default data folders (the user's, the repository's or a made one), and a photograph with depth.

`zsp-lite doctor` imports this module, also where a package is missing: packages are imported by the functions.
"""

import logging
import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from zsp_lite.errors import InputError

if TYPE_CHECKING:
    from zsp_lite.data.frames import Frame

logger = logging.getLogger(__name__)

DATA_VARIABLE = "ZSP_LITE_DATA"  # environment variable with the path of the user's CO3D folder
REPOSITORY = Path(__file__).resolve().parents[2]
MADE_SAMPLES = "samples"  # in the cache

PHOTOGRAPH_CATEGORY, PHOTOGRAPH_TARGET = "motorcycle", "scooter"  # the synthetic object that tells the directions
# Directions of the photographed motorcycle in camera coordinates. There is no measured ground truth. The front was
# judged by eye from the rear wheel, since the front wheel is turned, and may be wrong by 10 degrees. Up is the normal
# of the floor; the motorcycle leans on its side stand by a few degrees.
PHOTOGRAPH_FRONT = (0.97, 0.06, -0.24)
PHOTOGRAPH_UP = (0.01, -0.97, -0.26)


def data_folders(data: Path | None = None) -> list[tuple[str, Path]]:
    """List the folders to search for data, in order, each with the name of its origin.

    Args:
        data: Folder of the option --data, if given.
    """
    folders = [("--data", data)] if data is not None else []
    if os.environ.get(DATA_VARIABLE):
        folders.append((DATA_VARIABLE, Path(os.environ[DATA_VARIABLE])))
    return [*folders, ("data_samples", find_sample_data())]


def find_sample_data() -> Path:
    """Return the path of the sample data, without making it.

    This is `data_samples/` in the current folder or else in the repository, or, outside a clone, the folder in the
    cache in which `sample_data` makes synthetic objects.
    """
    from zsp_lite.io.download import cache_folder

    for folder in (Path("data_samples"), REPOSITORY / "data_samples"):
        if folder.is_dir():
            return folder
    return cache_folder() / MADE_SAMPLES


def sample_data() -> Path:
    """Return the folder of the sample data.

    Outside a clone of the repository, synthetic objects are made once in the cache, which takes about 15 s (the preset
    "demo" of `zsp-lite synth`). An interrupted call is completed by the next one.

    Raises:
        InputError: Another process is still making the samples, or the cache cannot be written.
    """
    folder = find_sample_data()
    if folder.is_dir():
        return folder
    part = folder.with_name(folder.name + ".part")
    # A warning, because a program without logging settings shows nothing else.
    logger.warning("No data_samples/ here: making synthetic samples in %s, once", folder)
    try:
        # A process of its own, because this package is below the one that makes data.
        subprocess.run([sys.executable, "-m", "zsp_lite", "synth", "--preset", "demo", "--out", part], check=True)
        part.rename(folder)
    except (OSError, subprocess.CalledProcessError) as error:
        if folder.is_dir():  # another process has made them meanwhile
            return folder
        raise InputError(
            f"samples cannot be made in {folder} ({error}); set ZSP_LITE_CACHE to a folder that can be written, or "
            f"{DATA_VARIABLE} to a data folder"
        ) from error
    return folder


def motorcycle_photograph() -> "Frame":
    """Load a photograph of a motorcycle with dense depth and an object mask.

    The photograph and its disparities, measured with structured light, come with scikit-image
    (`skimage.data.stereo_motorcycle`). They are a scene of the Middlebury 2014 stereo data:

        D. Scharstein, H. Hirschmueller, Y. Kitajima, G. Krathwohl, N. Nesic, X. Wang and P. Westling.
        High-resolution stereo datasets with subpixel-accurate ground truth. GCPR 2014.

    The mask is that of `photograph.motorcycle_frame`. `PHOTOGRAPH_FRONT` and `PHOTOGRAPH_UP` are the front and the top
    of the motorcycle in the camera's frame, judged by eye.

    Returns:
        Frame of 500 x 741 pixels. Its world is the camera's frame. Lengths are scaled as in CO3D, so that the points of
        the object have unit standard deviation, averaged over the axes; one unit is about 0.22 m.
    """
    import skimage.data

    from zsp_lite.data.photograph import motorcycle_frame, scale_to_unit_deviation

    rgb, _, disparity = skimage.data.stereo_motorcycle()
    return scale_to_unit_deviation(motorcycle_frame(rgb, disparity))
