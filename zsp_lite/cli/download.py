"""The command `data download`: sizes and confirmation, download, labels, check."""

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import click

from zsp_lite.cli.common import COUNT, PATH, examples
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
@click.option(
    "--category", "categories", metavar="NAME", multiple=True, required=True, help="A category. May be repeated."
)
@click.option("--single-sequence", is_flag=True, help="co3d: a few sequences of each category, about 0.2 GB.")
@click.option(
    "--chunks", type=COUNT, metavar="N", show_default="all", help="co3d: only the first N archives of each category."
)
@click.option("--root", type=PATH, metavar="DIR", show_default="the name of the data set", help="Data folder.")
@click.option(
    "--labels", metavar="SOURCE",
    help="co3d-v1: also import the published pose labels and evaluation pairs, from what `data labels` accepts.",
)  # fmt: skip
@click.option("--sha256", metavar="DIGEST", help="Digest of the archive of --labels; required with a URL.")
@click.option(
    "--labelled-only", is_flag=True,
    help="With --labels: read only the labelled sequences out of the archive on the server, about 0.75 GB a category.",
)  # fmt: skip
@click.option("--yes", is_flag=True, help="Download without asking.")
def download(
    dataset: str, categories: tuple[str, ...], single_sequence: bool, chunks: int | None, root: Path | None,
    labels: str | None, sha256: str | None, labelled_only: bool, yes: bool,
) -> int:  # fmt: skip
    """Download categories of CO3D from its official server, check them, and import labels.

    DATASET is co3d (version 2, in chunks of up to 20 GB) or co3d-v1 (the version of the paper and of its labels, one
    archive for each category). The sizes are shown and confirmed first. An interrupted download is resumed by the same
    command. The environment variables ZSP_LITE_CO3D_URL and ZSP_LITE_CO3D_V1_URL give the address of a mirror.
    """
    from tqdm import tqdm

    from zsp_lite.data import archives as co3d
    from zsp_lite.io.remote import remote_size

    if labels and dataset != "co3d-v1":
        raise InputError(
            "--labels goes with co3d-v1: the published labels and pairs are of CO3D v1, and v2 has other coordinates "
            "and frames; `zsp-lite data transfer` copies labels from v1 to v2"
        )
    if labelled_only and not labels:
        raise InputError("--labelled-only goes with --labels")

    def unpacking(members: Sequence) -> Iterable:
        return tqdm(members, "unpacking", disable=None)

    root = root or Path(dataset)
    categories = tuple(dict.fromkeys(categories))
    archives = [one for name in categories for one in co3d.list_archives(dataset, name, single_sequence, chunks)]
    if labelled_only:
        from zsp_lite.data.label_import import published_sequences

        labelled = published_sequences(labels, sha256, categories)
        for name in categories:
            if not labelled.get(name):
                raise InputError(f"category {name!r} has no labels in {labels}, expected class_labels/{name}/SEQ.json")
        wanted = {one: co3d.missing_sequences(root, one, labelled.get(one.category, ())) for one in archives}
        missing = [one for one in archives if wanted[one]]
        sizes = [co3d.sequence_size(one, wanted[one]) for one in missing]
        names = [f"{len(wanted[one])} sequences of {one.name}" for one in missing]
    else:
        missing = co3d.missing_archives(root, archives)
        sizes, names = [remote_size(one.url) for one in missing], [one.name for one in missing]
    if missing:
        _print_sizes(names, sizes)
        needed = co3d.check_disk(root, missing, sizes, whole=not labelled_only)
        print(f"Needed on the disk of {root}: {needed / 1e9:.2f} GB. {LICENCE}")
        if not yes and not _confirmed("Download? [y/N] "):
            print("Nothing was downloaded.")
            return 1
        if labelled_only:
            for archive in missing:
                co3d.download_sequences(root, archive, wanted[archive], unpacking)
        else:
            co3d.download_archives(root, archives, unpacking)
    else:
        print(f"{root}: everything is unpacked already")
    if labels:
        from zsp_lite.data.label_import import import_labels

        counts = import_labels(labels, root, sha256, categories=categories)
        print(f"Imported: {counts['class_labels']} labels, {counts['determ_eval']} files of pairs")
    from zsp_lite.data.check import check_folder

    partial = chunks is not None or labelled_only
    checks = check_folder(root, False, lambda names: tqdm(names, "checking", disable=None), categories, partial)
    return print_checks(root, checks, deep=False, show=5)


def _print_sizes(names: Sequence[str], sizes: Sequence[int | None]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table()
    table.add_column("archive", no_wrap=True)
    table.add_column("size", justify="right", no_wrap=True)
    for name, size in zip(names, sizes, strict=True):
        table.add_row(name, "not told" if size is None else f"{size / 1e9:,.2f} GB")
    table.add_section()
    table.add_row("together", f"{sum(size or 0 for size in sizes) / 1e9:,.2f} GB")
    Console(markup=False).print(table)


def _confirmed(question: str) -> bool:
    if not sys.stdin.isatty():
        raise InputError("nobody can confirm the download: standard input is not a terminal, expected --yes")
    try:
        return input(question).strip().lower() in ("y", "yes")
    except EOFError as error:
        raise InputError("standard input is closed, expected --yes") from error
