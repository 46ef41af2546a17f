"""The page docs/playground.md in Chromium: it computes what the library computes, and a person can
use it."""

import base64
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest
import torch
from jaxtyping import config
from numpy.testing import assert_allclose, assert_array_equal
from one_page import SCREENS, build_page, open_page, screen, tab_to
from playwright.sync_api import Browser, Page
from torch.testing import assert_close

from docs.playground.build import stored_pairs, write_page_data
from zsp_lite import Co3D, FeatureMap, ZeroShotPose, load_backbone
from zsp_lite.best_view import correspondence_score
from zsp_lite.course.samples import sample_data
from zsp_lite.matching import key_similarities, match, similarity
from zsp_lite.metrics import rotation_error
from zsp_lite.scans.pair_result import PairResult, run_pair
from zsp_lite.views import View

# The settings that the page begins with.
DEFAULTS = {
    "saliency": 0.05,
    "binned": True,
    "cycle": True,
    "k": 50,
    "kmeans": True,
    "trials": 1000,
    "threshold": 0.2,
}
# Functions of JavaScript: the pose that the page computes with chosen settings, the pixels of the
# picture of the first target view, and the bytes of an array as text.
SOLVE = """(chosen) => {
  const { targets, best, pose, error } = solveViews(state.views, chosen);
  const kept = ({ matches, score }) => ({ matches, score });
  return { targets: targets.map(kept), best, pose, error };
}"""
FIRST_TARGET = (  # 448: its width and height in pixels
    "document.querySelectorAll('.views canvas')[0].getContext('2d').getImageData(0, 0, 448, "
    "448).data"
)
PACK = """(array) => {
  const bytes = new Uint8Array(array.buffer, array.byteOffset, array.byteLength);
  let text = "";
  for (let i = 0; i < bytes.length; i += 4096)
    text += String.fromCharCode(...bytes.subarray(i, i + 4096));
  return btoa(text);
}"""


@pytest.fixture(scope="module")
def playground(tmp_path_factory) -> Path:
    """Folder of a site with this one page."""
    folder = build_page("docs/playground", tmp_path_factory.mktemp("site"))
    # While the network is traced, its sizes are tensors, not the integers of the annotations.
    config.update("jaxtyping_disable", True)
    write_page_data(folder / "docs/playground")
    config.update("jaxtyping_disable", False)
    return folder


@pytest.fixture(scope="module")
def method() -> ZeroShotPose:
    """The library's method with the page's backbone."""
    return ZeroShotPose(load_backbone("zsp-tiny", "cpu"))


@pytest.fixture(scope="module")
def stored(browser, playground) -> Page:
    """The page opened as a file."""
    return open_playground(browser, playground.as_uri())


def open_playground(browser: Browser, address: str, **options) -> Page:
    """Open the page and wait until its pictures are drawn."""
    return open_page(browser, f"{address}/docs/playground.html", "pictures", **options)


def array(page: Page, expression: str, kind: type = np.float32) -> np.ndarray:
    """A typed array of the page."""
    return np.frombuffer(base64.b64decode(page.evaluate(f"({PACK})({expression})")), kind).copy()


def nearest(sim: torch.Tensor, on1: torch.Tensor, on2: torch.Tensor):
    """Match each patch with its nearest neighbour, if both are on the object: a `Matcher`."""
    best, partner = sim.max(dim=1)
    return partner, best.masked_fill(~(on1 & on2[partner]), -torch.inf)


class Shown(NamedTuple):
    """A stored pair that the page shows, and the library's result."""

    page: Page
    result: PairResult
    views: list[View]  # of the library: the reference and the targets
    stored: list[FeatureMap]  # of the views, with the rounded keys that the page stores
    solved: dict[bool, dict]  # what the page computes, by whether matches are cyclical

    def compared(self, target: int, binned: bool) -> torch.Tensor:
        """The page's similarities of the patches of the reference and a target, (784, 784)."""
        name = f"state.views[{target + 1}].compared[{int(binned)}].sim"
        return torch.from_numpy(array(self.page, name).reshape(784, 784))


GRID = (28, 28)


@pytest.fixture(scope="module", params=range(8))  # all stored pairs
def shown(stored, method, request) -> Shown:
    """Each stored pair in turn."""
    dataset = Co3D(sample_data())
    result = run_pair(dataset, stored_pairs(dataset)[request.param], method, ["paper"])
    stored.evaluate("index => openStored(index)", request.param)
    views = [result.estimate.reference_view, *result.estimate.target_views]
    maps = []
    for i, view in enumerate(views):
        keys = torch.from_numpy(array(stored, f"state.views[{i}].keys").reshape(*GRID, -1))
        maps.append(FeatureMap(keys, view.features.saliency, view.features.global_feature))
    # Without k-means: the page draws other random numbers than the library.
    settings = DEFAULTS | {"kmeans": False}
    solved = {cycle: stored.evaluate(SOLVE, settings | {"cycle": cycle}) for cycle in (True, False)}
    return Shown(stored, result, views, maps, solved)


def test_the_page_has_the_librarys_pose_by_default(shown):
    expected = shown.result.estimate
    found = shown.page.evaluate(SOLVE, DEFAULTS)
    assert found["best"] == expected.view
    scores = [target["score"] for target in found["targets"]]
    # The page stores rounded features, and its random draws are its own.
    assert_allclose(scores, expected.view_scores, atol=0.05)
    assert rotation_error(np.array(found["pose"]["R"]), expected.sim3.R) < 1
    assert_allclose(found["error"], shown.result.error, atol=1)
    assert not shown.page.broken


def test_the_page_has_the_librarys_similarities(shown):
    reference, *targets = shown.views
    first, *maps = shown.stored
    for i, (view, rounded) in enumerate(zip(targets, maps)):
        sim = shown.compared(i, binned=True)
        # The similarities of the exact features, and of the rounded ones that the page has:
        # docs/playground/build.py says how far off rounding leads.
        assert_close(sim, similarity(reference.features, view.features), atol=1e-3, rtol=0)
        assert_close(sim, similarity(first, rounded), atol=1e-5, rtol=0)
        (plain,) = key_similarities(reference.features, [view.features])
        assert_close(shown.compared(i, binned=False), plain, atol=3e-3, rtol=0)


@pytest.mark.parametrize("cycle, matcher", [(True, "cyclical"), (False, nearest)])
def test_the_page_has_the_librarys_matches(shown, cycle, matcher):
    first, *maps = shown.stored
    for i, (found, rounded) in enumerate(zip(shown.solved[cycle]["targets"], maps, strict=True)):
        sim = shown.compared(i, binned=True)
        matches = match(first, rounded, kmeans=False, sim=sim, matcher=matcher)
        # Row and column of 28 to the number of a patch.
        pairs = np.stack([matches.reference @ (28, 1), matches.target @ (28, 1)], axis=1)
        assert_array_equal(found["matches"], pairs)
        assert_allclose(found["score"], correspondence_score(matches, 50), atol=1e-3)


@pytest.fixture(scope="module")
def address(playground):
    """The address of a server of the site."""
    handler = partial(SimpleHTTPRequestHandler, directory=playground)
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def wait_for_notice(page: Page, pattern: str) -> None:
    """Wait until the page says what matches a pattern."""
    page.wait_for_function(f"/{pattern}/.test(document.getElementById('notice').textContent)")


def test_photographs_get_the_features_of_the_library_and_no_pose(
    browser, address, method, tmp_path
):
    dataset = Co3D(sample_data())
    reference, targets = dataset.load_pair(stored_pairs(dataset)[-1])
    views = method.views([reference, targets[0]])
    files = [tmp_path / "a.png", tmp_path / "b.png"]
    for file, view in zip(files, views):
        cv2.imwrite(str(file), view.frame.rgb[..., ::-1])
    page = open_playground(browser, address)
    requests = []
    if not page.evaluate("DATA.runtime"):
        pytest.skip("onnxruntime-web could not be fetched")
    # What the page asks for from now on, and how: photographs would be sent by another method.
    page.on("request", lambda request: requests.append((request.method, request.url)))
    page.set_input_files("#files", files)
    wait_for_notice(page, "not left|cannot")
    assert "not left this computer" in page.inner_text("#notice")
    assert "No pose" in page.inner_text("#stages")
    for i, view in enumerate(views):
        for name in ("keys", "saliency"):
            found = array(page, f"state.views[{i}].{name}")
            assert_allclose(found, getattr(view.features, name).flatten(), atol=1e-3)
    page.select_option("#pair", "3")  # a stored pair again
    wait_for_notice(page, "3D models")
    assert page.evaluate("state.views.length") == 6  # a reference and five target views
    assert "No pose" not in page.inner_text("#stages")
    assert {how for how, _ in requests} == {"GET"}
    assert all(url.startswith((address, "data:", "blob:")) for _, url in requests)


@pytest.fixture(params=SCREENS, ids=str)
def touched(browser, playground, request) -> Page:
    """The page on a screen of a width, in a scheme of colours."""
    return open_playground(browser, playground.as_uri(), **screen(*request.param))


def test_a_patch_is_held_by_keyboard_and_touch(touched):
    tab_to(touched, "reference")
    text = touched.inner_text("#patch")
    picture = array(touched, FIRST_TARGET, np.uint8)
    assert picture.std() > 20  # a picture is shown
    touched.keyboard.press("ArrowLeft")
    touched.keyboard.press("Enter")
    held = touched.inner_text("#patch")
    assert held != text
    assert held.endswith("held")
    assert (picture != array(touched, FIRST_TARGET, np.uint8)).any()
    box = touched.locator("#reference").bounding_box()
    touched.touchscreen.tap(box["x"] + 60, box["y"] + 60)
    released = touched.inner_text("#patch")
    assert released.endswith("click to hold")
    assert "row 14" not in released  # the middle row, where the keyboard began


def test_settings_are_changed_by_keyboard(touched):
    tab_to(touched, "cloud")
    cloud = touched.evaluate("element('cloud').toDataURL()")
    touched.keyboard.press("ArrowUp")
    assert touched.evaluate("element('cloud').toDataURL()") != cloud
    right, left = "ArrowRight", "ArrowLeft"
    keys = {"saliency": right, "cycle": " ", "k": left, "kmeans": " ", "trials": "Home"}
    for name, key in keys.items():
        before = touched.inner_text("#stages")
        tab_to(touched, name)
        touched.keyboard.press(key)
        assert touched.inner_text("#stages") != before, name


def test_every_stage_fits_the_screen(touched):
    for stage in "saliency similarity cycle matches view pose".split():
        touched.check(f"[name=stage][value={stage}]")
        width = touched.evaluate("document.documentElement.scrollWidth")
        assert width <= touched.viewport_size["width"], stage
    assert not touched.broken
