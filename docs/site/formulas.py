"""Sphinx extension of the course site: formulas as MathML, with a font for them that comes with the
site.

MathML needs no script from the network, but a font with mathematical metrics: without one, brackets
do not grow and bars touch letters. The font is STIX Two Math of the package `ziamath`, cut down to
the characters of formulas. Where the package is not installed, the reader's own fonts are used.
"""

import base64
import io
import re
import unicodedata
from functools import cache
from html import unescape
from importlib.util import find_spec
from pathlib import Path

from docutils import nodes
from fontTools.subset import Options, Subsetter
from fontTools.ttLib import TTFont
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

# Latin, accents, Greek, punctuation, letters and operators, brackets; bold, italic and script
# alphabets.
CHARACTERS = [
    (0x20, 0xFF),
    (0x300, 0x36F),
    (0x391, 0x3F6),
    (0x2010, 0x2063),
    (0x2100, 0x22FF),
    (0x2308, 0x230B),
]
CHARACTERS += [(0x27E6, 0x27EB), (0x1D400, 0x1D503), (0x1D6A4, 0x1D7FF)]


@cache
def math_font() -> bytes:
    """Return the font of formulas in the format WOFF, or nothing where ziamath is not installed."""
    package = find_spec("ziamath")
    if package is None:
        return b""
    font = TTFont(Path(package.origin).parent / "fonts" / "STIXTwoMath-Regular.ttf")
    features = ["ssty", "dtls", "flac", "kern", "mark"]
    # All names, since the licence is one of them.
    subsetter = Subsetter(Options(hinting=False, layout_features=features, name_IDs=["*"]))
    codes = [code for first, last in CHARACTERS for code in range(first, last + 1)]
    subsetter.populate(unicodes=codes)
    subsetter.subset(font)
    font.flavor = "woff"
    file = io.BytesIO()
    font.save(file)
    return file.getvalue()


def mathml(latex: str, display: str = "inline") -> str:
    r"""Convert a formula, with four repairs of what latex2mathml makes.

    The names of `\operatorname` become text. Bold and script letters become characters of their
    own, as browsers know no `mathvariant`. The bars of a norm do not grow: each would grow by
    itself, as only one of them has the exponent. A minus after an equals sign is close to its term.
    """
    latex = re.sub(
        r"\\operatorname\*?\{(.*?)\}",
        lambda name: rf"\text{{{name[1]}}}".replace(r"\,", " "),
        latex,
    )
    text = convert(latex, display=display)
    text = re.sub('<mi mathvariant="(bold|script|bold-italic)">(.*?)</mi>', _letter, text)
    text = re.sub("(<mo>&#x0003D;</mo>)<mo>(&#x02212;)", r'\1<mo form="prefix">\2', text)
    return text.replace("<mo>&#x02016;", '<mo stretchy="false">&#x02016;')


def _letter(found: re.Match[str]) -> str:
    """Return the character of a letter in a style."""
    style = found[1].upper().replace("-", " ")
    name = re.sub("LATIN |GREEK |LETTER ", "", unicodedata.name(unescape(found[2])))
    try:
        return f"<mi>{unicodedata.lookup(f'MATHEMATICAL {style} {name}')}</mi>"
    except KeyError:  # SCRIPT CAPITAL R and few others are older characters
        return f"<mi>{unicodedata.lookup(f'{style} {name}')}</mi>"


def visit_math(translator: HTML5Translator, node: nodes.math) -> None:
    """Write a formula in a line."""
    translator.body.append(mathml(node.astext()))
    raise nodes.SkipNode


def visit_displayed_math(translator: HTML5Translator, node: nodes.math_block) -> None:
    """Write a formula in a paragraph of its own."""
    translator.body.append(f'<div class="formula">{mathml(node.astext(), "block")}</div>')
    raise nodes.SkipNode


def write_font(app: Sphinx, error: Exception | None) -> None:
    """Write the font beside the pages (Sphinx's event `build-finished`)."""
    if not error and app.builder.format == "html" and math_font():
        (app.outdir / "_static" / "math.woff").write_bytes(math_font())


def pass_font(
    app: Sphinx, pagename: str, templatename: str, context: dict, doctree: nodes.document | None
) -> None:
    """Let templates embed the font."""
    context["math_font"] = base64.b64encode(math_font()).decode()


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_html_math_renderer("mathml", (visit_math, None), (visit_displayed_math, None))
    app.connect("html-page-context", pass_font)
    app.connect("build-finished", write_font)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
