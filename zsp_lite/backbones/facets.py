"""Choice of the transformer block ("layer") and of its activation ("facet") that describe a patch.

Amir et al. (2021) compare layers and facets as dense descriptors; the paper uses the keys of one block.
"""

import re
from typing import Literal, get_args

from zsp_lite.errors import InputError

# Inputs of a block's attention ("key", "query", "value"), or the block's output, not normalised ("token").
Facet = Literal["key", "query", "value", "token"]
FACETS: tuple[str, ...] = get_args(Facet)


def block_index(layer: int | str, depth: int, name: str = "backbone") -> int:
    """Return the index from 0 of a block given as "last", "block9" or an integer; negative ones count from the end."""
    text = "-1" if layer == "last" else str(layer).strip()
    found = re.fullmatch(r"(?:block(?=\d))?(-?\d+)", text)
    if not found or not -depth <= int(found[1]) < depth:
        raise InputError(
            f"{name}: layer is {layer!r}, expected 'last', 'block0' to 'block{depth - 1}', or a number from {-depth} "
            f"to {depth - 1}"
        )
    return int(found[1]) % depth
