"""The command `data download`: sizes and confirmation, download, labels, check."""

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from zsp_lite.cli.common import COUNT, PATH, examples, refuse_options
from zsp_lite.cli.data import print_checks
from zsp_lite.errors import InputError

LICENCE = "CO3D is under CC BY-NC 4.0: no commercial use."


@click.command(
    epilog=examples(
        "data download co3d --category toaster --single-sequence",
        "data download co3d --category toaster --chunks 1",
        "data download co3d-v1 --category toaster --labels path/to/clone --labelled-only --root path/to/co3d",
    )
)
@click.argument("dataset", type=click.Choice(("co3d", "co3d-v1")))
@click.option("--category", "categories", metavar="NAME", multiple=True, required=True, help="May be repeated.")
@click.option("--single-sequence", is_flag=True, help="co3d: a few sequences of each category, about 0.2 GB.")
@click.option("--chunks", type=COUNT, show_default="all", help="co3d: only the first N archives of each category.")
@click.option("--root", type=PATH, show_default="the name of the data set", help="Data folder.")
@click.option("--labels", type=PATH, help="co3d-v1: also import labels and pairs, as `data labels` does.")
@click.option("--labelled-only", is_flag=True, help="With --labels: only labelled sequences, about 0.75 GB a category.")
@click.option("--yes", is_flag=True, help="Download without asking.")
def download(dataset, categories, single_sequence, chunks, root, labels, labelled_only, yes) -> int:
    """Download categories of CO3D from its official server, check them, and import labels.

    DATASET is co3d (version 2, in chunks of up to 20 GB) or co3d-v1 (the version of the paper and of its labels, one
    archive for each category). The sizes are shown and confirmed first. An interrupted download is resumed by the same
    command. With --labelled-only, sequences are read out of the archive on the server. The environment variables
    ZSP_LITE_CO3D_URL and ZSP_LITE_CO3D_V1_URL give the address of a mirror.
    """
    from zsp_lite.data import archives as co3d
    from zsp_lite.data.check import check_folder
    from zsp_lite.data.published import import_labels, published_sequences

    if dataset == "co3d-v1":
        refuse_options({"single_sequence": single_sequence, "chunks": chunks}, (), dataset)
    else:
        refuse_options({"labels": labels}, (), f"{dataset}: labels are of v1 (see `zsp-lite data transfer`)")
    if labelled_only and not labels:
        raise click.UsageError("--labelled-only goes with --labels")

    root = root or Path(dataset)
    categories = tuple(dict.fromkeys(categories))
    archives = [one for name in categories for one in co3d.list_archives(dataset, name, single_sequence, chunks)]
    if labelled_only:
        labelled = published_sequences(labels, categories)
        archives = [replace(one, sequences=labelled[one.category]) for one in archives]
    missing = co3d.missing_archives(root, archives)
    sizes = [co3d.download_size(one) for one in missing]
    if not missing:
        print(f"{root}: everything is unpacked already")
    elif not _confirmed(missing, sizes, co3d.check_disk(root, missing, sizes), root, yes):
        print("Nothing was downloaded.")
        return 1
    else:
        co3d.download_archives(root, missing)
    if labels:
        counts = import_labels(labels, root, categories=categories)
        print(f"Imported: {counts['class_labels']} labels, {counts['determ_eval']} files of pairs")
    some = chunks is not None or labelled_only
    return print_checks(root, check_folder(root, categories=categories, partial=some), deep=False)


def _confirmed(archives: Sequence[Any], sizes: Sequence[int | None], needed: int, root: Path, yes: bool) -> bool:
    """Print the sizes of the archives and of what they need on the disk, bytes, and ask whether to download them."""
    from zsp_lite.cli.terminal import print_rows

    names = [f"{len(one.sequences)} sequences of {one.name}" if one.sequences else one.name for one in archives]
    rows = [(name, "unknown" if size is None else f"{size / 1e9:,.2f} GB") for name, size in zip(names, sizes)]
    print_rows("To download", ("archive", "size"), [*rows, ("together", f"{sum(filter(None, sizes)) / 1e9:,.2f} GB")])
    print(f"Needed on the disk of {root}: {needed / 1e9:.2f} GB. {LICENCE}")
    if not yes and not sys.stdin.isatty():
        raise InputError("nobody can confirm the download: standard input is not a terminal, expected --yes")
    return yes or click.confirm("Download?")
