"""Training losses: correspondence, geometry per patch, and attention on the object.

The losses use ground truth of the renderer for the views of one object. The object's proportions
differ from view to view. No loss compares two objects or uses category names.

Limits and weights of the terms are those of the training of `zsp-tiny` (docs/rebuild.md).
"""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from zsp_lite.course.training.batches import Batch
from zsp_lite.course.training.trainee import Trainee

RADIUS = 0.15  # standard deviation of the correspondence targets, in object units
TEMPERATURE = 0.1  # of the correspondence loss
QUERIES = 256  # largest number of query patches per object
# Values of the Gaussian. A query is used if another view shows a point within 1.2 standard
# deviations of it, where the Gaussian is 0.5; targets beyond 2.4 standard deviations, where the
# Gaussian is 0.05, are 0.
SEEN_AGAIN = 0.5
CUT = 0.05


def correspondence_loss(
    descriptors: Float[Tensor, "crops n dim"],
    surface: Float[Tensor, "crops n 3"],
    objects: int,
    radius: float,
    temperature: float,
    queries: int,
    generator: torch.Generator,
) -> tuple[Tensor, float]:
    """Compute InfoNCE between the views of each object, with soft targets.

    The target of a query patch is a distribution over the patches of the object's other views: a
    Gaussian of the distance between the surface points, cut off beyond 2.4 standard deviations. The
    loss is the divergence from the targets, so that 0 is its minimum.

    Args:
        descriptors: unit vectors, ordered by object and view.
        surface: surface points in object units, NaN on the background.
        objects: number of objects.
        radius: standard deviation of the Gaussian in object units.
        temperature: divides the similarities of descriptors.
        queries: largest number of random query patches per object.
        generator: draws the queries.

    Returns:
        The loss, and the fraction of queries whose nearest descriptor has a non-zero target.
    """
    crops, n, dim = descriptors.shape
    views = crops // objects
    z = descriptors.reshape(objects, views * n, dim)
    points = surface.reshape(objects, views * n, 3)
    view = torch.arange(views).repeat_interleave(n)
    losses = []
    hits = []
    for k in range(objects):
        on_object = (~points[k, :, 0].isnan()).nonzero()[:, 0]
        query = on_object[torch.randperm(len(on_object), generator=generator)[:queries]]
        # An object with few patches is small or cut off, and says little.
        if len(query) < 20:
            continue
        # Rows are queries, columns all patches of the object. Patches of the background get a point
        # (99, 99, 99), which is far from the object: their targets are 0.
        same_view = view[query][:, None] == view[None]
        distance = torch.cdist(points[k, query], points[k].nan_to_num(nan=99.0))
        target = torch.exp(-distance.square() / (2 * radius**2)).masked_fill(same_view, 0)
        seen_again = target.amax(1) > SEEN_AGAIN
        # The mean over fewer queries is too noisy.
        if seen_again.sum() < 5:
            continue
        target = target[seen_again]
        query = query[seen_again]
        target = target * (target > CUT)
        target = target / target.sum(1, keepdim=True)
        # A patch of the query's own view has practically no probability.
        logits = (z[k, query] @ z[k].T / temperature).masked_fill(same_view[seen_again], -1e4)
        losses.append(F.kl_div(logits.log_softmax(1), target, reduction="batchmean"))
        nearest = logits.argmax(1, keepdim=True)
        hits.append((target.gather(1, nearest) > 0).float().mean())
    if not losses:
        return descriptors.sum() * 0, 0.0  # zero, with a gradient
    return torch.stack(losses).mean(), torch.stack(hits).mean().item()


def geometry_loss(
    prediction: Float[Tensor, "crops n 5"],
    geometry: Float[Tensor, "crops n 4"],
    on_object: Bool[Tensor, "crops n"],
) -> Tensor:
    """Compute the loss of predicted geometry (channels 0 to 3) and foreground logit (channel 4)."""
    # Normals and depths of the background are unknown: their error counts on the object alone.
    inside = on_object.float()
    foreground = F.binary_cross_entropy_with_logits(prediction[..., 4], inside)
    error = F.smooth_l1_loss(prediction[..., :4], geometry, beta=0.3, reduction="none").mean(-1)
    return foreground + 2 * (error * inside).sum() / inside.sum().clamp_min(1)


def attention_loss(
    cls_logits: Float[Tensor, "crops heads tokens"], coverage: Float[Tensor, "crops n"]
) -> tuple[Tensor, float]:
    """Compute the loss of the CLS attention, averaged over heads, against the mask; and an IoU.

    The loss has two terms: the divergence of the attention over patches from a target that is
    uniform on the object and zero elsewhere; and a cross-entropy that separates object and
    background at 0.12 times the mean attention on the object. The IoU compares the mask with the
    patches whose min-max normalised attention exceeds 0.05.
    """
    attention = cls_logits.softmax(-1)[..., 1:].mean(1)
    attention = attention / attention.sum(1, keepdim=True)
    # Crops that show at most two patches of the object do not count.
    visible = coverage.sum(1) > 2
    if not visible.any():
        return cls_logits.sum() * 0, 0.0
    attention = attention[visible].clamp_min(1e-8)
    coverage = coverage[visible]
    target = coverage / coverage.sum(1, keepdim=True)
    spread = F.kl_div(attention.log(), target, reduction="batchmean")
    level = (attention * coverage).sum(1, keepdim=True) / coverage.sum(1, keepdim=True)
    # The logit of a patch is positive where its attention exceeds 0.12 of the level.
    separation = F.binary_cross_entropy_with_logits(
        attention.log() - (0.12 * level.detach()).log(), coverage
    )
    with torch.no_grad():
        low = attention.amin(1, keepdim=True)
        high = attention.amax(1, keepdim=True)
        salient = (attention - low) / (high - low + 1e-12) > 0.05
        # A patch is on the object if more than one of its four points of coverage is.
        truth = coverage > 0.25
        iou = ((salient & truth).sum(1) / (salient | truth).sum(1).clamp_min(1)).mean().item()
    return spread + 0.25 * separation, iou


def losses(
    model: Trainee, batch: Batch, generator: torch.Generator, helpers: float
) -> tuple[Tensor, dict[str, float]]:
    """Compute the correspondence loss plus `helpers` times the geometry and attention losses.

    The figures are the value of each loss, the match accuracy and the IoU of the attention with the
    mask. The model's running mean of the keys is updated.
    """
    out = model(batch.images)
    on_object = ~batch.surface[..., 0].isnan()
    of_tokens = model.geometry_of_tokens(out.tokens[:, 1:])  # without the CLS token
    of_keys = model.geometry_of_keys(out.key_input)
    geometry = 0.5 * (
        geometry_loss(of_tokens, batch.geometry, on_object)
        + geometry_loss(of_keys, batch.geometry, on_object)
    )
    attention, iou = attention_loss(out.cls_logits, batch.coverage)
    descriptors = F.normalize(model.centred(out.keys, update_mean=True), dim=-1)
    match, accuracy = correspondence_loss(
        descriptors, batch.surface, batch.objects, RADIUS, TEMPERATURE, QUERIES, generator
    )
    total = match + helpers * (geometry + attention)
    return total, {
        "loss": total.item(),
        "match": match.item(),
        "geometry": geometry.item(),
        "attention": attention.item(),
        "accuracy": accuracy,
        "iou": iou,
    }
