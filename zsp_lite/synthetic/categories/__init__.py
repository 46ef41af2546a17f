"""The categories that methods are evaluated on: the names of the paper's twenty, each built of primitives.

No backbone is trained on them, and no setting is chosen by them.
"""

from zsp_lite.synthetic.assembly import Builder
from zsp_lite.synthetic.categories.belongings import BELONGINGS
from zsp_lite.synthetic.categories.household import HOUSEHOLD
from zsp_lite.synthetic.categories.street import STREET
from zsp_lite.synthetic.categories.toys import TOYS

_BUILDERS = {build.__name__: build for build in (*BELONGINGS, *HOUSEHOLD, *STREET, *TOYS)}
CATEGORIES: dict[str, Builder] = dict(sorted(_BUILDERS.items()))
