"""Run every hostile input in a forked process with limits on memory and time, and print a table.

    python -m tests.hostile [GROUP ...] [-kTEXT] [-v]

-k selects cases whose names contain the text, -v prints every message. The libraries are imported once, before the
processes fork. A case fails by a traceback, by a wrong answer without an error, after 20 s (on a busy machine, after
20 s of processor time), or with 1 GB more memory than the idle process. Linux only.
"""

import gc
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path

os.environ |= {"OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg", "HF_HUB_OFFLINE": "1", "COLUMNS": "120"}
sys.path.insert(0, str(Path(__file__).parents[1]))  # the helpers of the other tests

import cv2  # noqa: E402
import torch  # noqa: E402
import transformers  # noqa: E402, F401

from tests.hostile import cases  # noqa: E402, F401
from tests.hostile.harness import CASES, REFUSED, RIGHT, Wrong, prepare  # noqa: E402
from zsp_lite.errors import InputError  # noqa: E402

SECONDS, MEMORY = 20, 1 << 30  # limits of a case, bytes
KINDS = ("refused", "right", "traceback", "wrong", "hang", "memory")
GOOD = KINDS[:2]


def run_case(case, folder: Path, idle: int) -> tuple[str, str, float, int]:
    """Run a case in a forked process.

    Returns:
        One of `KINDS`, the message, the processor time in seconds, and the memory beyond `idle` in bytes.
    """
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        os.setsid()
        for stream in (1, 2):
            os.dup2(os.open(folder / f"stream{stream}", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), stream)
        os.chdir(folder)
        resource.setrlimit(resource.RLIMIT_CPU, (2 * SECONDS, 2 * SECONDS))
        size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + 3 * MEMORY,) * 2)  # the machine's memory is not to fill up
        try:
            found = case.call(folder)
            kind, message = GOOD[found is RIGHT] if found is REFUSED or found is RIGHT else "wrong", repr(found)
        except InputError as error:
            kind, message = "wrong" if "\n" in str(error) or len(str(error)) > 1500 else "refused", str(error)
        except Wrong as error:
            kind, message = "wrong", str(error)
        except BaseException as error:
            lines = traceback.format_exc().strip().splitlines()
            kind, message = "traceback", f"{type(error).__name__}: {error} | {' '.join(lines[-3:-1])}"
        kind = "wrong" if (folder / "executed").exists() else kind
        os.write(writing, f"{kind}\n{message}".encode(errors="backslashreplace")[:4000])
        os._exit(0)
    os.close(writing)
    start, done = time.monotonic(), 0
    while not done and (time.monotonic() < start + SECONDS or computes(child, start)):
        done, _, used = os.wait4(child, os.WNOHANG)
        time.sleep(0 if done else 0.003)
    if not done:
        os.killpg(child, signal.SIGKILL)
        _, _, used = os.wait4(child, 0)
    with open(reading, "rb") as pipe:
        kind, _, message = pipe.read().decode(errors="replace").partition("\n") if done else ("hang", "", "")
    more = max(0, 1024 * used.ru_maxrss - idle)
    kind = "memory" if more > MEMORY else kind or "traceback"
    return kind, message or ("the process died" if kind == "traceback" else ""), used.ru_utime + used.ru_stime, more


def computes(child: int, start: float) -> bool:
    """Tell whether a process is not waiting, and has had less than its processor time because others have the cores."""
    for _ in range(50):
        state, *numbers = Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()
        spent = (int(numbers[10]) + int(numbers[11])) / os.sysconf("SC_CLK_TCK")
        if state in "RDZ":
            return spent < SECONDS and time.monotonic() < start + 20 * SECONDS
        time.sleep(0.02)
    return False


def main(groups: list[str], part: str = "") -> int:
    torch.set_num_threads(1)
    cv2.setNumThreads(0)
    start, work = time.monotonic(), Path(tempfile.mkdtemp(prefix="hostile-"))
    try:
        template = prepare(work / "template")
        gc.freeze()  # a collection in a child would copy every page
        idle, results = 0, []
        for number, case in enumerate(one for one in CASES if part in one.name and (not groups or one.group in groups)):
            folder = work / str(number)
            shutil.copytree(template, folder, symlinks=True)
            if not idle:
                idle = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            results.append((case, *run_case(case, folder, idle)))
            shutil.rmtree(folder, ignore_errors=True)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    print(f"{'group':10} cases " + " ".join(f"{kind:>9}" for kind in KINDS) + "   CPU s  most MB")
    for group in dict.fromkeys(case.group for case, *_ in results):
        of_group = [result for result in results if result[0].group == group]
        counts = Counter(kind for _, kind, *_ in of_group)
        seconds, most = sum(result[3] for result in of_group), max(result[4] for result in of_group) / 1e6
        cells = " ".join(f"{counts[kind] or '':>9}" for kind in KINDS)
        print(f"{group:10} {len(of_group):5} {cells} {seconds:7.0f} {most:8.0f}")
    for case, kind, message, *_ in results:
        if kind not in GOOD or "-v" in sys.argv:
            print(f"{kind}: {case.group}: {case.name}: {' '.join(message.split())[:700]}")
    bad = sum(kind not in GOOD for _, kind, *_ in results)
    print(f"{len(results) - bad} of {len(results)} as expected, {time.monotonic() - start:.0f} s")
    return int(bad > 0)


if __name__ == "__main__":
    parts = [option[2:] for option in sys.argv[1:] if option.startswith("-k")]
    raise SystemExit(main([name for name in sys.argv[1:] if not name.startswith("-")], *parts))
