"""The commands for data: `data check`, `data labels`, `data transfer`, `data import`.

`data download` is in `zsp_lite.cli.download`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from zsp_lite.cli.common import BOX, COUNT, LENGTH, PATH, examples, refuse_options, replace_option

_PROBLEMS_SHOWN = 5  # of a category
_CHECK_COLUMNS = ("category", "layout", "sequences", "complete", "labelled", "usable", "pairs", "frames", "disk")
root_option = click.option("--root", type=PATH, required=True, help="Data folder.")


@click.group(no_args_is_help=False, epilog=examples("data check path/to/co3d", "data import --help"))
def data() -> None:
    """Download or check CO3D, import labels or captures, transfer labels from CO3D v1 to v2."""


@data.command(epilog=examples("data check path/to/co3d", "data check path/to/co3d --deep"))
@click.argument("root", type=PATH)
@click.option("--deep", is_flag=True, help="Also decode every file; slow on large folders.")
@click.option("--partial", is_flag=True, help="A sequence without any file is not a problem: it was not downloaded.")
def check(root, deep, partial) -> int:
    """Report missing or broken files, the number of pairs that can be evaluated, and the size on disk.

    The exit code is 1 if there is any problem.
    """
    from zsp_lite.data.check import check_folder

    return print_checks(root, check_folder(root, deep, partial=partial), deep)


def print_checks(root: Path, checks: Sequence[Any], deep: bool) -> int:
    """Print the results of `check_folder`, and return the exit code: 1 if there is any problem, else 0."""
    from rich.filesize import decimal

    from zsp_lite.cli.terminal import print_rows

    rows = []
    for check in checks:
        counts = (f"{getattr(check, name):,}" for name in _CHECK_COLUMNS[2:-1])
        rows.append((check.category, check.layout, *counts, decimal(check.size)))
    size = decimal(sum(check.size for check in checks))
    print_rows(f"{root}: {len(checks)} categories, {size}", _CHECK_COLUMNS, rows, texts=2)
    for check in checks:
        kinds = ", ".join(f"{kind} {count:,}" for kind, count in sorted(check.defects.items()))
        counts = [
            (check.absent, check.sequences, "annotated sequences are not downloaded"),
            (check.labelled - check.usable, check.labelled, "labelled sequences cannot be evaluated"),
            (check.cloudless, check.sequences, "sequences have no point cloud"),
            (check.defects.total(), check.frames, f"frames cannot be used ({kinds})"),
        ]
        lines = [f"{count:,} of {every:,} {what}" for count, every, what in counts if count > 0]
        lines += check.problems[:_PROBLEMS_SHOWN]
        if (more := len(check.problems) - _PROBLEMS_SHOWN) > 0:
            lines.append(f"and {more} more")
        for line in lines:
            print(f"{check.category}: {line}")
    problems, clouds = (sum(numbers) for numbers in zip(*((len(one.problems), one.cloudless) for one in checks)))
    black = sum(one.defects["black image"] for one in checks) if deep else "--deep decodes all files and counts"
    tested = "can be decoded" if deep else "exists and is not empty"
    print(f"{clouds:,} sequences without a point cloud; {black} black frames.")
    print(f"{problems} problems." if problems else f"No problems: every annotated file {tested}.")
    return 1 if problems else 0


@data.command(epilog=examples("data labels path/to/clone --root path/to/co3d"))
@click.argument("source", type=PATH)
@root_option
@replace_option
def labels(source, root, replace) -> None:
    """Import the published pose labels and evaluation pairs into a data folder.

    SOURCE is a local clone of the published repository, or what `zsp-lite align` has written. The published labels are
    those of CO3D v1 and do not fit v2: import them into a v1 folder, then use `zsp-lite data transfer`.
    """
    from zsp_lite.data.published import import_labels

    counts = import_labels(source, root, replace=replace)
    print(f"Written to {root}: {counts['class_labels']} labels, {counts['determ_eval']} files of pairs")


@data.command(epilog=examples("data transfer path/to/v1 path/to/v2 chair"))
@click.argument("v1", type=PATH)
@click.argument("v2", type=PATH)
@click.argument("category")
@replace_option
def transfer(v1, v2, category, replace) -> None:
    """Transfer labels from a CO3D v1 folder to a v2 folder by aligning the camera centres of the same frames."""
    from zsp_lite.data.transfer import transfer_labels

    residuals = transfer_labels(v1, v2, category, replace=replace)
    for name, residual in residuals.items():
        print(f"{name:24} camera centres differ by {100 * residual:.2f} % of their spread")
    print(f"Written: {len(residuals)} labels of {category} in {v2}")


@data.command("import", epilog=examples("data import lists scan --root mine --category cup --sequence one"))
@click.argument("layout", type=click.Choice(("nerfstudio", "lists")))
@click.argument("folder", type=PATH)
@root_option
@click.option("--category", metavar="NAME", required=True, help="Category of the object.")
@click.option("--sequence", metavar="NAME", required=True, help="Name of the new sequence.")
@click.option("--box", type=BOX, help="Bounding box of the object in the first image in pixels.")
@click.option("--masks", type=PATH, help="Folder of mask files named like the images, instead of --box.")
@click.option("--frames", type=COUNT, default=100, help="Maximum number of frames, evenly spaced.")
@click.option("--depth-unit", type=LENGTH, show_default="0.001", help="World units per stored depth value, for lists.")
def import_(layout, folder, root, category, sequence, box, masks, frames, depth_unit) -> None:
    """Import an RGB-D capture, images with depth and camera poses in one world, as a sequence of a data folder.

    The first argument is the format of FOLDER, which holds:

    \b
      nerfstudio  transforms.json         intrinsics, and per frame file_path, depth_file_path and
                                          transform_matrix; phone scanners export it; depth in mm,
                                          or depth_unit_scale_factor; mask_path is used if present
      lists       rgb.txt, depth.txt      one file per line; depth as 16-bit PNG or .npy
                  masks/                  if present, mask files named like the images
                  poses.txt               lines of 12 or 16 numbers: camera to world, OpenCV's axes
                  intrinsics.txt          3 x 3 matrix in pixels, pixel centres at half-integers
                  --depth-unit            metres per stored depth value, 0.001 by default

    Depth maps must be registered to the images: a pixel of both shows the same point. The object is given by --box, by
    which GrabCut segments it in all images, by --masks, or by masks of the capture; frames without it are left out.
    """
    from zsp_lite.importers import READERS, import_capture

    given = {} if depth_unit is None else {"depth_unit": depth_unit}
    refuse_options({"masks": box and masks}, (), "--box")
    refuse_options(given, ("depth_unit",) if layout == "lists" else (), f"the format {layout}")
    capture = READERS[layout](folder, **given)
    done = import_capture(capture, root, category, sequence, box, masks, frames)
    print(
        f"Written: {root / category / sequence}: {done.frames} frames, {done.points:,} points, "
        f"scaled by {done.scale:.4g}" + (f"; {done.empty} frames without the object left out" if done.empty else "")
    )
    for flag in done.flags:
        print(f"flag: {flag}")
