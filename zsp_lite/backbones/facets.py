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
    """Return the index of a block, counted from 0.

    Args:
        layer: "last", "block9", or an integer from 0; negative integers count from the end.
        depth: Number of blocks.
        name: Model name for the error message.

    Raises:
        InputError: If there is no such block.
    """
    text = str(layer).strip()
    if text == "last":
        return depth - 1
    if found := re.fullmatch(r"block(\d+)|(-?\d+)", text):
        index = int(found[1] or found[2])
        if -depth <= index < depth:
            return index % depth
    raise InputError(
        f"{name}: layer is {layer!r}, expected 'last', 'block0' to 'block{depth - 1}', or a number from {-depth} to "
        f"{depth - 1}"
    )


def check_facet(facet: str, name: str = "backbone") -> str:
    """Return `facet`, or raise InputError if it is not in `FACETS`."""
    if facet not in FACETS:
        raise InputError(f"{name}: facet is {facet!r}, expected one of {', '.join(FACETS)}")
    return facet
