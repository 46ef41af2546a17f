"""One case per class of failure: damaged, oversized and malicious files and options, for every reader and command."""

import functools
import gzip
import io
import json
import math
import struct
import subprocess
import sys
import zlib

import cv2
import numpy as np
import torch
from co3d_folders import sequence_data

from tests.hostile.harness import (
    BENCHMARK,
    CASES,
    RIGHT,
    STRANGE,
    Case,
    case,
    command,
    edited,
    gzip_bomb,
    strange,
    written,
)
from zsp_lite.backbones.load import load_backbone
from zsp_lite.benchmark.own import read_poses
from zsp_lite.data.co3d import Co3D, write_co3d
from zsp_lite.data.frames import read_depth, read_image, read_mask
from zsp_lite.data.labels import read_labels
from zsp_lite.data.pairs import shipped_pairs
from zsp_lite.data.published import import_labels
from zsp_lite.importers import READERS
from zsp_lite.io.ply import read_ply


def _frames(folder):
    data = Co3D(folder / "data")
    return data.load(data.frames("cup", "a")[0])


def _capture(layout):
    return lambda folder: [frame.load() for frame in READERS[layout](folder / "capture")]


FRAMES, SEQUENCES = "data/cup/frame_annotations.jgz", "data/cup/sequence_annotations.jgz"
PAIRS, LABEL, RESULTS = "data/determ_eval/1samples_2tgt/cup.pt", "data/class_labels/cup/b.json", "out/run.jsonl"
# Every reader, with the file that it reads.
READERS_OF = {
    "image": ("x.png", lambda folder: read_image(folder / "x.png")),
    "mask": ("x.png", lambda folder: read_mask(folder / "x.png")),
    "depth": ("x.png", lambda folder: read_depth(folder / "x.png")),
    "frame annotations": (FRAMES, _frames),
    "sequence annotations": (SEQUENCES, lambda folder: Co3D(folder / "data").sequences("cup")),
    "point cloud": ("x.ply", lambda folder: read_ply(folder / "x.ply")),
    "label": (LABEL, lambda folder: read_labels(folder / "data", "cup")),
    "pairs": (PAIRS, lambda folder: shipped_pairs(Co3D(folder / "data"), "cup", 2)),
    "labels to import": (
        "clone/class_labels/cup/c.json",
        lambda folder: import_labels(folder / "clone", folder / "data"),
    ),
    "checkpoint": ("x.pth", lambda folder: load_backbone(folder / "x.pth", "cpu")),
    "safetensors": ("x.safetensors", lambda folder: load_backbone(folder / "x.safetensors", "cpu")),
    "lists": ("capture/rgb.txt", _capture("lists")),
    "nerfstudio": ("capture/transforms.json", _capture("nerfstudio")),
    "poses": ("poses.csv", lambda folder: read_poses(folder / "poses.csv")),
}
COMMANDS_OF = {
    "picture": ("a.png", ("estimate", "ROOT/a.png", "ROOT/b.png", "--intrinsics", "60,60,32,32", "--out", "ROOT/e")),
    "results": (RESULTS, ("tables", "ROOT/out")),
    "packed results": (f"{RESULTS}.gz", ("tables", "ROOT/out")),
    "settings of results": ("out/run.json", ("tables", "ROOT/out")),
    "compared results": (RESULTS, ("compare", "ROOT/out", "ROOT/out")),
    "run to continue": ("out/run.jsonl", (*BENCHMARK, "--data", "ROOT/data", "--out", "ROOT/out")),
    "settings of a run": ("out/run.json", (*BENCHMARK, "--data", "ROOT/data", "--out", "ROOT/out")),
    "checked annotations": (FRAMES, ("data", "check", "ROOT/data")),
    "weights": ("x.safetensors", ("weights", "verify", "ROOT/x.safetensors")),
}
for kind in STRANGE:
    for what, (name, read) in READERS_OF.items():
        # Without a label or pairs, a category has none.
        if (what, kind) not in (
            ("label", "missing"),
            ("pairs", "missing"),
            ("pairs", "link to itself"),
        ):
            case("file", f"{what}: {kind}", read, strange(name, kind))
    for what, (name, argv) in COMMANDS_OF.items():
        codes = (1, 2) if what == "checked annotations" else (2,)
        if kind == "missing" and "run" in what or kind in ("missing", "link to itself") and what == "packed results":
            codes = (0, 2)
        command("file", f"{what}: {kind}", *argv, change=strange(name, kind), codes=codes)

# oversized
JPEG = cv2.imencode(".jpg", np.zeros((240, 320, 3), np.uint8))[1].tobytes()
_AT = JPEG.index(b"\xff\xc0") + 5


def png(width: int, height: int, depth: int = 8) -> bytes:
    chunks = ((b"IHDR", struct.pack(">IIBBBBB", width, height, depth, 0, 0, 0, 0)),
              (b"IDAT", zlib.compress(bytes(1 << 20), 9)), (b"IEND", b""))  # fmt: skip
    packed = (struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


def saved(content) -> bytes:
    buffer = io.BytesIO()
    torch.save(content() if callable(content) else content, buffer)
    return buffer.getvalue()


def safetensors(header: dict | bytes, data: bytes = b"") -> bytes:
    encoded = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(encoded)) + encoded + data


def _ply(count, body=b"", of="float") -> bytes:
    lines = "".join(f"property {of} {name}\n" for name in "xyz")
    return f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{lines}end_header\n".encode() + body


def _npy(shape, descr="<f8", data=b"") -> bytes:
    header = str({"descr": descr, "fortran_order": False, "shape": shape}).encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


DEEP = b"[" * 100_000
OVERSIZED = [
    ("image", JPEG[:_AT] + struct.pack(">HH", 65500, 65500) + JPEG[_AT + 4 :]), ("image", png(30_000, 30_000)),
    ("depth", png(100_000, 9_000, 16)), ("mask", png(2**31 - 1, 2**31 - 1)),
    ("frame annotations", gzip_bomb), ("frame annotations", lambda: gzip_bomb(start=b"[]")),
    ("sequence annotations", gzip.compress(DEEP)), ("label", DEEP), ("nerfstudio", DEEP),
    ("frame annotations", gzip.compress(b'[{"sequence_name": "a", "frame_number": ' + b"9" * 100_000 + b"}]")),
    ("point cloud", _ply(10**12, bytes(12))), ("point cloud", _ply(1, struct.pack("<ddd", 1e155, 1, 1), "double")),
    ("pairs", b"\x80\x02" + b"]" * 100_000 + b"."), ("labels to import", DEEP),
    ("safetensors", safetensors({"a": {"dtype": "F32", "shape": [10**12], "data_offsets": [0, 4]}}, bytes(4))),
    ("safetensors", safetensors(b'{"a":' * 100_000)), ("safetensors", struct.pack("<Q", 2**63) + b"{}"),
    ("checkpoint", saved({"blocks.100000000.norm1.weight": torch.zeros(64)})),
    ("lists", "x" * 20_000_000), ("lists", "\n" * 2_000_000),
]  # fmt: skip
for number, (what, data) in enumerate(OVERSIZED):
    name, read = READERS_OF[what]
    case("oversized", f"{what} {number}", read, written(name, data))
command("oversized", "results that are a gzip bomb", "tables", "ROOT/out", change=written(f"{RESULTS}.gz", gzip_bomb))
command("oversized", "data check of a gzip bomb", "data", "check", "ROOT/data", change=written(FRAMES, gzip_bomb),
        codes=(1,))  # fmt: skip
case("oversized", "depth map of 10^15 numbers", _capture("lists"), lambda folder: (
    written("capture/depth/0.npy", _npy((10**15,)))(folder), written("capture/depth.txt", "depth/0.npy\n")(folder)))  # fmt: skip


# malicious: code, and paths that lead out of a folder
class Code:
    def __reduce__(self):
        return open, ("executed", "w")


def _link(name, target):
    return lambda folder: ((folder / name).unlink(missing_ok=True), (folder / name).symlink_to(target))


MALICIOUS = [
    ("checkpoint", saved({"a": Code()})), ("pairs", saved([Code()])), ("lists", "../../../etc/passwd\n"),
    ("lists", "/etc/passwd\n"),
]  # fmt: skip
for number, (what, data) in enumerate(MALICIOUS):
    name, read = READERS_OF[what]
    case("malicious", f"{what} {number}", read, written(name, data))
case("malicious", "depth map of objects", _capture("lists"), lambda folder: (
    written("capture/depth/0.npy", _npy((1,), "|O", b"cos\nsystem\n(S'touch executed'\ntR."))(folder),
    written("capture/depth.txt", "depth/0.npy\n")(folder)))  # fmt: skip
for target in ("capture/rgb/0.png", "capture/rgb.txt"):
    case("malicious", f"{target} is a link out of the folder", _capture("lists"), _link(target, "/etc/passwd"))
for path in ("../../../etc/passwd", "/etc/passwd", "cup/a\0.jpg", "x/" * 50_000, "cup/frame_annotations.jgz"):
    case("malicious", f"image path {path[:30]!r}", _frames, edited(
        FRAMES, lambda content, path=path: [entry["image"].update(path=path) for entry in content]))  # fmt: skip
ON_DATA = (*BENCHMARK, "--data", "ROOT/data", "--out", "ROOT/new")
for option, value in (("--executor", "json:loads"), ("--executor", "dask://\0"), ("--metrics", "acc30,\0"),
                      ("--methods", "os:_exit"), ("--methods", "raises:now"), ("--methods", "a=/dev/zero/x.csv"),
                      ("--categories", "../.."), ("--backbone", "\0"), ("--list-pairs", "/dev/null/x")):  # fmt: skip
    command("malicious", f"benchmark {option} {value!r}", *ON_DATA, option, value, change=lambda folder: (
        sys.path.insert(0, str(folder)), written("raises.py", "raise SystemExit(3)")(folder)))  # fmt: skip

# damaged: values that no camera, label, pair, capture or result can have
BAD_FRAMES = {
    "T of 1e308": ("viewpoint", "T", [1e308, 0, 0]), "T infinite": ("viewpoint", "T", [math.inf, 0, 0]),
    "R mirrored": ("viewpoint", "R", np.diag([1, 1, -1]).tolist()), "size negative": ("image", "size", [-24, 32]),
    "focal length of 1e-300": ("viewpoint", "focal_length", [1e-300, 1e-300]), "another size": ("image", "size", [25, 32]),
    "unknown intrinsics": ("viewpoint", "intrinsics_format", "[red]$x_$"), "size of 10^30": ("image", "size", [10**30, 10**30]),
    "depth scale not a number": ("depth", "scale_adjustment", math.nan), "depth scale 0": ("depth", "scale_adjustment", 0.0),
    "mask path of a point cloud": ("mask", "path", "cup/a/pointcloud.ply"),
}  # fmt: skip
for name, (part, field, value) in BAD_FRAMES.items():
    change = edited(FRAMES, lambda content, p=part, f=field, v=value: [one[p].update({f: v}) for one in content])
    case("damaged", f"camera: {name}", _frames, change)
    command("damaged", f"data check: {name}", "data", "check", "ROOT/data", "--deep", change=change, codes=(1,))
for name, values in {"two references": {"reference_seq": "b"}, "mirrored": {"trans": np.diag([1.0, 1, -1, 1]).tolist()},
                     "of 1e300": {"trans": (1e300 * np.eye(4)).tolist()}, "of null": {"trans": None}}.items():  # fmt: skip
    change = edited(LABEL, lambda content, values=values: content.update(values))
    command("damaged", f"benchmark with a label {name}", *ON_DATA, change=change)
PAIR = {
    "class": "cup",
    "reference_seq_name": "a",
    "reference_frame_id": 0,
    "target_seq_name": "b",
    "all_target_id": [6, 7],
}
for values in ({"target_seq_name": "a", "all_target_id": [1, 2]}, {"all_target_id": [6]}, {"class": "../cup"},
               {"reference_frame_id": 10**30}, {"all_target_id": "67"}, {"target_seq_name": None}):  # fmt: skip
    command("damaged", f"data check of pairs with {values}", "data", "check", "ROOT/data", codes=(1,),
            change=written(PAIRS, functools.partial(saved, [PAIR | values])))  # fmt: skip
for name, text in {
    "poses.txt": "1 0 0 1e200 0 1 0 0 0 0 1 0\n",
    "intrinsics.txt": "1e300 0 16\n0 1e300 12\n0 0 1\n",
}.items():
    case("damaged", f"lists: {name}", _capture("lists"), written(f"capture/{name}", text))
for values in ({"fl_x": 1e-300}, {"w": 1e300}, {"w": 10**9, "h": 10**9}, {"w": math.nan}, {"k1": 1e300}, {"frames": []},
               {"depth_unit_scale_factor": 1e300}, {"camera_model": "[/1]"}):  # fmt: skip
    case("damaged", f"nerfstudio: {values}", _capture("nerfstudio"),
         edited("capture/transforms.json", lambda content, values=values: content.update(values)))  # fmt: skip
for values in ({"error": -5.0}, {"error": "5"}, {"error": math.nan}, {"error": None}, {"symmetric_error": 200.0},
               {"inliers": "yes"}, {"confidence": 2.0}, {"symmetric_error": -1}):  # fmt: skip
    command("damaged", f"results: {values}", "tables", "ROOT/out", change=edited(RESULTS, lambda lines, v=values: [
        line["results"]["icp"].update(v) for line in lines]))  # fmt: skip
command("damaged", "results: no pair", "tables", "ROOT/out", change=edited(RESULTS, lambda lines: [
    line.update(pair="cup") for line in lines]))  # fmt: skip
for name, change in {
    "no rows": lambda settings: settings["calls"][0].update(rows=[]),
    "no call": lambda settings: settings["calls"].clear(), "no library": lambda settings: settings.update(library=[]),
}.items():  # fmt: skip
    command("damaged", f"results: {name}", "tables", "ROOT/out", change=edited("out/run.json", change))

# options of every command
for argv in (
    (*ON_DATA, "--pairs", "100000000"), (*ON_DATA, "--targets", "1000000000"), (*ON_DATA, "--workers", "100000000000"),
    (*ON_DATA, "--layer", "block999999999"), (*ON_DATA, "--image-size", "1000000"),
    (*BENCHMARK, "--data", "a\0b"), (*BENCHMARK, "--data", "ROOT/data", "--out", "/dev/null/x"), ("benchmark", "--pairs", "٣x"),
    ("synth", "--category", "chair", "--sequences", "1000000000", "--out", "ROOT/new"), ("synth", "--preset", "\0", "--out", "ROOT/new"),
    ("synth", "--models", "ROOT/nothing", "--out", "ROOT/new"), ("demo", "--data", "\udcff"), ("demo", "--data", "ROOT/data", "--out", "a\0b"),
    ("estimate", "ROOT/a.png", "ROOT/nothing"), ("estimate", "ROOT/a.png", "ROOT/b.png", "--intrinsics", "nan,1,1,1"),
    ("tables", "\0"), ("tables", "ROOT"), ("compare", "ROOT", "\udcff"), ("data", "check", "\0"), ("data", "check", "ROOT/capture"),
    ("data", "labels", "file:///etc", "--root", "ROOT/data"), ("data", "transfer", "ROOT/data", "ROOT/data", "../cup"),
    ("data", "labels", "http://localhost:1/x", "--root", "ROOT/data"),
    ("data", "download", "co3d", "--category", "[/1]", "--root", "ROOT/new", "--yes"), ("weights", "fetch", "../../x"),
    ("data", "import", "lists", "ROOT/capture", "--root", "ROOT/data", "--category", "c", "--sequence", "..", "--box", "2,2,20,20"),
    ("data", "import", "lists", "ROOT/capture", "--root", "ROOT/data", "--category", "c", "--sequence", "s", "--box", "nan,1,2,3"),
    ("data", "import", "lists", "ROOT/capture", "--root", "ROOT/data", "--category", "c", "--sequence", "s", "--box", "0,0,999,999"),
    ("weights", "verify", "\0"), ("weights", "list", "--nosuch"), ("doctor", "--nosuch"), ("nosuch",), ("benchmark", "--pairs"),
):  # fmt: skip
    command("options", " ".join(argv).replace(" ".join(ON_DATA), "benchmark")[:60], *argv)

# names that mean something to a terminal, to TeX, to HTML or to Markdown, or are not UTF-8
for name in (
    "[red]x[",
    "$\\frac{$",
    "a_b^c",
    "<script>alert(1)<",
    "| a | b |",
    "\udcff\udcfe",
    "a\nb",
    "\x1b[31mred",
    "x" * 200,
):

    def renamed(folder, name=name):
        for parent in ("data", "data/class_labels"):
            (folder / parent / "cup").rename(folder / parent / name)
        for file in ("frame_annotations.jgz", "sequence_annotations.jgz"):
            path = folder / "data" / name / file
            text = gzip.decompress(path.read_bytes()).replace(b'"cup/', json.dumps(f"{name}/").encode()[:-1])
            path.write_bytes(gzip.compress(text.replace(b'"cup"', json.dumps(name).encode())))

    codes = (1, 2) if "\\" in name or "\udcff" in name else (0,)  # a backslash, or what JSON cannot hold
    command(
        "text", f"data check of a category {name[:20]!r}", "data", "check", "ROOT/data", change=renamed, codes=codes
    )
    command("text", f"benchmark of a category {name[:20]!r}", *ON_DATA, change=renamed, codes=codes)


# locks
_HOLD = "import sys, time; from zsp_lite.io.locks import writing\nwith writing(sys.argv[1]): print(1, flush=True); time.sleep(30)"


def _locked(folder, kill):
    holder = subprocess.Popen([sys.executable, "-c", _HOLD, str(folder / "data/cup")], stdout=subprocess.PIPE)
    assert holder.stdout.readline()
    if kill:
        holder.kill()
        holder.wait()
    try:
        write_co3d(folder / "data", "cup", [sequence_data("new", 2)])
    finally:
        holder.kill()
    return RIGHT


CASES.append(Case("lock", "write_co3d beside another writer", lambda folder: _locked(folder, False)))
CASES.append(Case("lock", "write_co3d after a killed writer", lambda folder: _locked(folder, True)))
for layout in READERS_OF.keys() & READERS.keys():
    CASES.append(Case("right", f"{layout}: nothing wrong", lambda folder, f=_capture(layout): f(folder) and RIGHT))
