"""The categories that methods are evaluated on: the names of the paper's twenty, each built of primitives.

No backbone is trained on them, and no setting is chosen by them.
"""

from zsp_lite.synthetic.assembly import Builder
from zsp_lite.synthetic.categories.belongings import backpack, book, handbag, keyboard, laptop, mouse, remote
from zsp_lite.synthetic.categories.household import chair, hairdryer, toaster, toilet
from zsp_lite.synthetic.categories.street import bicycle, car, hydrant, motorcycle
from zsp_lite.synthetic.categories.toys import teddybear, toybus, toyplane, toytrain, toytruck

_LARGE = (bicycle, car, chair, hydrant, motorcycle, toilet)
_SMALL = (backpack, book, hairdryer, handbag, keyboard, laptop, mouse, remote, toaster)
_TOYS = (teddybear, toybus, toyplane, toytrain, toytruck)
_BUILDERS = {build.__name__: build for build in (*_LARGE, *_SMALL, *_TOYS)}
CATEGORIES: dict[str, Builder] = dict(sorted(_BUILDERS.items()))
