"""The page docs/playground.md in Chromium: it computes what the library computes, and a person can
use it."""

import base64
import subprocess
import sys
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np
import pytest
import torch
from lab_in_browser import REPOSITORY
from numpy.testing import assert_allclose, assert_array_equal
from torch.testing import assert_close

from docs.playground.build import stored_pairs, write_page_data
from zsp_lite import Co3D, FeatureMap, ZeroShotPose, load_backbone
from zsp_lite.alignment import ransac
from zsp_lite.best_view import correspondence_score
from zsp_lite.course.demo import run_pair
from zsp_lite.course.samples import sample_data
from zsp_lite.matching import cyclical_distances, key_similarities, match, similarity
from zsp_lite.metrics import rotation_error

DEFAULTS = {
    "saliency": 0.05,
    "binned": True,
    "cycle": True,
    "k": 50,
    "kmeans": True,
    "trials": 1000,
    "threshold": 0.2,
}
SOLVE = """(chosen) => {
  const { targets, best, pose, error } = solveViews(state.views, chosen);
  const kept = ({ matches, score, distances }) => ({ matches, score, distances: [...distances] });
  return { targets: targets.map(kept), best, pose, error };
}"""
FIRST_TARGET = (
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
def site(tmp_path_factory):
    """Folder of a site with this one page."""
    folder = tmp_path_factory.mktemp("site")
    only = ["-D", "include_patterns=docs/playground.md", "-D", "root_doc=docs/playground"]
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "-q",
        "-c",
        "docs/site",
        "-d",
        folder / "doctrees",
        *only,
        ".",
        folder,
    ]
    # links to other pages are missing
    subprocess.run(command, cwd=REPOSITORY, check=True, stderr=subprocess.DEVNULL)
    write_page_data(folder / "docs/playground")
    return folder


@pytest.fixture(scope="module")
def method():
    return ZeroShotPose(load_backbone("zsp-tiny", "cpu"))


@pytest.fixture(scope="module")
def stored(browser, site):
    """The page opened as a file."""
    return open_page(browser, site.as_uri())


def open_page(browser, address, **options):
    page = browser.new_context(**options).new_page()
    page.set_default_timeout(180_000)  # milliseconds, for a busy machine
    page.broken = []
    page.on("pageerror", lambda error: page.broken.append(str(error)))
    page.goto(f"{address}/docs/playground.html")
    page.wait_for_function(
        "document.getElementById('pictures').getAttribute('aria-busy') === 'false'"
    )
    return page


def array(page, expression, kind=np.float32):
    """A typed array of the page."""
    return np.frombuffer(base64.b64decode(page.evaluate(f"({PACK})({expression})")), kind).copy()


def nearest(sim, on1, on2):
    """Rank patches by the similarity to their nearest neighbour, a `Matcher`."""
    best, partner = sim.max(dim=1)
    return partner, best.masked_fill(~(on1 & on2[partner]), -torch.inf)


@pytest.mark.parametrize("index", range(8))
def test_the_page_computes_what_the_library_computes(stored, method, index):
    dataset = Co3D(sample_data())
    result = run_pair(dataset, stored_pairs(dataset)[index], method)
    expected, views = (
        result.estimate,
        [result.estimate.reference_view, *result.estimate.target_views],
    )
    stored.evaluate("index => openStored(index)", index)
    default = stored.evaluate(SOLVE, DEFAULTS)
    assert default["best"] == expected.view
    assert_allclose([one["score"] for one in default["targets"]], expected.view_scores, atol=0.05)
    assert rotation_error(np.array(default["pose"]["R"]), expected.sim3.R) < 1
    assert default["error"] == pytest.approx(result.error, abs=1)

    solved = {
        cycle: stored.evaluate(SOLVE, DEFAULTS | {"kmeans": False, "cycle": cycle})
        for cycle in (True, False)
    }
    kept = []  # features with the rounded keys that the page stores
    for i, view in enumerate(views):
        on = stored.evaluate(f"Array.from(state.views[{i}].saliency, (value) => value > 0.05)")
        assert on == view.foreground.flatten().tolist()
        keys = torch.from_numpy(array(stored, f"state.views[{i}].keys").reshape(28, 28, -1))
        kept.append(FeatureMap(keys, view.features.saliency, view.features.global_feature))
    for i, view in enumerate(views[1:]):
        compared = (array(stored, f"state.views[{i + 1}].compared[{one}].sim") for one in (0, 1))
        bare, sim = (torch.from_numpy(one.reshape(784, 784)) for one in compared)
        assert_close(sim, similarity(views[0].features, view.features), atol=1e-3, rtol=0)
        assert_close(sim, similarity(kept[0], kept[i + 1]), atol=1e-5, rtol=0)
        (plain,) = key_similarities(views[0].features, [view.features])
        assert_close(bare, plain, atol=3e-3, rtol=0)
        closed = -cyclical_distances(sim, (28, 28), (28, 28), views[0].foreground, view.foreground)
        assert_allclose(solved[True]["targets"][i]["distances"], closed.flatten(), atol=1e-6)
        for cycle, matcher in ((True, "cyclical"), (False, nearest)):
            matches = match(kept[0], kept[i + 1], kmeans=False, sim=sim, matcher=matcher)
            found = solved[cycle]["targets"][i]
            pairs = np.stack([matches.reference @ (28, 1), matches.target @ (28, 1)], axis=1)
            assert_array_equal(found["matches"], pairs)
            assert found["score"] == pytest.approx(correspondence_score(matches, 50), abs=1e-3)
    best, pose = solved[True]["best"], solved[True]["pose"]
    u, v = np.transpose(solved[True]["targets"][best]["matches"])
    x, y = (np.array(stored.evaluate(f"state.views[{i}].points")) for i in (0, best + 1))
    fitted, inliers = ransac(x[u], y[v], scale_range=(0.2, 5))
    assert (
        rotation_error(np.array(pose["R"]), fitted.R) < 1e-3 and pose["inliers"] == inliers.tolist()
    )
    assert not stored.broken


def test_photographs_get_the_features_of_the_library_and_no_pose(browser, site, method, tmp_path):
    dataset = Co3D(sample_data())
    reference, targets = dataset.load_pair(stored_pairs(dataset)[-1])
    views = method.views([reference, targets[0]])
    files = [tmp_path / "a.png", tmp_path / "b.png"]
    for file, view in zip(files, views):
        cv2.imwrite(str(file), view.frame.rgb[..., ::-1])
    server = ThreadingHTTPServer(
        ("127.0.0.1", 0), partial(SimpleHTTPRequestHandler, directory=site)
    )
    threading.Thread(target=server.serve_forever, daemon=True).start()
    address, asked = f"http://127.0.0.1:{server.server_port}", []
    page = open_page(browser, address)
    if not page.evaluate("DATA.runtime"):
        pytest.skip("onnxruntime-web could not be fetched")
    page.on("request", lambda request: asked.append((request.method, request.url)))
    page.set_input_files("#files", files)
    page.wait_for_function("/not left|cannot/.test(document.getElementById('notice').textContent)")
    assert "not left this computer" in page.inner_text("#notice") and "No pose" in page.inner_text(
        "#stages"
    )
    for i, view in enumerate(views):
        keys, saliency = (array(page, f"state.views[{i}].{name}") for name in ("keys", "saliency"))
        assert_allclose(keys, view.features.keys.flatten(), atol=1e-3)
        assert_allclose(saliency, view.features.saliency.flatten(), atol=1e-3)
    page.select_option("#pair", "3")  # the pair shown before
    page.wait_for_function("/3D models/.test(document.getElementById('notice').textContent)")
    assert page.evaluate("state.views.length") == 6 and "No pose" not in page.inner_text("#stages")
    assert asked and all(
        how == "GET" and url.startswith((address, "data:", "blob:")) for how, url in asked
    )
    server.shutdown()


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 390])
def test_a_person_uses_the_page_with_keyboard_and_touch(browser, site, width, scheme):
    options = {
        "viewport": {"width": width, "height": 900},
        "color_scheme": scheme,
        "has_touch": True,
    }
    page = open_page(browser, site.as_uri(), **options)

    def tab_to(name):
        for _ in range(60):
            if page.evaluate("document.activeElement.id") == name:
                return
            page.keyboard.press("Tab")
        pytest.fail(f"{name} is not reached by the keyboard")

    tab_to("reference")
    text, picture = page.inner_text("#patch"), array(page, FIRST_TARGET, np.uint8)
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("Enter")
    assert text != page.inner_text("#patch") and page.inner_text("#patch").endswith("held")
    assert (picture != array(page, FIRST_TARGET, np.uint8)).any() and picture.std() > 20
    box = page.locator("#reference").bounding_box()
    page.touchscreen.tap(box["x"] + 60, box["y"] + 60)
    assert page.inner_text("#patch").endswith("click to hold") and "row 14" not in page.inner_text(
        "#patch"
    )
    right, left = "ArrowRight", "ArrowLeft"
    keys = {
        "cloud": "ArrowUp",
        "saliency": right,
        "cycle": " ",
        "k": left,
        "kmeans": " ",
        "trials": "Home",
    }
    for name, key in keys.items():
        before = page.inner_text("#stages"), page.evaluate("element('cloud').toDataURL()")
        tab_to(name)
        page.keyboard.press(key)
        after = page.inner_text("#stages"), page.evaluate("element('cloud').toDataURL()")
        assert before[name == "cloud"] != after[name == "cloud"], name
    for stage in ("saliency", "similarity", "cycle", "matches", "view", "pose"):
        page.check(f"[name=stage][value={stage}]")
        assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert not page.broken
