"""The commands for data: `data check`, `data labels`, `data transfer`, `data import`.

`data download` is in `zsp_lite.cli.download`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from zsp_lite.cli.common import (
    COUNT,
    PATH,
    examples,
    four_integers,
    four_numbers,
    positive,
    replace_option,
)
from zsp_lite.errors import InputError

if TYPE_CHECKING:
    from zsp_lite.data.check import CategoryCheck


@click.group(
    no_args_is_help=False,
    subcommand_metavar="ACTION ...",
    epilog=examples(
        "data download co3d --category toaster --single-sequence",
        "data check path/to/co3d",
        "data labels path/to/clone --root path/to/co3d",
        "data transfer path/to/v1 path/to/v2 chair",
        "data import nerfstudio path/to/scan --root mine --category cup --sequence cup_1 --box 120,200,300,280",
    ),
)
def data() -> None:
    """Download or check CO3D, import labels or captures, transfer labels from CO3D v1 to v2."""


@data.command(epilog=examples("data check path/to/co3d", "data check path/to/co3d --deep"))
@click.argument("root", type=PATH)
@click.option("--deep", is_flag=True, help="Also decode every file; slow on large folders.")
@click.option("--show", type=COUNT, metavar="N", default=5, help="Problems printed per category.")
@click.option("--partial", is_flag=True, help="A sequence without any file is not a problem: it was not downloaded.")
def check(root: Path, deep: bool, show: int, partial: bool) -> int:
    """Report missing or broken files, the number of pairs that can be evaluated, and the size on disk.

    The exit code is 1 if there is any problem.
    """
    from tqdm import tqdm

    from zsp_lite.data.check import check_folder

    checks = check_folder(root, deep, lambda names: tqdm(names, "checking", disable=None), partial=partial)
    return print_checks(root, checks, deep, show)


def print_checks(root: Path, checks: "Sequence[CategoryCheck]", deep: bool, show: int) -> int:
    """Print the results of `check_folder`.

    Args:
        root: The data folder.
        checks: The results.
        deep: Whether files were decoded.
        show: Problems printed per category.

    Returns:
        Exit code: 1 if there is any problem, else 0.
    """
    from rich.console import Console
    from rich.filesize import decimal
    from rich.table import Table

    table = Table(title=f"{root}: {len(checks)} categories, {decimal(sum(check.size for check in checks))}")
    for column in ("category", "layout", "sequences", "complete", "labelled", "usable", "pairs", "frames", "disk"):
        table.add_column(column, justify="left" if column in ("category", "layout") else "right", no_wrap=True)
    for check in checks:
        counts = (check.sequences, check.complete, check.labelled, check.usable, check.pairs, check.frames)
        table.add_row(check.category, check.layout, *(f"{count:,}" for count in counts), decimal(check.size))
    Console(width=max(Console().width, 100), markup=False).print(table)
    for check in checks:
        if check.absent:
            print(f"{check.category}: {check.absent:,} of {check.sequences:,} annotated sequences are not downloaded")
        if check.labelled > check.usable:
            print(f"{check.category}: {check.usable} of {check.labelled} labelled sequences can be evaluated")
        if check.defects:
            kinds = ", ".join(f"{kind} {count:,}" for kind, count in sorted(check.defects.items()))
            print(f"{check.category}: {check.defects.total():,} frames cannot be used ({kinds})")
        for problem in check.problems[:show]:
            print(f"{check.category}: {problem}")
        if (more := len(check.problems) - show) > 0:
            print(f"{check.category}: and {more} more")
    problems = sum(len(check.problems) for check in checks)
    tested = "can be decoded" if deep else "exists and is not empty (--deep decodes them)"
    print(f"{problems} problems." if problems else f"No problems: every annotated file {tested}.")
    return 1 if problems else 0


@data.command(
    epilog=examples(
        "data labels path/to/clone --root path/to/co3d",
        "data labels https://HOST/archive.zip --sha256 DIGEST --root path/to/co3d",
    )
)
@click.argument("source")
@click.option("--root", type=PATH, metavar="DIR", required=True, help="Data folder.")
@click.option("--sha256", metavar="DIGEST", help="Digest of the archive; required with a URL.")
@replace_option
def labels(source: str, root: Path, sha256: str | None, replace: bool) -> None:
    """Import the published pose labels and evaluation pairs into a data folder.

    SOURCE is a local clone of the published repository, an archive of it, or the URL of an archive.
    """
    from zsp_lite.data.label_import import import_labels, labelled_v2_categories

    counts = import_labels(source, root, sha256, replace)
    print(f"Written to {root}: {counts['class_labels']} labels, {counts['determ_eval']} files of pairs")
    if v2 := labelled_v2_categories(root):
        print(
            f"Note: {', '.join(v2)} in {root} is CO3D v2. The published labels and pairs are of v1, whose coordinates "
            "and frames differ: import them into a v1 folder, then use `zsp-lite data transfer`."
        )


@data.command(epilog=examples("data transfer path/to/v1 path/to/v2 chair"))
@click.argument("source", type=PATH, metavar="V1")
@click.argument("target", type=PATH, metavar="V2")
@click.argument("category")
@click.option(
    "--max-residual", type=positive, metavar="SHARE", default=0.05,
    help="Largest difference of the camera centres, as a share of their spread.",
)  # fmt: skip
@replace_option
def transfer(source: Path, target: Path, category: str, max_residual: float, replace: bool) -> None:
    """Transfer labels from a CO3D v1 folder to a v2 folder by aligning the camera centres of the same frames."""
    from zsp_lite.data.label_import import transfer_labels

    residuals = transfer_labels(source, target, category, max_residual, replace)
    for name, residual in residuals.items():
        print(f"{name:24} camera centres differ by {100 * residual:.2f} % of their spread")
    print(f"Written: {len(residuals)} labels of {category} in {target}")


@data.command(
    "import",
    epilog=examples(
        "data import tum path/to/scan --root mine --category cup --sequence cup_1 --box 120,200,300,280",
        "data import open3d path/to/scan --root mine --category cup --sequence cup_2 --masks path/to/masks",
    ),
)
@click.argument("layout", type=click.Choice(("tum", "nerfstudio", "open3d", "lists")))
@click.argument("folder", type=PATH)
@click.option("--root", type=PATH, metavar="DIR", required=True, help="Data folder, new or existing.")
@click.option("--category", metavar="NAME", required=True, help="Category of the object.")
@click.option("--sequence", metavar="NAME", required=True, help="Name of the new sequence.")
@click.option(
    "--box", type=four_integers, metavar="T,L,H,W",
    help="Bounding box of the object in the first image in pixels: top, left, height, width. GrabCut segments the "
    "object in all images.",
)  # fmt: skip
@click.option("--masks", type=PATH, metavar="DIR", help="Folder of mask files named like the images, instead of --box.")
@click.option("--frames", type=COUNT, metavar="N", default=100, help="Maximum number of frames, evenly spaced.")
@click.option(
    "--intrinsics", type=four_numbers, metavar="FX,FY,CX,CY", show_default="those of the TUM benchmark",
    help="Camera intrinsics of a tum folder in pixels, with pixel centres at half-integers.",
)  # fmt: skip
@click.option(
    "--depth-unit", type=positive, metavar="M", show_default="0.001",
    help="World units per stored depth value, for lists.",
)  # fmt: skip
def import_(
    layout: str, folder: Path, root: Path, category: str, sequence: str, box: tuple[int, ...] | None,
    masks: Path | None, frames: int, intrinsics: tuple[float, ...] | None, depth_unit: float | None,
) -> None:  # fmt: skip
    """Import an RGB-D capture, images with depth and camera poses in one world, as a sequence of a data folder.

    The first argument is the format of FOLDER, which holds:

    \b
      tum         rgb.txt, depth.txt      lines: time file; depth in 1/5000 m
                  groundtruth.txt         lines: time tx ty tz qx qy qz qw, camera to world
                  --intrinsics            of the camera, if it is not the benchmark's default
      nerfstudio  transforms.json         intrinsics, and per frame file_path, depth_file_path and
                                          transform_matrix; phone scanners export it; depth in mm,
                                          or depth_unit_scale_factor; mask_path is used if present
      open3d      color/, depth/          images and 16-bit depth in mm, sorted by the numbers in
                                          their names
                  camera_intrinsic.json   as Open3D writes it, pixel centres at integers
                  trajectory.log          camera to world, one pose per image
      lists       rgb.txt, depth.txt      one file per line; depth as 16-bit PNG or .npy
                  masks/                  if present, mask files named like the images
                  poses.txt               lines of 12 or 16 numbers: camera to world, OpenCV's axes
                  intrinsics.txt          3 x 3 matrix in pixels, pixel centres at half-integers
                  --depth-unit            metres per stored depth value, 0.001 by default

    Depth maps must be registered to the images: a pixel of both shows the same point. The object is given by --box, by
    --masks, or by masks of the capture itself; frames without it are left out.
    """
    from zsp_lite.importers import READERS, import_capture

    given = {"intrinsics": intrinsics, "depth_unit": depth_unit}
    options = {name: value for name, value in given.items() if value is not None}
    allowed = {"tum": "intrinsics", "lists": "depth_unit"}.get(layout)
    if wrong := sorted(set(options) - {allowed}):
        raise InputError(f"--{wrong[0].replace('_', '-')} does not go with the format {layout}")
    capture = READERS[layout](folder, **options)
    done = import_capture(capture, root, category, sequence, box, masks, frames)
    print(
        f"Written: {root / category / sequence}: {done.frames} frames, {done.points:,} points, "
        f"scaled by {done.scale:.4g}" + (f"; {done.empty} frames without the object left out" if done.empty else "")
    )
