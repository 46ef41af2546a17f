"""The categories that methods are evaluated on: the names of the paper's twenty, with generators of their own.

No backbone is trained on them. `training_categories` and `validation_categories` share no name and no generator with
them.
"""

from zsp_lite.synthetic.evaluation_belongings import backpack, book, handbag
from zsp_lite.synthetic.evaluation_electronics import keyboard, laptop, mouse, remote
from zsp_lite.synthetic.evaluation_household import chair, hairdryer, toaster, toilet
from zsp_lite.synthetic.evaluation_street import bicycle, car, hydrant, motorcycle
from zsp_lite.synthetic.evaluation_toys import teddybear, toybus, toyplane, toytrain, toytruck

EVALUATION = {
    generator.__name__: generator
    for generator in (
        backpack, bicycle, book, car, chair, hairdryer, handbag, hydrant, keyboard, laptop,
        motorcycle, mouse, remote, teddybear, toaster, toilet, toybus, toyplane, toytrain, toytruck,
    )
}  # fmt: skip
