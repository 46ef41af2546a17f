"""What a process must withstand: endless, oversized and malicious files and options, for every reader and command."""

import gzip
import json
import struct
import sys
import zlib

from tests.hostile.harness import (
    BENCHMARK,
    FRAMES,
    READERS_OF,
    RESULTS,
    STRANGE,
    case,
    command,
    gzip_bomb,
    read_capture,
    strange,
    written,
)

COMMANDS_OF = {
    "picture": ("a.png", ("estimate", "ROOT/a.png", "ROOT/b.png", "--intrinsics", "60,60,32,32", "--out", "ROOT/e")),
    "results": (RESULTS, ("tables", "ROOT/out")),
    "packed results": (f"{RESULTS}.gz", ("tables", "ROOT/out")),
    "run to continue": ("out/run.jsonl", (*BENCHMARK, "--data", "ROOT/data", "--out", "ROOT/out")),
    "settings of a run": ("out/run.json", (*BENCHMARK, "--data", "ROOT/data", "--out", "ROOT/out")),
    "checked annotations": (FRAMES, ("data", "check", "ROOT/data")),
    "weights": ("x.safetensors", ("demo", "--backbone", "ROOT/x.safetensors", "--out", "ROOT/d")),
}
for kind in STRANGE:
    for what, (name, read) in READERS_OF.items():
        case("file", f"{what}: {kind}", read, strange(name, kind))
    for what, (name, argv) in COMMANDS_OF.items():
        codes = (1,) if what == "checked annotations" else (2,)
        command("file", f"{what}: {kind}", *argv, change=strange(name, kind), codes=codes)


# oversized
def png(width: int, height: int) -> bytes:
    chunks = ((b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)),
              (b"IDAT", zlib.compress(bytes(1 << 20), 9)), (b"IEND", b""))  # fmt: skip
    packed = (struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


def safetensors(header: dict | bytes, data: bytes = b"") -> bytes:
    encoded = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(encoded)) + encoded + data


def _npy(shape, descr="<f8", data=b"") -> bytes:
    header = str({"descr": descr, "fortran_order": False, "shape": shape}).encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


DEEP = b"[" * 100_000
OVERSIZED = [
    ("image", png(30_000, 30_000)), ("depth", png(2**31 - 1, 2**31 - 1)), ("frame annotations", gzip_bomb),
    ("sequence annotations", gzip.compress(DEEP)), ("label", DEEP), ("nerfstudio", DEEP), ("labels to import", DEEP),
    ("frame annotations", gzip.compress(b'[{"sequence_name": "a", "frame_number": ' + b"9" * 100_000 + b"}]")),
    ("pairs", b"\x80\x02" + b"]" * 100_000 + b"."),
    ("safetensors", safetensors({"a": {"dtype": "F32", "shape": [10**12], "data_offsets": [0, 4]}}, bytes(4))),
    ("safetensors", safetensors(b'{"a":' * 100_000)),
    ("lists", "x" * 20_000_000), ("lists", "\n" * 2_000_000),
]  # fmt: skip
for number, (what, data) in enumerate(OVERSIZED):
    name, read = READERS_OF[what]
    case("oversized", f"{what} {number}", read, written(name, data))
command("oversized", "results that are a gzip bomb", "tables", "ROOT/out", change=written(f"{RESULTS}.gz", gzip_bomb))
case("oversized", "depth map of 10^15 numbers", read_capture("lists"), lambda folder: (
    written("capture/z/0.npy", _npy((10**15,)))(folder), written("capture/depth.txt", "z/0.npy\n")(folder)))  # fmt: skip


# malicious: links that lead out of a folder, code in files and as values of options
def _link(name, target):
    return lambda folder: ((folder / name).unlink(missing_ok=True), (folder / name).symlink_to(target))


case("malicious", "depth map of objects", read_capture("lists"), lambda folder: (
    written("capture/z/0.npy", _npy((1,), "|O", b"cos\nsystem\n(S'touch executed'\ntR."))(folder),
    written("capture/depth.txt", "z/0.npy\n")(folder)))  # fmt: skip
for target in ("capture/pictures/0.jpg", "capture/rgb.txt"):
    case("malicious", f"{target} is a link out of the folder", read_capture("lists"), _link(target, "/etc/passwd"))
ON_DATA = (*BENCHMARK, "--data", "ROOT/data", "--out", "ROOT/new")
for option, value in (("--executor", "dask://\0"), ("--methods", "os:_exit"), ("--methods", "raises:now"),
                      ("--methods", "a=/dev/zero/x.csv"), ("--categories", "../.."), ("--list-pairs", "/dev/null/x")):  # fmt: skip
    command("malicious", f"benchmark {option} {value!r}", *ON_DATA, option, value, change=lambda folder: (
        sys.path.insert(0, str(folder)), written("raises.py", "raise SystemExit(3)")(folder)))  # fmt: skip

# options that reach beyond their folder, or ask for more than there is
for argv in (
    (*ON_DATA, "--pairs", "100000000"), (*ON_DATA, "--workers", "100000000000"), (*ON_DATA, "--image-size", "1000000"),
    (*BENCHMARK, "--data", "ROOT/data", "--out", "/dev/null/x"), ("compare", "ROOT", "\udcff"), ("demo", "--data", "\udcff"),
    ("data", "labels", "file:///etc", "--root", "ROOT/data"), ("data", "transfer", "ROOT/data", "ROOT/data", "../cup"),
    ("data", "import", "lists", "ROOT/capture", "--root", "ROOT/data", "--category", "c", "--sequence", "..", "--box", "2,2,20,20"),
):  # fmt: skip
    command("options", " ".join(argv).replace(" ".join(ON_DATA), "benchmark")[:60], *argv)
