"""A JupyterLab on loopback with settings of its own, and what a reader does there: open a notebook,
run it, look at it, move its sliders."""

import json
import os
import secrets
import shutil
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from contextlib import contextmanager
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]

# Settings of JupyterLab: every cell of a notebook is in the page at all times, and nothing is asked
# of the network.
_SETTINGS = {
    "@jupyterlab/notebook-extension/tracker": {"windowingMode": "none"},
    "@jupyterlab/apputils-extension/notification": {"fetchNews": "false", "checkForUpdates": False},
    "@jupyterlab/docmanager-extension/plugin": {"autosave": False},
}


def chromium(playwright) -> str | None:
    """The system's Chromium or Chrome, or else the one that Playwright has installed."""
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    found = next(filter(None, map(shutil.which, names)), None)
    own = playwright.chromium.executable_path
    return found or (own if Path(own).exists() else None)


@contextmanager
def running_chromium():
    """Chromium, as a browser of Playwright.

    Without one the tests are skipped, but fail in continuous integration.
    """
    # Imported here: conftest.py loads this module also where Playwright is not installed.
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        program = chromium(playwright)
        if program is None:
            refuse = pytest.fail if os.environ.get("CI") else pytest.skip
            refuse(
                "no Chromium here: `apt install chromium` or `python -m playwright install "
                "chromium` brings one"
            )
        options = "--no-sandbox --disable-gpu --enable-unsafe-swiftshader --use-gl=swiftshader"
        options += " --no-first-run --disable-background-networking --disable-component-update"
        running = playwright.chromium.launch(executable_path=program, args=options.split())
        yield running
        running.close()


@dataclass(frozen=True)
class Lab:
    """A running server. `url` is its address, `token` opens it."""

    url: str
    token: str

    def ask(self, path: str, method: str = "GET"):
        """The server's answer below /api/, decoded; None where it is empty."""
        request = urllib.request.Request(
            f"{self.url}/api/{path}",
            method=method,
            headers={"Authorization": f"token {self.token}"},
        )
        with urllib.request.urlopen(request, timeout=20) as answer:
            body = answer.read()
        return json.loads(body) if body else None

    def stop_kernels(self) -> None:
        """End every kernel of the server."""
        for session in self.ask("sessions"):
            self.ask(f"sessions/{session['id']}", "DELETE")


@contextmanager
def serve(folder: Path, state: Path, data: Path):
    """A `Lab` that serves `folder`; its settings, workspaces and log are in `state`, so that those
    of the user stay as they are."""
    for plugin, settings in _SETTINGS.items():
        path = state / "settings" / f"{plugin}.jupyterlab-settings"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(settings))
    environment = os.environ | {
        "JUPYTERLAB_SETTINGS_DIR": str(state / "settings"),
        "JUPYTERLAB_WORKSPACES_DIR": str(state / "workspaces"),
        "JUPYTER_CONFIG_DIR": str(state / "config"),
        "JUPYTER_RUNTIME_DIR": str(state / "runtime"),
        "IPYTHONDIR": str(state / "ipython"),
        "PYTHONPATH": os.pathsep.join(
            filter(None, [str(REPOSITORY), os.environ.get("PYTHONPATH")])
        ),
        "ZSP_LITE_DATA": str(data),
    }
    # The tests draw without windows; kernels draw into the notebook.
    environment.pop("MPLBACKEND", None)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    lab = Lab(f"http://127.0.0.1:{port}", secrets.token_hex(16))
    command = [
        sys.executable,
        *"-m jupyter lab --no-browser --allow-root --ServerApp.ip=127.0.0.1".split(),
        f"--ServerApp.port={port}",
        "--ServerApp.port_retries=0",
        f"--IdentityProvider.token={lab.token}",
        f"--ServerApp.root_dir={folder}",
        "--ServerApp.tornado_settings={'page_config_data': {'buildCheck': False}}",
    ]
    with open(state / "jupyterlab.log", "w") as log:
        server = subprocess.Popen(
            command, cwd=folder, env=environment, stdout=log, stderr=subprocess.STDOUT
        )
    try:
        deadline = time.monotonic() + 180
        while not _answers(lab):
            if server.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError(
                    f"JupyterLab did not start:\n{(state / 'jupyterlab.log').read_text()[-3000:]}"
                )
            time.sleep(0.5)
        yield lab
        lab.stop_kernels()
    finally:
        server.terminate()
        try:
            server.wait(timeout=120)
        except subprocess.TimeoutExpired:
            server.kill()


def _answers(lab: Lab) -> bool:
    """Whether the server is ready."""
    try:
        lab.ask("status")
    except (urllib.error.URLError, ConnectionError, TimeoutError):
        return False
    return True


def open_notebook(page, lab: Lab, name: str) -> None:
    """Show a notebook, and wait until its kernel is there."""
    page.goto(f"{lab.url}/lab/tree/{name}?reset&token={lab.token}", timeout=180_000)
    page.wait_for_selector(".jp-Notebook .jp-CodeCell", timeout=180_000)
    page.wait_for_selector('.jp-Notebook-ExecutionIndicator[data-status="idle"]', timeout=180_000)


# Expressions of JavaScript: whether some cell has begun to run, and whether some cell still runs or
# waits. The prompt of a cell is "[ ]:" before it begins, "[*]:" while it runs or waits, and "[1]:"
# afterwards.
_BEGUN = (
    "[...document.querySelectorAll('.jp-CodeCell .jp-InputPrompt')].some(e => "
    "/[*0-9]/.test(e.innerText))"
)
_RUNNING = _BEGUN.replace("*0-9", "*")


def run_all(page, patience: float) -> None:
    """Run > Run All Cells, and wait until nothing runs or waits any more.

    TimeoutError after `patience` seconds.
    """
    deadline = time.monotonic() + patience
    asked = 0.0  # the time of the last click on the menu
    while not page.evaluate(_BEGUN):
        if time.monotonic() > deadline:
            raise TimeoutError(f"no code cell had begun to run after {patience:.0f} s")
        # A notebook that has only just opened may miss the menu: ask again after 20 s.
        if time.monotonic() > asked + 20:
            page.locator(".lm-MenuBar-itemLabel", has_text="Run").first.click()
            page.locator('.lm-Menu-item[data-command="runmenu:run-all"]').click()
            asked = time.monotonic()
        page.wait_for_timeout(500)
    # Between two cells there is a moment in which none runs: it must last for three looks.
    rest = 0
    while rest < 3:
        rest = 0 if page.evaluate(_RUNNING) else rest + 1
        if time.monotonic() > deadline:
            raise TimeoutError(f"code cells still ran after {patience:.0f} s")
        page.wait_for_timeout(1000)
    page.wait_for_selector('.jp-Notebook-ExecutionIndicator[data-status="idle"]', timeout=60_000)


def saved(page, lab: Lab, name: str) -> dict:
    """The notebook as it is after saving it."""
    page.keyboard.press("Control+s")
    page.wait_for_selector(".jp-mod-dirty", state="detached", timeout=60_000)
    return lab.ask(f"contents/{name}")["content"]


def errors(page, notebook: dict) -> list[str]:
    """The error outputs of a saved notebook, its cells that never ran, and the widgets and pictures
    that the page cannot show."""
    found = []
    for number, cell in enumerate(notebook["cells"]):
        if cell["cell_type"] == "code":
            outputs = [output for output in cell["outputs"] if output["output_type"] == "error"]
            found += [f"cell {number}: {output['ename']}: {output['evalue']}" for output in outputs]
            if cell["execution_count"] is None:
                found.append(f"cell {number} did not run")
    for failure in (
        "Error displaying widget",
        "Error creating widget",
        "Loading widget...",
        "JavaScript Error",
    ):
        found += page.locator(".jp-OutputArea-output", has_text=failure).all_inner_texts()
    # A picture without a source, as plotly keeps one beside its drawings, shows nothing on purpose.
    broken = """() => [...document.querySelectorAll('.jp-Notebook img[src]')]
      .filter(e => e.complete && !e.naturalWidth)
      .map(e => `picture not shown: ${e.src.slice(0, 80)}`)"""
    return found + page.evaluate(broken)


def slider_outputs(page) -> list:
    """One locator for each output that has a slider in it."""
    return page.locator(
        ".jp-Notebook .jp-OutputArea-output", has=page.locator(".noUi-handle")
    ).all()


# Everything that is drawn, as text: pixels of images and canvases, plotly's SVG. Null while an
# image is being replaced.
_PICTURES = """output => Promise.all(
  [...output.querySelectorAll('img, canvas, .js-plotly-plot')].map(async e => {
  if (e.tagName == 'DIV') return e.innerHTML;
  if (e.tagName == 'CANVAS') return e.toDataURL();
  await e.decode();
  const c = document.createElement('canvas');
  [c.width, c.height] = [e.naturalWidth, e.naturalHeight];
  c.getContext('2d').drawImage(e, 0, 0);
  return c.toDataURL();
})).then(all => all.join('|'), () => null)"""


def slider_moves_picture(output) -> bool:
    """Whether the pictures of a widget change when one of its sliders is moved by keyboard."""
    output.scroll_into_view_if_needed()
    before = output.evaluate(_PICTURES)
    for handle in output.locator(".noUi-handle").all():
        # Right, and then left of where it was: a slider may stand at one end.
        for key in ("ArrowRight", "ArrowLeft", "ArrowLeft"):
            handle.focus()
            handle.press(key)
            deadline = time.monotonic() + 30
            while time.monotonic() < deadline:
                time.sleep(0.2)
                if output.evaluate(_PICTURES) not in (before, None):
                    return True
    return False


def label_by_clicks(page) -> None:
    """Label a sequence as a person does: four keypoints on the reference, one taken back, four on
    the next, accept.

    The outermost points of two objects seldom correspond, so the widget may ask to press accept
    again.
    """
    box = page.locator(".zsp-label")
    _pick_outermost(page, "reference")
    box.locator("button.zsp-undo").click()
    _await_marks(page, "reference", 3)
    _pick_outermost(page, "reference", first=3)
    box.locator("button.zsp-next").click()
    _pick_outermost(page, "sequence")
    accept = box.locator("button.zsp-accept:enabled")
    accepted = box.locator(".zsp-progress td", has_text="accepted")
    asked = box.get_by_text("press accept again")
    accept.click()
    accepted.or_(asked).first.wait_for()
    if asked.first.is_visible():
        accept.click()
    accepted.first.wait_for()


def _pick_outermost(page, cloud: str, first: int = 0) -> None:
    """Click on the points of a cloud that are furthest left, right, up and down on the screen, from
    the `first` on."""
    canvas = page.locator(f".zsp-cloud-{cloud} canvas")
    canvas.scroll_into_view_if_needed()
    page.wait_for_function(
        "name => +document.querySelector(`.zsp-cloud-${name} canvas`).dataset.points > 0", arg=cloud
    )
    places = canvas.evaluate(
        "c => [...Array(+c.dataset.points).keys()].map(i => c.pointOnCanvas(i))"
    )
    ends = [end(places, key=itemgetter(axis)) for axis in (0, 1) for end in (min, max)]
    for number, (x, y) in list(enumerate(ends, 1))[first:]:
        canvas.click(position={"x": x, "y": y})
        _await_marks(page, cloud, number)


def _await_marks(page, cloud: str, number: int) -> None:
    """Wait until a cloud has so many marked points."""
    page.wait_for_function(
        "([name, n]) => document.querySelector(`.zsp-cloud-${name} canvas`).dataset.marks == n",
        arg=[cloud, str(number)],
    )


def photograph(page, path: Path) -> None:
    """The notebook as a picture, up to the height in pixels that Chromium can draw at once."""
    path.parent.mkdir(parents=True, exist_ok=True)
    cells = page.evaluate(
        "() => document.querySelector('.jp-WindowedPanel-inner').getBoundingClientRect().height"
    )
    page.set_viewport_size({"width": 1300, "height": int(min(cells + 150, 15_000))})
    page.evaluate("document.querySelector('.jp-WindowedPanel-outer').scrollTop = 0")
    time.sleep(2)  # until everything is laid out anew
    page.screenshot(path=path, timeout=120_000)
