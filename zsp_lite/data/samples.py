"""Sample data: the default data folders (the user's, or that of the repository), and a photograph with depth.

`zsp-lite doctor` imports this module, also where a package is missing: packages are imported by the functions.
"""

import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from zsp_lite.data.frames import Frame

DATA_VARIABLE = "ZSP_LITE_DATA"  # environment variable with the path of the user's CO3D folder
REPOSITORY = Path(__file__).resolve().parents[2]

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
    return [*folders, ("data_samples", sample_data())]


def sample_data() -> Path:
    """Return the sample data folder: `data_samples/` in the current folder, or else in the repository."""
    here = Path("data_samples")
    return here if here.is_dir() else REPOSITORY / "data_samples"


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
