"""The categories that methods are evaluated on: names of the paper's twenty, generators of their own.

No backbone is trained on any of them; `training_categories` and `validation_categories` share neither a name nor a
generator with them.
"""

from zsp_lite.synthetic.evaluation_appliances import hairdryer, laptop, mouse, toaster
from zsp_lite.synthetic.evaluation_desk import book, handbag, keyboard, remote
from zsp_lite.synthetic.evaluation_furniture import backpack, chair, hydrant, toilet
from zsp_lite.synthetic.evaluation_road import bicycle, car, motorcycle
from zsp_lite.synthetic.evaluation_toys import teddybear, toybus, toyplane, toytrain, toytruck

EVALUATION = {
    generator.__name__: generator
    for generator in (
        backpack, bicycle, book, car, chair, hairdryer, handbag, hydrant, keyboard, laptop,
        motorcycle, mouse, remote, teddybear, toaster, toilet, toybus, toyplane, toytrain, toytruck,
    )
}  # fmt: skip
