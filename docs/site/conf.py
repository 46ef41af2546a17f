"""Sphinx configuration of the course site (`make site`): stored notebooks, docs/, API reference."""

import sys
import tomllib
from pathlib import Path

# The repository is Sphinx's source folder, so that all relative links stay as they are.
ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

_project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

project = "zsp-lite"
author = ", ".join(person["name"] for person in _project["authors"])
copyright = author

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "course",
    "formulas",
    "slides",
]
root_doc = "docs/index"
include_patterns = [
    "*.md",
    "docs/**.md",
    "notebooks/README.md",
    "notebooks/exercises/*.md",
    "notebooks/*.ipynb",
    "notebooks/exercises/source/*/*.ipynb",
    "notebooks/results/*/README.md",
    "data_samples/ATTRIBUTION.md",
    "zsp_lite/**.md",
]
# Sphinx walks through every folder that is not excluded.
_sources = {"docs", "notebooks", "data_samples", "zsp_lite"}
exclude_patterns = [
    path.name for path in ROOT.iterdir() if path.is_dir() and path.name not in _sources
]
exclude_patterns += [
    "data_samples/*/*",
    "zsp_lite/course/**",  # texts that commands write, not pages
]

nb_execution_mode = "off"  # The pages show the stored outputs.
nb_merge_streams = True
myst_enable_extensions = ["attrs_block", "colon_fence", "deflist", "dollarmath"]
myst_disable_syntax = ["myst_line_comment"]  # A line of text may begin with a percent sign.
myst_heading_anchors = 4  # Headings down to this level have anchors, named as on GitHub.
# No warning about stored outputs of a type that MyST-NB cannot show.
suppress_warnings = ["mystnb.unknown_mime_type"]

default_role = "py:obj"  # `name` in a docstring becomes a link if the name is documented here.
autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_preserve_defaults = True
autodoc_use_type_comments = False
toc_object_entries = False  # The contents of a page list modules, not their members.
python_maximum_signature_line_length = 80  # Longer ones have a line per argument.
napoleon_use_ivar = True  # Attributes of a class are a list, as arguments are.

# Address of the repository on GitHub, for the links "Open in Colab"; without it there are none.
course_repository = _project.get("urls", {}).get("Repository", "").rstrip("/").removesuffix(".git")

html_theme = "sphinx_book_theme"
html_title = "zsp-lite"
html_css_files = ["style.css"]
html_js_files = [("site.js", {"defer": "defer"})]
html_static_path = ["static", "../playground"]
# The pictures of these pages take the whole width.
html_sidebars = {"docs/playground": [], "docs/find_on_all": []}
templates_path = ["templates"]
html_additional_pages = {"index": "redirect.html"}
html_math_renderer = "mathml"
html_copy_source = False  # The sources of the exercises hold their solutions.
html_domain_indices = False
html_use_index = False
html_context = {"default_mode": "auto"}  # Pages are light or dark as the system is.
html_theme_options = {
    "repository_url": course_repository,
    "use_repository_button": bool(course_repository),
    # The button would offer the source; `course` links to the notebook for students.
    "use_download_button": False,
    "navbar_persistent": [],  # The search field is in the sidebar.
    "max_navbar_depth": 1,
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
}
