"""The categories that methods are evaluated on: those of the paper, each built of primitives.

No backbone is trained on them, and no setting is chosen by them.
"""

from zsp_lite.course.synthetic.assembly import by_name
from zsp_lite.course.synthetic.categories.belongings import (
    backpack,
    book,
    handbag,
    keyboard,
    laptop,
    mouse,
    remote,
)
from zsp_lite.course.synthetic.categories.household import chair, hairdryer, toaster, toilet
from zsp_lite.course.synthetic.categories.street import bicycle, car, hydrant, motorcycle
from zsp_lite.course.synthetic.categories.toys import (
    teddybear,
    toybus,
    toyplane,
    toytrain,
    toytruck,
)

CATEGORIES = by_name(
    backpack,
    bicycle,
    book,
    car,
    chair,
    hairdryer,
    handbag,
    hydrant,
    keyboard,
    laptop,
    motorcycle,
    mouse,
    remote,
    teddybear,
    toaster,
    toilet,
    toybus,
    toyplane,
    toytrain,
    toytruck,
)
