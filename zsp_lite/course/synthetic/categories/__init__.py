"""The categories that methods are evaluated on: those of the paper, each built of primitives.

No backbone is trained on them, and no setting is chosen by them.
"""

from zsp_lite.course.synthetic.categories import belongings, household, street, toys

_BUILDERS = (
    *belongings.BUILDERS,
    *household.BUILDERS,
    *street.BUILDERS,
    *toys.BUILDERS,
)
# A category has the name of its function.
CATEGORIES = {
    build.__name__: build for build in sorted(_BUILDERS, key=lambda build: build.__name__)
}
