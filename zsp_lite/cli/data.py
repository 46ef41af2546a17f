"""The commands for data:

`data check`, `data download`, `data labels`, `data transfer`, `data import`.
"""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from zsp_lite.cli.common import (
    COUNT,
    NAMES,
    PATH,
    Once,
    category_option,
    examples,
    refuse_options,
    replace_option,
    source_options,
)
from zsp_lite.errors import InputError

_CHECK_COLUMNS = (
    "category",
    "layout",
    "sequences",
    "complete",
    "labelled",
    "usable",
    "pairs",
    "frames",
    "disk",
)
root_option = click.option("--root", type=PATH, required=True, help="Data folder.")


@click.group(
    no_args_is_help=False, epilog=examples("data check path/to/co3d", "data import --help")
)
def data() -> None:
    """Download or check CO3D, import captures or labels."""


@data.command(epilog=examples("data check path/to/co3d", "data check path/to/co3d --deep"))
@click.argument("root", type=PATH)
@click.option("--deep", is_flag=True, help="Also decode every file; slow on large folders.")
@click.option(
    "--partial",
    is_flag=True,
    help="A sequence without any file is not a problem: it was not downloaded.",
)
def check(root, deep, partial) -> int:
    """Report missing or broken files.

    The number of files of evaluation pairs and the size on disk are shown, too. The exit code is 1
    if there is any problem.
    """
    from zsp_lite.data.check import check_folder

    return _print_checks(root, check_folder(root, deep, partial=partial))


def _print_checks(root: Path, checks: Sequence[Any]) -> int:
    """Print the results of `check_folder`; return the exit code, which is 1 if there is a
    problem."""
    from rich.filesize import decimal

    from zsp_lite.cli.terminal import print_rows

    rows = []
    lines = []
    for found in checks:
        counts = (f"{getattr(found, name):,}" for name in _CHECK_COLUMNS[2:-1])
        rows.append((found.category, found.layout, *counts, decimal(found.size)))
        kinds = ", ".join(f"{kind} {count:,}" for kind, count in sorted(found.defects.items()))
        counted = [
            (found.absent, found.sequences, "annotated sequences are not downloaded"),
            (
                found.labelled - found.usable,
                found.labelled,
                "labelled sequences cannot be evaluated",
            ),
            (found.cloudless, found.sequences, "sequences have no point cloud"),
            (found.defects.total(), found.frames, f"frames cannot be used ({kinds})"),
        ]
        messages = [f"{count:,} of {total:,} {what}" for count, total, what in counted if count > 0]
        messages += found.problems[:5]  # there may be thousands
        lines += [f"{found.category}: {message}" for message in messages]
    size = decimal(sum(found.size for found in checks))
    print_rows(f"{root}: {len(checks)} categories, {size}", _CHECK_COLUMNS, rows, texts=2)
    problems = sum(len(found.problems) for found in checks)
    print(*lines, f"{problems} problems." if problems else "No problems.", sep="\n")
    return 1 if problems else 0


@data.command(
    epilog=examples(
        "data download co3d --category toaster --single-sequence",
        "data download co3d-v1 --category toaster --labels path/to/clone --labelled-only "
        "--root path/to/co3d",
    )
)
@click.argument("dataset", type=click.Choice(("co3d", "co3d-v1")))
@click.option(
    "--category",
    "categories",
    metavar="NAME",
    multiple=True,
    required=True,
    help="May be repeated.",
)
@click.option(
    "--single-sequence", is_flag=True, help="co3d: a few sequences of each category, about 0.2 GB."
)
@click.option(
    "--chunks",
    type=COUNT,
    show_default="all",
    help="co3d: only the first N archives of each category.",
)
@click.option("--root", type=PATH, show_default="the name of the data set", help="Data folder.")
@click.option(
    "--labels", type=PATH, help="co3d-v1: also import labels and pairs, as `data labels` does."
)
@click.option(
    "--labelled-only",
    is_flag=True,
    help="With --labels: only labelled sequences, about 0.75 GB a category.",
)
@click.option("--yes", is_flag=True, help="Download without asking.")
def download(dataset, categories, single_sequence, chunks, root, labels, labelled_only, yes) -> int:
    """Download categories of CO3D, check them, and import labels.

    DATASET is co3d (version 2, in chunks of up to 20 GB) or co3d-v1 (the version of the paper and
    of its labels, one archive for each category), from the official server. The sizes are shown and
    confirmed first. An interrupted download is resumed by the same command. With --labelled-only,
    sequences are read out of the archive on the server. The environment variables ZSP_LITE_CO3D_URL
    and ZSP_LITE_CO3D_V1_URL give the address of a mirror.
    """
    from zsp_lite.data.archives import (
        check_disk,
        download_archives,
        download_size,
        list_archives,
        missing_archives,
    )
    from zsp_lite.data.check import check_folder
    from zsp_lite.data.published import import_labels, published_sequences

    if dataset == "co3d-v1":
        refuse_options({"single_sequence": single_sequence, "chunks": chunks}, (), dataset)
    else:
        refuse_options(
            {"labels": labels}, (), f"{dataset}: labels are of v1 (see `zsp-lite data transfer`)"
        )
    if labelled_only and not labels:
        raise click.UsageError("--labelled-only goes with --labels")

    root = root or Path(dataset)
    categories = tuple(dict.fromkeys(categories))
    archives = []
    for name in categories:
        archives += list_archives(dataset, name, single_sequence, chunks)
    if labelled_only:
        labelled = published_sequences(labels, categories)
        archives = [
            dataclasses.replace(archive, sequences=labelled[archive.category])
            for archive in archives
        ]
    missing = missing_archives(root, archives)
    sizes = [download_size(archive) for archive in missing]
    if not missing:
        print(f"{root}: everything is unpacked already")
    elif not _confirmed(missing, sizes, check_disk(root, missing, sizes), root, yes):
        print("Nothing was downloaded.")
        return 1
    else:
        download_archives(root, missing)
    if labels:
        counts = import_labels(labels, root, categories=categories)
        print(f"Imported: {counts['class_labels']} labels, {counts['determ_eval']} files of pairs")
    partial = chunks is not None or labelled_only
    return _print_checks(root, check_folder(root, categories=categories, partial=partial))


def _confirmed(
    archives: Sequence[Any], sizes: Sequence[int | None], needed: int, root: Path, yes: bool
) -> bool:
    """Print the sizes of the archives and the room that they need on the disk, in bytes, and ask
    whether to download them."""
    for archive, size in zip(archives, sizes):
        part = f"{len(archive.sequences)} sequences of " if archive.sequences else ""
        shown = "unknown size" if size is None else f"{size / 1e9:,.2f} GB"
        print(f"{part}{archive.name}: {shown}")
    print(f"To download: {sum(filter(None, sizes)) / 1e9:,.2f} GB.")
    print(
        f"Needed on the disk of {root}: {needed / 1e9:,.2f} GB. "
        "CO3D is under CC BY-NC 4.0: no commercial use."
    )
    if not yes and not sys.stdin.isatty():
        raise InputError(
            "nobody can confirm the download: standard input is not a terminal, expected --yes"
        )
    return yes or click.confirm("Download?")


@data.command(epilog=examples("data labels path/to/clone --root path/to/co3d"))
@click.argument("source", type=PATH)
@root_option
@replace_option
def labels(source, root, replace) -> None:
    """Import published pose labels and evaluation pairs.

    SOURCE is a local clone of the published repository, or what `zsp-lite align` has written. The
    published labels are those of CO3D v1 and do not fit v2: import them into a v1 folder, then use
    `zsp-lite data transfer`.
    """
    from zsp_lite.data.published import import_labels

    counts = import_labels(source, root, replace=replace)
    print(
        f"Written to {root}: {counts['class_labels']} labels, {counts['determ_eval']} files "
        "of pairs"
    )


@data.command(epilog=examples("data transfer path/to/v1 path/to/v2 chair"))
@click.argument("v1", type=PATH)
@click.argument("v2", type=PATH)
@click.argument("category")
@replace_option
def transfer(v1, v2, category, replace) -> None:
    """Transfer labels from a CO3D v1 folder to a v2 folder. The camera centres of the same frames
    are aligned."""
    from zsp_lite.data.published import transfer_labels

    residuals = transfer_labels(v1, v2, category, replace=replace)
    for name, residual in residuals.items():
        print(f"{name:24} camera centres differ by {100 * residual:.2f} % of their spread")
    print(f"Written: {len(residuals)} labels of {category} in {v2}")


class _Import(Once):
    """The command `data import`; `data import uco3d` is another command, with its own arguments."""

    def make_context(self, info_name, args, parent=None, **extra):
        if args[:1] == ["uco3d"]:
            return uco3d.make_context(f"{info_name} uco3d", args[1:], parent, **extra)
        return super().make_context(info_name, args, parent, **extra)


@data.command(
    "import",
    cls=_Import,
    epilog=examples(
        "data import scan.zip --root mine --category cup --sequence one --mask auto",
        "data import uco3d --help",
    ),
)
@click.argument("scan", type=PATH)
@root_option
@category_option
@click.option("--sequence", metavar="NAME", required=True, help="Name of the new sequence.")
@source_options(multiple=False)
@click.option(
    "--masks", type=PATH, help="Folder of mask files named like the images, instead of --box."
)
@click.option(
    "--frames",
    "count",
    type=COUNT,
    default=100,
    help="Maximum number of frames, evenly spaced and sharp.",
)
def import_(scan, root, category, sequence, mask, box, **options) -> None:
    """Import an RGB-D capture as a sequence of a data folder.

    A capture is images with depth and camera poses in one world. SCAN is a folder, or the zip file
    that an app has exported. Its format is recognised: nerfstudio (also of Blender, NeRFCapture and
    instant-ngp), stray (Stray Scanner), polycam (its raw data), record3d, tum
    (RGB-D benchmark), bop, scannet, open3d (recorder, with the trajectory of its reconstruction),
    recording (rgb/ or color/, and depth/, whose poses Open3D finds), or lists of your own:

    \b
      rgb.txt, depth.txt  one file per line; depth as 16-bit PNG, TIFF, .npy, ...
      poses.txt           lines of 12 or 16 numbers: camera to world, OpenCV's axes
      intrinsics.txt      3 x 3 matrix in pixels, or fx fy cx cy and OpenCV's distortion k1 k2 p1
                          p2 [k3], if any, once or in each line; pixel centres at half-integers

    Depth maps must be registered to the images: a pixel of both shows the same point. The object is
    given by --box, by which GrabCut segments it in all images, by --masks, or by masks of the
    capture, in masks/ with the names of the images; frames without it are left out. --mask auto
    finds it by depth and colours, as is done for single frames without a mask, too.

    `data import uco3d ROOT --category NAME --out DATA` imports many sequences of uCO3D.
    """
    from zsp_lite.importers.convert import import_source
    from zsp_lite.importers.sources import open_source

    refuse_options(
        {"masks": options["masks"] and (box or mask == "auto")}, (), "--box or --mask auto"
    )
    mask = mask or ("box" if box else "given")
    opened = open_source(scan, mask=mask, box=box, **options)
    _print_import(root / category / sequence, import_source(opened, root, category, sequence))


_BEST = 10  # number of sequences that are imported by default


@click.command(
    epilog=examples(
        "data import uco3d path/to/uco3d --category mug --out mugs",
        "data import uco3d path/to/uco3d --category mug --best 20 --frames 50 --out mugs",
    )
)
@click.argument("root", type=PATH)
@category_option
@click.option("--sequences", type=NAMES, show_default="--best", help="Names of the sequences.")
@click.option(
    "--best",
    type=COUNT,
    show_default=str(_BEST),
    help="Number of sequences, those with the best cameras.",
)
@click.option("--frames", "count", type=COUNT, default=24, help="Frames of each sequence.")
@click.option("--out", type=PATH, required=True, help="Data folder.")
def uco3d(root, category, sequences, best, count, out) -> None:
    """Import sequences of uCO3D into a data folder, with its alignment as proposed pose labels.

    ROOT is the folder in which uCO3D's script has put metadata.sqlite and the sequences; needs
    `pip install h5py`. Sequences that are in the data folder already stay as they are.
    """
    from zsp_lite.importers.uco3d import import_uco3d

    refuse_options({"best": sequences and best}, (), "--sequences")
    for name, imported in import_uco3d(root, out, category, sequences, best or _BEST, count):
        _print_import(out / category / name, imported)


def _print_import(folder: Path, imported: Any) -> None:
    """Print the numbers of an `ImportResult`."""
    print(
        f"Written: {folder}: {imported.frames} frames, {imported.points:,} points, "
        f"scaled by {imported.scale:.4g}{imported.size}"
    )
    for flag in imported.flags:
        print(f"flag: {flag}")
