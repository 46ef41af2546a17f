"""Configuration of the training runs that make the embedded backbone.

The first run starts from random weights (the defaults of `TrainingConfig`). Its stages: first the patch tokens learn
geometry, because from random weights the gradient of the correspondence loss is mostly noise; then correspondence at
96 px, where steps are cheap; then larger crops, up to the size that the method uses. Further runs (`CONTINUATION`)
start from the weights of the run before and add the choice of the view.
"""

import math
from dataclasses import dataclass, replace

from zsp_lite.errors import InputError
from zsp_lite.training.loop import cosine
from zsp_lite.training.renders import DEFORMATION, PROPORTIONS


@dataclass(frozen=True)
class Stage:
    """One stage of a training run.

    Attributes:
        steps: Number of steps.
        side: Side of the square crops in pixels.
        objects, views: Objects per step and views per object.
        scale: Smallest and largest width of a crop as a fraction of the image's.
        correspondence: Weight of the correspondence loss at the first and after the last step.
        helpers: Weight of the geometry and attention losses.
        radius: Standard deviation of the correspondence targets in object units.
        view: Weight of the view loss, which needs all eight views of an object.
    """

    steps: int
    side: int
    objects: int
    views: int
    scale: tuple[float, float]
    correspondence: tuple[float, float] = (1.0, 1.0)
    helpers: float = 0.4
    radius: float = 0.15
    view: float = 0.0


@dataclass(frozen=True)
class TrainingConfig:
    """Everything that determines the result of a run, except the weights from which it starts.

    Attributes:
        seed: Seed of objects, crops and random weights.
        batch_seed: Second seed of the batches. A run that continues another one with the same objects takes another.
        objects: Number of training objects; others are held out.
        proportions, deformation: How much the views of an object differ (see `render_object`).
        embed_dim, depth, num_heads: Size of the transformer.
        layer: Block whose keys are trained, counted from 0.
        learning_rate: Largest learning rate.
        weight_decay: AdamW's.
        temperature, view_temperature: Temperatures of the correspondence loss and the view loss.
        queries: Patches per object in the correspondence loss.
        view_queries: Patches per view in the view loss.
        log_binned: Compute the view loss on log-binned keys, as the method does, instead of on the keys.
        average: Decay per step of the exponential average of the weights.
        photo_share: Fraction of the steps in which the tokens receive the features of the photo network
            (`zsp_lite.backbones.photo_informed`). The other steps train the transformer alone.
        stages: Stages in order.

    Raises:
        InputError: For fewer than one object, and for negative or infinite proportions or deformation.
    """

    seed: int = 0
    batch_seed: int = 0
    objects: int = 5600
    proportions: float = PROPORTIONS
    deformation: float = DEFORMATION
    embed_dim: int = 192
    depth: int = 12
    num_heads: int = 6
    layer: int = 9
    learning_rate: float = 1e-3
    weight_decay: float = 0.05
    temperature: float = 0.1
    view_temperature: float = 0.03
    queries: int = 256
    view_queries: int = 64
    log_binned: bool = True
    average: float = 0.998
    photo_share: float = 0.0
    stages: tuple[Stage, ...] = (
        Stage(1200, 96, 8, 2, (0.4, 1.0), correspondence=(0.1, 0.1), helpers=1.0),
        Stage(700, 96, 3, 8, (0.4, 1.0), correspondence=(0.1, 1.0), helpers=1.0),
        Stage(3000, 96, 3, 8, (0.4, 1.0)),
        Stage(1300, 128, 3, 8, (0.5, 1.0)),
        Stage(500, 184, 2, 8, (0.75, 1.0), radius=0.12),
        Stage(250, 224, 1, 8, (0.85, 1.0), radius=0.12),
    )

    def __post_init__(self):
        if self.objects < 1:
            raise InputError(f"objects: expected at least 1, got {self.objects}")
        for name in ("proportions", "deformation"):
            if not 0 <= getattr(self, name) < math.inf:
                raise InputError(f"{name}: expected a finite number of at least 0, got {getattr(self, name)}")
        if not 0 <= self.photo_share <= 1:
            raise InputError(f"photo_share: expected 0 to 1, got {self.photo_share}")

    @property
    def steps(self) -> int:
        """Number of steps of all stages."""
        return sum(stage.steps for stage in self.stages)

    def stage_at(self, step: int) -> tuple[Stage, float]:
        """Return the stage of a step, counted from 0, and the completed fraction of that stage."""
        for stage in self.stages:
            if step < stage.steps:
                return stage, step / stage.steps
            step -= stage.steps
        raise InputError(f"step: expected 0 to {self.steps - 1}, got {self.steps + step}")

    def learning_rate_at(self, step: int) -> float:
        """Return the learning rate of a step, counted from 0.

        It rises linearly over 150 steps (a quarter of a short run), is constant until 35 % of the run and then falls to
        1 % along half a cosine. Crops larger than 128 px have 0.7 times that rate.
        """
        warm_up = max(1, min(150, self.steps // 4))
        progress = max(0.0, (step / self.steps - 0.35) / 0.65)
        size_factor = 0.7 if self.stage_at(step)[0].side > 128 else 1.0
        return self.learning_rate * min(1, (step + 1) / warm_up) * cosine((1.0, 0.01), progress) * size_factor

    def shortened(self, factor: float) -> "TrainingConfig":
        """Multiply the steps of every stage by `factor`. Raises InputError unless 0 < factor <= 1000."""
        if not 0 < factor <= 1000:
            raise InputError(f"steps are to be multiplied by {factor}, expected more than 0 and at most 1000")
        return replace(self, stages=tuple(replace(s, steps=max(1, round(s.steps * factor))) for s in self.stages))


CONTINUATION = TrainingConfig(
    learning_rate=3e-4,
    stages=(
        Stage(400, 128, 3, 8, (0.6, 1.0), view=2.0),
        Stage(500, 160, 3, 8, (0.7, 1.0), view=2.0),
        Stage(500, 184, 2, 8, (0.8, 1.0), radius=0.12, view=2.0),
        Stage(900, 224, 2, 8, (0.9, 1.0), radius=0.12, view=2.0),
    ),
)

# From the weights of `CONTINUATION`, with models from files and photographs as backgrounds.
PHOTO_INFORMED = TrainingConfig(
    objects=2400,
    learning_rate=3e-4,
    average=0.995,
    photo_share=0.65,
    stages=(
        Stage(900, 128, 3, 8, (0.6, 1.0), helpers=0.6, view=2.0),
        Stage(170, 192, 2, 8, (0.75, 1.0), helpers=0.6, radius=0.12, view=2.0),
        Stage(80, 224, 2, 8, (0.85, 1.0), helpers=0.6, radius=0.12, view=2.0),
    ),
)
