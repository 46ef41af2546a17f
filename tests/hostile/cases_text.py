"""Names that mean something to a terminal, to TeX, to HTML or to Markdown, and names that are not UTF-8."""

import gzip
import json

import cv2
import numpy as np

from tests.hostile.cases_runs import _results, _write
from tests.hostile.harness import Wrong, case, command
from zsp_lite.benchmark.formats import as_csv, as_html, as_latex, as_markdown
from zsp_lite.benchmark.reports import write_reports
from zsp_lite.benchmark.summary import summarise_rows
from zsp_lite.benchmark.tables import every_table
from zsp_lite.cli.terminal import print_tables
from zsp_lite.viz.plots import show_images

NAMES = ("[/1]", "[red]x[/blue]", "$x_$", "$\\frac{$", "a_b^c", "%d {0} {x}", "<script>alert(1)</script>", "| a | b |",
         "\\textbf{", "&amp;", "\udcff\udcfe", "a\nb", "\x1b[31mred", "\u202eabc", "x" * 300, "#~{}")  # fmt: skip


def _named(name):
    """Results whose row, category and backbone have a name."""

    def change(content):
        content["pairs"] = [f"{name.replace('/', '')}/a:{i}/b:0,1" for i in range(4)]
        content["rows"][name] = content["rows"].pop("ours")
        content["settings"]["methods"] = {name: "m"}
        errors = content["rows"][name]["error"]
        rows = {name: {key: {"error": error} for key, error in zip(content["pairs"], errors)}}
        data = {"root": name, "categories": [name.replace("/", "")], "pairs": 4, "targets": 2, "seed": 0}
        content["summary"] = {"data": data, "backbone": name, **summarise_rows(rows)}

    return _results(change)


def _reports(folder, name):
    _write(_named(name))(folder)
    results = write_reports(folder / "r.json.gz", folder / "reports")
    print_tables(every_table(results.summary))
    for table in every_table(results.summary):
        for render in (as_csv, as_html, as_latex, as_markdown):
            text = render(table)
            if render is as_html and "<script>" in text:
                raise Wrong(f"script in {text[:200]}")
    return "written"


def _pictures(folder):
    """Two pictures of a disc with depth and mask, in a folder whose name is not UTF-8."""
    (folder / "\udcff").mkdir()
    y, x = np.mgrid[:64, :64]
    disc = (y - 32) ** 2 + (x - 32) ** 2 < 24**2
    depth = np.where(disc, 1000 + 4 * x + 2 * y, 0).astype(np.uint16)
    for name in ("a", "b"):
        picture = np.stack([4 * x, 4 * y, 2 * (x + y)], axis=-1).astype(np.uint8)
        for end, image in (("", picture), ("_depth", depth), ("_mask", 255 * disc.astype(np.uint8))):
            write_bytes = (folder / "\udcff" / f"{name}{end}.png").write_bytes
            write_bytes(cv2.imencode(".png", image)[1].tobytes())


command(
    "text", "estimate of pictures in a folder that is not UTF-8", "estimate", "ROOT/\udcff/a.png", "ROOT/\udcff/b.png",
    "--intrinsics", "60,60,32,32", "--solver", "paper", "--out", "ROOT/\udcff/out", codes=(0,), change=_pictures,
)  # fmt: skip

for name in NAMES:
    case("text", f"reports of a run with {name[:20]!r}", lambda folder, name=name: _reports(folder, name), answers=True)
    command("text", f"tables of a run with {name[:20]!r}", "tables", "ROOT/r.json.gz", codes=(0,),
            change=lambda folder, name=name: _write(_named(name))(folder))  # fmt: skip

    def titles(folder, name=name):
        figure, _ = show_images([[[0.0]]], [name])
        figure.savefig(folder / "x.png")
        return figure

    case("text", f"title {name[:20]!r}", titles, answers=True)

    def renamed(folder, name=name):
        new = name.replace("/", "")[:200]
        for parent in ("data", "data/class_labels"):
            (folder / parent / "cup").rename(folder / parent / new)
        for file in ("frame_annotations.jgz", "sequence_annotations.jgz"):
            path = folder / "data" / new / file
            text = gzip.decompress(path.read_bytes()).replace(b'"cup/', json.dumps(f"{new}/").encode()[:-1])
            path.write_bytes(gzip.compress(text.replace(b'"cup"', json.dumps(new).encode())))

    # 1 and 2: a name with a backslash, or one that JSON cannot hold.
    codes = (1, 2) if "\\" in name or "\udcff" in name else (0,)
    command(
        "text", f"data check of a category {name[:20]!r}", "data", "check", "ROOT/data", change=renamed, codes=codes
    )
    command("text", f"benchmark of a category {name[:20]!r}", "benchmark", "--data", "ROOT/data", "--pairs", "1", "--targets",
            "1", "--methods", "icp", "--out", "ROOT/out", change=renamed, codes=codes)  # fmt: skip
